"""Made-up points of a chart, and runs that cost what a test says."""

from __future__ import annotations

from collections.abc import Mapping

from hapticbridge.lab.chart.catalogue import Extent, open_workload
from hapticbridge.lab.chart.chart import Chart, Cost, Measurement, measure_chart
from hapticbridge.lab.chart.setting import SHIPPED, Setting
from hapticbridge.lab.chart.workload import Score, Verdict
from hapticbridge.lab.methods import METHODS


def made_up(
    cost: float,
    felt: float,
    *,
    method: str = "implicit",
    period: float = 1e-3,
    verdict: Verdict = "strict",
    spread: float = 0.0,
    contact: str = SHIPPED,
    substeps: int = 1,
    iterations: int | None = None,
    limit_apart: float = 0.0,
) -> Measurement:
    """Returns a point of panel ``panel`` that costs and errs as said."""
    return Measurement(
        "panel",
        Setting(METHODS[method], period, substeps, contact, iterations),
        Cost(cost, cost * (1 - spread), cost * (1 + spread), 1.0, 1.0, 1.0, 3),
        Score(jnd=felt, created=0.0, verdict=verdict),
        limit_apart=limit_apart,
    )


class FakeRun:
    """A run that takes the times that it is given, one after the other."""

    def __init__(self, *times: float, seconds: float = 1.0) -> None:
        self.seconds = seconds
        self._times = list(times)
        self.calls = 0

    @property
    def chosen(self) -> Mapping[str, str | int]:
        """Returns no choice."""
        return {}

    def go(self) -> float:
        """Returns the next of its times."""
        self.calls += 1
        return self._times[(self.calls - 1) % len(self._times)]

    def scores(self) -> Mapping[str, Score]:
        """Judges nothing."""
        return {}


def small_chart() -> Chart:
    """Returns a small chart: a good method, and one that a step of 20 ms throws out of bounds."""
    workload = open_workload("point_mass", Extent(0.02, 1e-3))
    settings = [
        Setting(METHODS[name], period)
        for name in ("implicit", "explicit")
        for period in (0.02, 2e-3, 1e-3)
    ]
    return measure_chart(workload, settings, repeats=1)
