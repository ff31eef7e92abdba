"""Statistics of a loop's lateness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hapticbridge.errors import HapticBridgeError


@dataclass(frozen=True, slots=True)
class Lateness:
    """Lateness of the ticks of one loop; times in s.

    Attributes:
        ticks: Number of ticks that woke.
        missed: Number of deadlines without a tick.
        median: Median.
        p99: 99th percentile.
        p999: 99.9th percentile.
        worst: Maximum.
    """

    ticks: int
    missed: int
    median: float
    p99: float
    p999: float
    worst: float

    def sentence(self) -> str:
        """Formats the numbers in µs, in one line."""
        return (
            f"p50 {self.median * 1e6:.0f}, p99 {self.p99 * 1e6:.0f}, p99.9 {self.p999 * 1e6:.0f}, "
            f"max {self.worst * 1e6:.0f} µs, {self.missed} of {self.ticks + self.missed} missed"
        )


def lateness_of(late_ns: ArrayLike, missed: int) -> Lateness:
    """Returns the percentiles of times from deadline to wake-up.

    Times are in ns; 0 or less counts as on time.

    Raises:
        HapticBridgeError: There are no times.
    """
    late = np.maximum(np.asarray(late_ns, dtype=np.float64).ravel(), 0.0) * 1e-9
    if late.size == 0:
        raise HapticBridgeError("no tick woke, so there is no lateness; run it for longer")
    late.sort()
    # without interpolation, so each percentile is a measured lateness
    median, p99, p999 = (
        float(late[-(-late.size * thousandths // 1000) - 1]) for thousandths in (500, 990, 999)
    )
    return Lateness(
        ticks=int(late.size),
        missed=missed,
        median=median,
        p99=p99,
        p999=p999,
        worst=float(late[-1]),
    )
