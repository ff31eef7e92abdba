"""Times of many ticks in few numbers: their spread, and how they grow with a count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEAST_GROUP = 20
"""Ticks with one number of rows from which their median counts."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Times in s of some ticks.

    Attributes:
        ticks: How many.
        median: Half of them were faster; nan if there was none.
        p99: 99 of 100 were faster.
    """

    ticks: int
    median: float
    p99: float

    @classmethod
    def of(cls, times: NDArray[np.float64]) -> Spread:
        """Returns the spread of times in s."""
        if not times.size:
            return cls(0, float("nan"), float("nan"))
        return cls(int(times.size), float(np.median(times)), float(np.percentile(times, 99)))


@dataclass(frozen=True, slots=True)
class Growth:
    """How the tick's time grows with constraint rows, or with contacts.

    Attributes:
        steps: Number of rows (contacts), ticks that had it, and their median time in s.
        base: Time in s without any, by the line of least squares through the medians; None where
            there are fewer than two.
        per_one: What each adds, in s; None likewise.
    """

    steps: tuple[tuple[int, int, float], ...]
    base: float | None
    per_one: float | None


def growth_of(counts: NDArray[np.int64], times: NDArray[np.float64]) -> Growth:
    """Returns how times grow with counts: the medians, and a line weighted by their ticks.

    Args:
        counts: Shape (n,).
        times: Shape (n,), in s.
    """
    steps = []
    for count in np.unique(counts).tolist():
        those = times[counts == count]
        if those.size >= LEAST_GROUP:
            steps.append((int(count), int(those.size), float(np.median(those))))
    if len(steps) < 2:
        return Growth(tuple(steps), None, None)
    x, n, y = (np.array(column, dtype=np.float64) for column in zip(*steps, strict=True))
    slope, base = np.polyfit(x, y, 1, w=np.sqrt(n))
    return Growth(tuple(steps), float(base), float(slope))
