"""Due times of a run's ticks, with missed deadlines."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def due_times(ticks: NDArray[np.void], period: float) -> Array:
    """Returns the due times of ticks in s of the run's clock, with missed deadlines.

    This is the clock of the events' ``time_ns``; without a missed deadline it is (tick + 1) T. If
    the deadlines of a damaged file run backwards, all are computed as if none had been missed, so
    that plots over time remain possible. ``period`` is T in s.

    Returns:
        Shape (n,), increasing if the ticks' numbers are.
    """
    due = ticks["deadline_ns"]
    if due.size and (due[0] <= 0 or (np.diff(due) <= 0).any()):
        return np.asarray((ticks["tick"] + 1) * period)
    return np.asarray(1e-9 * due)


class Timeline:
    """Due times of any number of ticks; only missed deadlines are stored.

    Attributes:
        duration: Due time of the last tick in s; 0 without ticks.
    """

    def __init__(self, blocks: Iterable[NDArray[np.void]], period: float) -> None:
        rows, times = list[int](), list[float]()
        before: list[NDArray[np.void]] = []
        count = 0
        for block in blocks:
            if not len(block):
                continue
            part = np.concatenate([*before, block])
            due, first = due_times(part, period), count - len(before)
            # keep both sides of every step that is not one period, and the ends
            gaps = np.flatnonzero(np.abs(np.diff(due) - period) > 0.5 * period)
            kept = sorted({0, *gaps.tolist(), *(gaps + 1).tolist(), len(part) - 1})
            rows += [first + row for row in kept]
            times += due[kept].tolist()
            count += len(block)
            before = [part[-1:]]
        self._rows, self._times = np.array(rows, np.float64), np.array(times)
        self.duration = times[-1] if times else 0.0

    def row_at(self, time: float) -> int:
        """Returns the row of the tick due nearest to a time in s, from 0 to ``duration``."""
        return round(float(np.interp(time, self._times, self._rows)))
