"""The way of a command into the loop: checked, slowed down, and kept where the loop looks."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from hapticbridge.commands.allowance import Allowance
from hapticbridge.commands.command import Command, Couple, Mark, Repeat, Reset
from hapticbridge.errors import CommandError

MOST_WAITING = 8
"""Commands that may wait for the loop, which takes one a tick; a loop that leaves more undone
stands still."""

INTERVAL = 0.05
"""In s, least time between two commands. A slider that is dragged needs no more than 20 a second to
look smooth, and each takes the loop some 20 µs; a flood must not become a load."""

RESET_INTERVAL = 1.0
"""Least time in s between two resets. The force fades before each and rises after it, which takes
half a second. A shorter interval lets resets follow each other without any force between them."""


class CommandQueue:
    """Commands between whoever gives them and the loop; nothing unchecked ever gets in.

    Any thread may ``offer``. The loop alone takes: it looks whether ``waiting`` is empty, which
    takes no lock and allocates nothing, and pops from its left end, which the interpreter does in
    one piece. The queue never holds more than ``MOST_WAITING``.

    Args:
        allowance: What the device allows.
        is_recorded: Whether the run is recorded, so that it can be marked.
        now: Time in s, that never runs backwards.

    Attributes:
        waiting: Commands in their order, each with who gave it.
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
        self._offering = threading.Lock()  # never the loop's
        self._last = self._last_reset = -float("inf")

    def warm_up(self) -> None:
        """Computes what takes long, so that no command is the first one."""
        if self.allowance.method.has_law:
            for span in self.allowance.spans:
                span.needed(span.least_stiffness, 0.0)

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
        is_reset = isinstance(command, Reset)
        with self._offering:
            now = self._now()
            early = max(
                self._last + INTERVAL - now,
                self._last_reset + RESET_INTERVAL - now if is_reset else 0.0,
            )
            if early > 0:
                raise CommandError(f"the last command is too recent; ask again in {early:.2f} s")
            if len(self.waiting) >= MOST_WAITING:
                raise CommandError("the loop takes no commands; it stands still")
            self._last = now
            if is_reset:
                self._last_reset = now
            self.waiting.append((command, by))

    def _check(self, command: Command) -> None:
        if isinstance(command, Couple):
            self.allowance.check(command)
        elif isinstance(command, Reset) and not self.allowance.method.has_coupling:
            raise CommandError(
                "a tool without mass is where the hand is; there is nothing to reset"
            )
        elif isinstance(command, Mark) and not self._is_recorded:
            raise CommandError("this run is not recorded; start it with a recording to mark it")
