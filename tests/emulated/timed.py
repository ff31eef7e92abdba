"""What virtual time is to a clock and to a loop that steps it."""

from __future__ import annotations

from typing import Protocol


class Timed(Protocol):
    """Emulated devices and the time in s that they are at."""

    now: float

    def advance(self, now: float) -> None:
        """Brings every device to a time; a time before the newest one changes nothing."""
