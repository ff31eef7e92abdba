"""Cost against work: how a tick's time grows with bodies, contacts and triangles."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.cost import TICK_SHARE, TimingStats
from hapticbridge.scene import Scene
from hapticbridge.study.chart.tick_times import USUAL, VARIANTS, Variant, tick_times
from hapticbridge.study.chart.timing import machine, one_core
from hapticbridge.study.chart.work_scenes import FAMILIES, Family

ROUNDS = 3
"""How often every scene is run, in turn with the others."""

LARGE = 0.1
"""Share of a family's largest size from which on its exponent is fitted, no unit: below, the cost
that every tick has hides the growth."""


@dataclass(frozen=True, slots=True)
class Work:
    """What a scene cost.

    Attributes:
        family: Its name.
        variant: Its name.
        size: The count that was asked for.
        contacts: Contacts at the end.
        rows: Constraint rows at the end.
        freedoms: Degrees of freedom.
        time: Of a tick in s, all rounds together.
        low: Least median of a round in s.
        high: Largest.
        rate: Hz at which the 99th percentile of a tick fills half a period.
    """

    family: str
    variant: str
    size: int
    contacts: int
    rows: int
    freedoms: int
    time: TimingStats
    low: float
    high: float
    rate: float


@dataclass(frozen=True, slots=True)
class Growth:
    """How the time of a tick goes with the size: time ~ size^p.

    Attributes:
        exponent: p, fitted to the larger sizes; no unit.
        low: Least p from one of these sizes to the next.
        high: Largest. Far from ``low``, the growth is no power of the size.
        start: Smallest size of the fit.
    """

    exponent: float
    low: float
    high: float
    start: float


@dataclass(frozen=True, slots=True)
class WorkChart:
    """Everything that was measured.

    Attributes:
        points: One per family, size and variant.
        machine: In words.
    """

    points: tuple[Work, ...]
    machine: str

    def of(self, family: Family, variant: Variant) -> list[Work]:
        """Returns the points of a family by size."""
        return [p for p in self.points if (p.family, p.variant) == (family.name, variant.name)]

    def variants(self, family: Family) -> list[Variant]:
        """Returns the variants that a family was measured with."""
        return [variant for variant in VARIANTS if self.of(family, variant)]

    def growth(self, family: Family, variant: Variant) -> Growth | None:
        """Returns how the time goes with the larger sizes; None for fewer than two."""
        points = self.of(family, variant)
        return growth_of(
            np.array([each.size for each in points], dtype=np.float64),
            np.array([each.time.median for each in points]),
        )


def growth_of(sizes: NDArray[np.float64], times: NDArray[np.float64]) -> Growth | None:
    """Fits time ~ size^p to the sizes from ``LARGE`` of the largest on.

    Args:
        sizes: > 0, rising, shape (n,).
        times: In s, > 0, shape (n,).

    Returns:
        None for fewer than two such sizes.
    """
    large = sizes >= LARGE * sizes.max(initial=0.0) * (1 - 1e-9)
    if np.count_nonzero(large) < 2:
        return None
    size, time = np.log(sizes[large]), np.log(times[large])
    local = np.diff(time) / np.diff(size)
    return Growth(
        exponent=float(np.polyfit(size, time, 1)[0]),
        low=float(local.min()),
        high=float(local.max()),
        start=float(sizes[large][0]),
    )


def measure_work(
    families: tuple[Family, ...] = FAMILIES,
    *,
    most: int | None = None,
    rounds: int = ROUNDS,
    clock: Callable[[], int] = time.thread_time_ns,
    progress: Callable[[int, int], None] | None = None,
) -> WorkChart:
    """Times ticks of scenes that grow, all in turn, on one core.

    Bodies at rest are measured with every variant, the others as the bridge runs them.

    Args:
        families: What grows.
        most: Largest size; None for all.
        rounds: How often every scene is run.
        clock: Time in ns; by default the thread's own, in which nothing else of the machine counts.
        progress: Called with the runs done and all of them.
    """
    jobs = [
        (family, variant, size)
        for family in families
        for size in family.sizes
        if most is None or size <= most
        for variant in (VARIANTS if family.name == "resting" else (USUAL,))
    ]
    scenes: dict[tuple[str, int], Scene] = {}
    times: dict[int, list[NDArray[np.float64]]] = {i: [] for i in range(len(jobs))}
    counts: dict[int, tuple[int, int, int]] = {}
    with one_core() as core:
        for turn in range(rounds):
            for index, (family, variant, size) in enumerate(jobs):
                if progress is not None:
                    progress(turn * len(jobs) + index, rounds * len(jobs))
                key = (family.name, size)
                if key not in scenes:
                    scenes[key] = family.build(size)
                times[index].append(tick_times(scenes[key], variant, clock))
                data = scenes[key].data
                counts[index] = int(data.ncon), int(data.nefc), int(scenes[key].model.nv)
        where = machine(core)
    if progress is not None:
        progress(rounds * len(jobs), rounds * len(jobs))
    points = []
    for index, (family, variant, size) in enumerate(jobs):
        spread = TimingStats.of(np.concatenate(times[index]))
        medians = [float(np.median(each)) for each in times[index]]
        contacts, rows, freedoms = counts[index]
        points.append(
            Work(
                family=family.name,
                variant=variant.name,
                size=size,
                contacts=contacts,
                rows=rows,
                freedoms=freedoms,
                time=spread,
                low=min(medians),
                high=max(medians),
                rate=TICK_SHARE / spread.p99,
            )
        )
    return WorkChart(tuple(points), where)
