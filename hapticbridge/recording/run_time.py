"""When the ticks of a run were due, on the clock of its events."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from hapticbridge.tick import TICK_DTYPE

Array = NDArray[np.float64]


def due_times(ticks: NDArray[np.void], period: float) -> Array:
    """Returns when ticks were due, in s of the run's clock, missed deadlines among it.

    That is the clock of the events' ``time_ns``: without a missed deadline, (tick + 1) T. In a
    damaged file deadlines may go back; then all are taken for as if none had been missed, so that
    whatever is drawn over time can be drawn.

    Args:
        ticks: Records in their order, ``TICK_DTYPE``, (n,).
        period: T in s.

    Returns:
        Shape (n,), increasing where the ticks' numbers are.
    """
    due = ticks["deadline_ns"]
    if due.size and (due[0] <= 0 or (np.diff(due) <= 0).any()):
        return np.asarray((ticks["tick"] + 1) * period)
    return np.asarray(1e-9 * due)


class Timeline:
    """The due times of a run's ticks, however many: it keeps only where deadlines were missed.

    Args:
        blocks: The run's records, block by block, ``TICK_DTYPE``.
        period: T in s.

    Attributes:
        duration: When the last tick was due, in s; 0 where there is none.
    """

    def __init__(self, blocks: Iterable[NDArray[np.void]], period: float) -> None:
        rows, times = list[int](), list[float]()
        before, count = np.zeros(0, TICK_DTYPE), 0
        for block in blocks:
            if not len(block):
                continue
            part = np.concatenate([before, block])
            due, first = due_times(part, period), count - len(before)
            # both sides of every step that is not a period, and the ends; the rest is straight
            gaps = np.flatnonzero(np.abs(np.diff(due) - period) > 0.5 * period)
            kept = sorted({0, *gaps.tolist(), *(gaps + 1).tolist(), len(part) - 1})
            rows += [first + row for row in kept]
            times += due[kept].tolist()
            count += len(block)
            before = part[-1:]
        self._rows, self._times = np.array(rows, np.float64), np.array(times)
        self.duration = times[-1] if times else 0.0

    def row_at(self, time: float) -> int:
        """Returns the row of the tick that was due nearest to a time in s; of the first before it.

        Args:
            time: From 0 to ``duration``.
        """
        return round(float(np.interp(time, self._times, self._rows)))
