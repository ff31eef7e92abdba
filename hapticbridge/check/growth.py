"""Statistics of tick times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEAST_GROUP = 20
"""Smallest number of ticks with one count whose median is used."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Distribution of tick times, in s.

    Attributes:
        ticks: Number of ticks.
        median: Median; nan without ticks.
        p99: 99th percentile; nan without ticks.
    """

    ticks: int
    median: float
    p99: float

    @classmethod
    def of(cls, times: NDArray[np.float64]) -> Spread:
        """Computes the distribution of times in s."""
        if not times.size:
            return cls(0, float("nan"), float("nan"))
        return cls(int(times.size), float(np.median(times)), float(np.percentile(times, 99)))


@dataclass(frozen=True, slots=True)
class Growth:
    """Growth of the tick's time with the number of constraint rows or contacts.

    Attributes:
        steps: For each count: the count, the number of ticks, and their median time in s.
        base: Time in s at count zero, from a least-squares line through the medians; None with
            fewer than two medians.
        per_one: Additional time in s per row or contact; None with fewer than two medians.
    """

    steps: tuple[tuple[int, int, float], ...]
    base: float | None
    per_one: float | None


def growth_of(counts: NDArray[np.int64], times: NDArray[np.float64]) -> Growth:
    """Returns the median time by count, and a line weighted by the number of ticks.

    Both arrays have shape (n,); times are in s.
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
