"""Injected clocks: a real one with absolute deadlines, and a simulated one.

Times are integer nanoseconds of running: zero at the first start. A later start continues at the
end of the last run.
"""

from __future__ import annotations

import sys
import time
from typing import Protocol

from hapticbridge.arguments import Rule, checked_value

SPIN_NS = 150_000
"""Time in ns before a deadline that is spent spinning instead of sleeping. A sleeping thread wakes
50 to 100 µs late on an ordinary kernel; a longer spin costs processor time."""

SPIN_SHARE = 0.75
"""Largest share of a period spent spinning, without unit; it applies above 5 kHz. Under SCHED_FIFO
the kernel stops a thread for 50 ms in each second in which it did not sleep for 50 ms (5 %). With
this share a tick may take another 20 % of the period before that happens. A smaller share wakes
later at such rates."""

LOWEST_RATE, HIGHEST_RATE = 1.0, 1e6
"""Range of the rate in Hz. Below 1 Hz nothing can be felt. Above 1 MHz no step of MuJoCo fits
between two ticks, and the clock's nanoseconds become too coarse."""


RATE = Rule(unit="Hz", least=LOWEST_RATE, most=HIGHEST_RATE)
"""Valid rates of a loop."""


def period_of(rate: float) -> float:
    """Returns the period in s of a rate in Hz.

    Raises:
        HapticBridgeError: The rate is not 1 Hz to 1 MHz.
    """
    return 1.0 / float(checked_value("rate", rate, (float,), RATE))


class Clock(Protocol):
    """Clock that paces the loop.

    Attributes:
        name: "real" or "simulated", as in the recording's metadata.
        may_wait: True if the loop may wait for the recorder instead of dropping records.
    """

    name: str
    may_wait: bool

    def start(self, period_ns: int) -> None:
        """Starts or resumes time with the period in ns; the first deadline is one period away."""

    def wait(self) -> tuple[int, int, int]:
        """Waits for the next deadline.

        Returns:
            Deadline and wake-up time in ns of running, and the number of skipped deadlines. A
            deadline is skipped if it has passed by a period or more.
        """

    def now(self) -> int:
        """Returns the time in ns of running."""


def running_ns() -> int:
    """Returns monotonic time in ns that also passes while the machine is suspended.

    Linux's CLOCK_MONOTONIC stops then, and the loop would continue with the force of an old pose.
    Setting the time of day affects neither.
    """
    if sys.platform == "linux":
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    return time.monotonic_ns()


def slept_ns() -> int:
    """Returns the time in ns for which the machine was suspended since boot; 0 except on Linux.

    It is the difference of two readings, which may be microseconds apart.
    """
    if sys.platform == "linux":
        return running_ns() - time.monotonic_ns()
    return 0


class RealClock:
    """Real time with absolute deadlines; overruns are skipped and counted, never caught up.

    Deadlines are multiples of the period from the start, so no error accumulates. A sleep relative
    to "now" loses rate: 887 Hz were measured for 1000.
    """

    name = "real"
    may_wait = False

    def __init__(self) -> None:
        self._period = self._spin = self._origin = self._deadline = 0

    def start(self, period_ns: int) -> None:
        """Sets the last deadline to now (see ``Clock.start``)."""
        self._period = period_ns
        self._spin = min(SPIN_NS, round(SPIN_SHARE * period_ns))
        self._origin = running_ns() - self._deadline

    def wait(self) -> tuple[int, int, int]:
        """Sleeps until shortly before the deadline, then spins (see ``Clock.wait``)."""
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
    """Time that advances only by ticks, as fast as the loop runs; equal in every run."""

    name = "simulated"
    may_wait = True

    def __init__(self) -> None:
        self._period = self._now = 0

    def start(self, period_ns: int) -> None:
        """Sets the period; time stands still between runs."""
        self._period = period_ns

    def wait(self) -> tuple[int, int, int]:
        """Advances by one period at once (see ``Clock.wait``)."""
        self._now += self._period
        return self._now, self._now, 0

    def now(self) -> int:
        """Returns ns of running, a multiple of the period."""
        return self._now
