"""Commands to a running bridge.

Read ``command`` first. ``queue`` checks and stores commands, ``allowance`` and ``span`` hold the
device's limits, ``operator`` executes them between two ticks, and ``change`` defines the resulting
events, which the audit repeats.
"""

from hapticbridge.commands.allowed import CouplingLimits as CouplingLimits
from hapticbridge.commands.command import Command as Command
from hapticbridge.commands.command import Couple as Couple
from hapticbridge.commands.command import Mark as Mark
from hapticbridge.commands.command import Repeat as Repeat
from hapticbridge.commands.command import Reset as Reset
from hapticbridge.commands.command import Switch as Switch
from hapticbridge.commands.command import command_of as command_of
from hapticbridge.commands.execution import CHANGES as CHANGES
from hapticbridge.commands.execution import CommandExecutor as CommandExecutor
from hapticbridge.commands.execution import CommandQueue as CommandQueue
from hapticbridge.commands.execution import EventApplier as EventApplier
