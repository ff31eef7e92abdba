"""What may be asked of a run while it goes on, and how it is done so that it can be repeated.

Read ``command`` first, then its way: ``queue`` checks it, ``allowance`` and ``span`` against what
the device bears, ``operator`` does it between two ticks, and ``change`` is what it was, as an event
that the audit repeats.
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
