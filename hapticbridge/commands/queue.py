"""Thread-safe queue of validated, rate-limited commands."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from hapticbridge.commands.allowance import Allowance
from hapticbridge.commands.command import Command, Couple, Mark, Repeat, Reset
from hapticbridge.errors import CommandError

MOST_WAITING = 8
"""Largest number of waiting commands. The loop takes one per tick; more waiting ones mean that it
stalls."""

INTERVAL = 0.05
"""Shortest time in s between two commands. A dragged slider looks smooth at 20 per second; each
command costs the loop about 20 µs, and a flood must not become a load."""

RESET_INTERVAL = 1.0
"""Shortest time in s between two resets. The force fades before each and rises after it, which
takes half a second. With a shorter interval, resets could follow each other without any force
between them."""


class CommandQueue:
    """Queue of commands between their senders and the loop; every command in it is validated.

    Any thread may ``offer``; only the loop takes. The loop tests whether ``waiting`` is empty,
    which needs no lock and no allocation, and pops from its left end, which the interpreter does
    atomically. The queue holds at most ``MOST_WAITING`` commands.

    Args:
        allowance: Limits of the coupling on the device.
        is_recorded: True for a recorded run, which can be marked.
        now: Returns the time in s; it never runs backwards.

    Attributes:
        waiting: Commands in order, each with its origin.
    """

    def __init__(
        self,
        allowance: Allowance,
        *,
        is_recorded: bool = True,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.allowance = allowance
        self.waiting: deque[tuple[Command | Repeat, str]] = deque(maxlen=MOST_WAITING)
        self._is_recorded, self._now = is_recorded, now
        self._offering = threading.Lock()  # never taken by the loop
        self._last = self._last_reset = -float("inf")

    def warm_up(self) -> None:
        """Computes the tables of limits in advance, so that the first command is not slow."""
        if self.allowance.method.has_law:
            for span in self.allowance.spans:
                span.needed(span.least_stiffness, 0.0)

    def offer(self, command: Command, by: str) -> None:
        """Adds a command, or refuses it.

        ``by`` is the command's origin, for the recording.

        Raises:
            CommandError: It exceeds the device's limits, follows the last one too soon, or the loop
                stalls.
        """
        self._check(command)
        is_reset = isinstance(command, Reset)
        with self._offering:
            now = self._now()
            early = max(
                self._last + INTERVAL - now,
                self._last_reset + RESET_INTERVAL - now if is_reset else 0.0,
            )
            if early > 0:
                raise CommandError(f"the last command is too recent; try again in {early:.2f} s")
            if len(self.waiting) >= MOST_WAITING:
                raise CommandError("the loop takes no commands because it stalls; try again later")
            self._last = now
            if is_reset:
                self._last_reset = now
            self.waiting.append((command, by))

    def _check(self, command: Command) -> None:
        if isinstance(command, Couple):
            self.allowance.check(command)
        elif isinstance(command, Reset) and not self.allowance.method.has_coupling:
            raise CommandError("a massless tool follows the hand, so there is nothing to reset")
        elif isinstance(command, Mark) and not self._is_recorded:
            raise CommandError("this run is not recorded; start it with a recording to mark it")
