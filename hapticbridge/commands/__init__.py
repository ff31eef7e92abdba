"""Commands to a run in progress, recorded so that the audit can repeat them.

``command`` holds the commands. ``allowed`` refuses a coupling that the device cannot bear.
``execution`` queues a command, applies it between two ticks and records it as an event.
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
