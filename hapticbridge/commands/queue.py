"""The way of a command into the loop: checked, slowed down, and kept where the loop looks."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from hapticbridge.commands.allowance import Allowance
from hapticbridge.commands.command import Command, Couple, Record, Repeat, Reset
from hapticbridge.errors import CommandError

MOST_WAITING = 8
"""Commands that may wait for the loop, which takes one a tick; a loop that leaves more undone
stands still."""

INTERVAL = 0.05
"""In s, least time between two commands. A slider that is dragged needs no more than 20 a second to
look smooth, and each takes the loop some 20 µs; a flood must not become a load."""

PAUSE_INTERVAL = 1.0
"""In s, likewise before a command that interrupts the force: a reset, and a recorder that starts or
stops, take half a second with their ramps."""


class CommandQueue:
    """Commands between whoever gives them and the loop; nothing unchecked ever gets in.

    Any thread may ``offer``. The loop alone takes: it looks whether ``waiting`` is empty, which
    takes no lock and allocates nothing, and pops from its left end, which the interpreter does in
    one piece. The queue never holds more than ``MOST_WAITING``.

    Args:
        allowance: What the device allows.
        can_record: Whether the run can start and stop a recorder.
        now: Time in s, that never runs backwards.

    Attributes:
        waiting: Commands in their order, each with who gave it.
    """

    def __init__(
        self,
        allowance: Allowance,
        *,
        can_record: bool = True,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.allowance = allowance
        self.waiting: deque[tuple[Command | Repeat, str]] = deque(maxlen=MOST_WAITING)
        self._can_record, self._now = can_record, now
        self._offering = threading.Lock()  # never the loop's
        self._last = self._last_pause = -float("inf")

    def warm_up(self) -> None:
        """Computes what takes long, so that no command is the first one."""
        if self.allowance.method.has_law:
            self.allowance.needed(self.allowance.least_stiffness, 0.0)

    def offer(self, command: Command, by: str) -> None:
        """Hands a command over, or refuses it.

        Args:
            command: What is asked for.
            by: Who asks, for the recording.

        Raises:
            CommandError: It exceeds what the device allows, comes too soon after the last one, or
                the loop does not take any.
        """
        self._check(command)
        is_pause = isinstance(command, Reset | Record)
        with self._offering:
            now = self._now()
            early = max(
                self._last + INTERVAL - now,
                self._last_pause + PAUSE_INTERVAL - now if is_pause else 0.0,
            )
            if early > 0:
                raise CommandError(f"the last command is too recent; ask again in {early:.2f} s")
            if len(self.waiting) >= MOST_WAITING:
                raise CommandError("the loop takes no commands; it stands still")
            self._last = now
            if is_pause:
                self._last_pause = now
            self.waiting.append((command, by))

    def _check(self, command: Command) -> None:
        if isinstance(command, Couple):
            self.allowance.check(command.stiffness, command.damping)
        elif isinstance(command, Reset) and not self.allowance.method.has_coupling:
            raise CommandError(
                "a tool without mass is where the hand is; there is nothing to reset"
            )
        elif isinstance(command, Record) and not self._can_record:
            raise CommandError("this run cannot start a recorder")
