"""Wake-up times of the bridge's clock and of a bare sleep loop."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hapticbridge.clock import RealClock
from hapticbridge.realtime import Lateness, lateness_of


@dataclass(slots=True)
class Wakeups:
    """Wake-ups of one kind of loop, over several turns.

    Attributes:
        name: Name of the loop.
        late_ns: Lateness of each tick in ns, by turn.
        missed: Number of skipped deadlines.
    """

    name: str
    late_ns: list[NDArray[np.int64]] = field(default_factory=list)
    missed: int = 0

    def add(self, late_ns: NDArray[np.int64], missed: int) -> None:
        """Adds one turn."""
        self.late_ns.append(late_ns)
        self.missed += missed

    def lateness(self) -> Lateness:
        """Returns the statistics of all turns.

        Raises:
            HapticBridgeError: There was no turn.
        """
        return lateness_of(
            np.concatenate([np.zeros(0, dtype=np.int64), *self.late_ns]), self.missed
        )


def clock_turn(period_ns: int, ticks: int) -> tuple[NDArray[np.int64], int]:
    """Waits with the bridge's own clock, which sleeps and then spins.

    The number of ticks includes skipped deadlines.

    Returns:
        Lateness of each tick in ns, and number of skipped deadlines.
    """
    clock = RealClock()
    clock.start(period_ns)
    return _turn(clock.wait, ticks)


def bare_turn(period_ns: int, ticks: int) -> tuple[NDArray[np.int64], int]:
    """Waits with plain sleeps until each deadline; returns the same values as ``clock_turn``."""
    monotonic, sleep = time.monotonic_ns, time.sleep
    deadline = monotonic()

    def wait() -> tuple[int, int, int]:
        nonlocal deadline
        deadline += period_ns
        skipped = max((monotonic() - deadline) // period_ns, 0)
        deadline += skipped * period_ns
        left = deadline - monotonic()
        if left > 0:
            sleep(left * 1e-9)
        return deadline, monotonic(), skipped

    return _turn(wait, ticks)


def _turn(wait: Callable[[], tuple[int, int, int]], ticks: int) -> tuple[NDArray[np.int64], int]:
    late, count, missed = np.zeros(ticks, dtype=np.int64), 0, 0
    while count + missed < ticks:
        deadline, wake, skipped = wait()
        late[count] = wake - deadline
        count += 1
        missed += skipped
    return late[:count], missed
