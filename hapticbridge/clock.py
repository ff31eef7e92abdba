"""Time, injected: a real clock with absolute deadlines, and a simulated one.

Both answer the same calls, so the loop does not know which one drives it. Times are integer
nanoseconds of running: zero at the first start, and a later start goes on where the last run ended.
"""

from __future__ import annotations

import sys
import time
from typing import Protocol

from hapticbridge.errors import HapticBridgeError

SPIN_NS = 150_000
"""The end of each wait is spun instead of slept, in ns. A sleeping thread wakes some 50 to 100 µs
late on an ordinary kernel; longer spins cost processor time."""

SPIN_SHARE = 0.75
"""Largest share of a period that is spun, no unit: it counts above 5 kHz. Under SCHED_FIFO the
kernel stops a thread for 50 ms in each second in which it did not sleep for 50 ms (5 %); with this,
a tick may take another 20 % of the period before that happens. Less wakes later at such rates."""

LOWEST_RATE, HIGHEST_RATE = 1.0, 1e6
"""In Hz. Below one tick a second nothing can be felt; above 1 MHz no step of MuJoCo fits between
two ticks, and the clock's nanoseconds become too coarse."""


def period_of(rate: float) -> float:
    """Returns the period in s of a rate in Hz.

    Raises:
        HapticBridgeError: The rate is not 1 Hz to 1 MHz.
    """
    if not LOWEST_RATE <= rate <= HIGHEST_RATE:
        raise HapticBridgeError(
            f"rate is {rate!r} Hz; it must be {LOWEST_RATE:g} to {HIGHEST_RATE:g}"
        )
    return 1.0 / rate


class Clock(Protocol):
    """What drives the loop.

    Attributes:
        name: "real" or "simulated", as the recording's metadata names it.
        is_lossless: Whether the loop may wait for the recorder instead of dropping records.
    """

    name: str
    is_lossless: bool

    def start(self, period_ns: int) -> None:
        """Starts or resumes time with the tick's period in ns; the next deadline is one away."""

    def wait(self) -> tuple[int, int, int]:
        """Waits for the next deadline.

        Returns:
            The deadline and the time of waking, both in ns of running, and how many deadlines
            were skipped because they had already passed by a period or more.
        """

    def now(self) -> int:
        """Returns the time in ns of running."""


def running_ns() -> int:
    """Returns monotonic time in ns that also passes while the machine is suspended.

    Linux's CLOCK_MONOTONIC stands still then: the loop would go on as if no time had passed, with
    the force of a pose that is long gone. Setting the time of day moves neither.
    """
    if sys.platform == "linux":
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    return time.monotonic_ns()


def slept_ns() -> int:
    """Returns for how long the machine has been suspended since it was booted, in ns; 0 elsewhere.

    Between its two readings some microseconds may pass.
    """
    if sys.platform == "linux":
        return running_ns() - time.monotonic_ns()
    return 0


class RealClock:
    """Wall time: monotonic, absolute deadlines, overruns skipped and counted, never caught up.

    Deadlines are multiples of the period from the start, so no error accumulates (a sleep that is
    re-based on "now" loses rate: 887 Hz were measured where 1000 were asked).
    """

    name = "real"
    is_lossless = False

    def __init__(self) -> None:
        self._period = self._spin = self._origin = self._deadline = 0

    def start(self, period_ns: int) -> None:
        """Puts the last deadline to now (see ``Clock.start``)."""
        self._period = period_ns
        self._spin = min(SPIN_NS, round(SPIN_SHARE * period_ns))
        self._origin = running_ns() - self._deadline

    def wait(self) -> tuple[int, int, int]:
        """Sleeps to shortly before the deadline, then spins (see ``Clock.wait``)."""
        deadline = self._deadline + self._period
        now = running_ns() - self._origin
        skipped = 0
        if now >= deadline + self._period:
            skipped = (now - deadline) // self._period
            deadline += skipped * self._period
        else:
            if deadline - now > self._spin:
                time.sleep((deadline - now - self._spin) * 1e-9)
            while now < deadline:
                now = running_ns() - self._origin
        self._deadline = deadline
        return deadline, now, skipped

    def now(self) -> int:
        """Returns ns of running; 0 before the first start."""
        return running_ns() - self._origin if self._period else 0


class SimulatedClock:
    """Time that passes only by ticks: as fast as the loop goes, and the same in every run."""

    name = "simulated"
    is_lossless = True

    def __init__(self) -> None:
        self._period = self._now = 0

    def start(self, period_ns: int) -> None:
        """Takes the period; time stands still between runs."""
        self._period = period_ns

    def wait(self) -> tuple[int, int, int]:
        """Advances by one period at once (see ``Clock.wait``)."""
        self._now += self._period
        return self._now, self._now, 0

    def now(self) -> int:
        """Returns ns of running, a multiple of the period."""
        return self._now
