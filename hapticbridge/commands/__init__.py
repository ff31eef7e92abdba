"""Commands to a running bridge.

Read ``command`` first. ``queue`` checks and stores commands, ``allowance`` and ``span`` hold the
device's limits, ``operator`` executes them between two ticks, and ``change`` defines the resulting
events, which the audit repeats.
"""

from hapticbridge.commands.allowance import Allowance as Allowance
from hapticbridge.commands.change import CHANGES as CHANGES
from hapticbridge.commands.change import Repeater as Repeater
from hapticbridge.commands.command import Command as Command
from hapticbridge.commands.command import Couple as Couple
from hapticbridge.commands.command import Mark as Mark
from hapticbridge.commands.command import Repeat as Repeat
from hapticbridge.commands.command import Reset as Reset
from hapticbridge.commands.command import Switch as Switch
from hapticbridge.commands.command import command_of as command_of
from hapticbridge.commands.operator import Operator as Operator
from hapticbridge.commands.queue import CommandQueue as CommandQueue
