"""Processor time of many runs, side by side on one core."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.run_description import processor
from hapticbridge.study.chart.workload import Run

REPEATS = 7
"""Rounds at most; the median of seven is not moved by three that were disturbed."""

LEAST_REPEATS = 3
"""Rounds at least, whatever they take: a median needs them."""

PATIENCE = 45.0
"""Time in s after which no new round begins."""

SEED = 7
"""Of the order within a round, so that no point always follows the same other one."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Processor time in s per simulated second.

    Attributes:
        median: Over the rounds; nan where a run failed before it could be timed.
        low: Least.
        high: Largest.
        ratio: Median of the ratio to the baseline, each taken within one round; no unit.
        ratio_low: Least of these.
        ratio_high: Largest.
        repeats: Rounds.
    """

    median: float
    low: float
    high: float
    ratio: float
    ratio_low: float
    ratio_high: float
    repeats: int


@contextmanager
def one_core() -> Iterator[int | None]:
    """Keeps this thread on one core; yields which, None where the system has no such call."""
    if not hasattr(os, "sched_setaffinity"):
        yield None
        return
    allowed = os.sched_getaffinity(0)
    core = max(allowed)
    os.sched_setaffinity(0, {core})
    try:
        yield core
    finally:
        os.sched_setaffinity(0, allowed)


def machine(core: int | None) -> str:
    """Names the machine and the core that was measured on."""
    where = "not pinned" if core is None else f"pinned to core {core} of {os.cpu_count()}"
    return f"{processor()}, one thread, {where}"


def interleaved_costs(
    runs: Sequence[Run],
    baseline: int,
    *,
    repeats: int = REPEATS,
    patience: float = PATIENCE,
    clock: Callable[[], float] = time.perf_counter,
    progress: Callable[[int], None] | None = None,
) -> list[Cost]:
    """Runs all in rounds, in another order each round, so that a disturbance meets everyone.

    The runs have been run before, which warmed them up.

    Args:
        runs: What to time.
        baseline: Index of the run that ratios are to.
        repeats: Rounds at most, >= 1.
        patience: Time in s after which no further round begins, from the third round on.
        clock: Time in s.
        progress: Called with the number of runs done.
    """
    generator = np.random.default_rng(SEED)
    rounds: list[NDArray[np.float64]] = []
    start, done = clock(), 0
    while len(rounds) < repeats:
        if len(rounds) >= min(LEAST_REPEATS, repeats) and clock() - start > patience:
            break
        costs = np.zeros(len(runs))
        for index in generator.permutation(len(runs)):
            costs[index] = runs[index].go() / runs[index].seconds
            done += 1
            if progress is not None:
                progress(done)
        rounds.append(costs)
    table = np.array(rounds)
    ratios = table / table[:, [baseline]]
    return [
        Cost(*_spread(table[:, i]), *_spread(ratios[:, i]), repeats=len(rounds))
        for i in range(len(runs))
    ]


def _spread(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Returns median, least and largest of the rounds that were timed; nan where none was."""
    known = values[np.isfinite(values)]
    if not known.size:
        return (float("nan"),) * 3
    return float(np.median(known)), float(known.min()), float(known.max())
