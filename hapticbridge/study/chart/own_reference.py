"""A method against itself at a far smaller step: how far it has converged, and to what."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.perception import felt_error
from hapticbridge.errors import HapticBridgeError, StudyError
from hapticbridge.kernel.tick import simulate
from hapticbridge.record import TICK_DTYPE
from hapticbridge.rendering import METHODS, Method
from hapticbridge.study.chart.scene_run import Stage, Stages, Take
from hapticbridge.study.chart.score import NAN, Score, diverged, score_of
from hapticbridge.study.chart.setting import OWN, Setting

REFINEMENT = 32
"""How many times smaller the reference's step is than the smallest step of the chart."""

TOUCHING = 0.5
"""Share of the reference's instants in contact that a run must share, or it has lost contact."""


@dataclass(frozen=True, slots=True)
class OwnReference:
    """A method's own limit at small steps.

    Attributes:
        records: ``TICK_DTYPE`` at whole multiples of the chart's longest period.
        period: Of the reference in s.
    """

    records: NDArray[np.void]
    period: float


class OwnReferences:
    """The reference of each method, computed when it is first asked for.

    Args:
        stages: Where it runs.
        grid: Longest period of the chart in s.
        finest: Shortest period of the chart in s.
        duration: How much of the motion is compared, in s.
        refinement: How many times smaller than ``finest`` the step is.
    """

    def __init__(
        self,
        stages: Stages,
        grid: float,
        finest: float,
        duration: float,
        refinement: int = REFINEMENT,
    ) -> None:
        self._stages, self._grid = stages, grid
        self._period, self._count = finest / refinement, round(duration / grid)
        self._found: dict[str, OwnReference | None] = {}

    def of(self, method: Method) -> OwnReference | None:
        """Returns a method's reference; None where it diverges even at this step."""
        if method.name not in self._found:
            setting = Setting(method, self._period)
            stage = self._stages.for_method(setting)
            records = fine_records(stage, setting, self._grid, self._count)
            self._found[method.name] = (
                None if records is None else OwnReference(records, self._period)
            )
        return self._found[method.name]

    def score(self, take: Take) -> Score:
        """Compares the first part of a take with the same method at the small step."""
        if take.setting.engine != OWN:
            return Score(felt=NAN)  # not on the chart
        reference = self.of(take.setting.method)
        if take.has_diverged:
            return diverged(take.created, take.ended)
        if reference is None:
            return Score(felt=NAN, created=take.created, verdict=take.environment)
        records = take.at(self._grid)[: self._count]
        touches = reference.records["contacts"] > 0
        has_lost = touches.any() and np.mean(records["contacts"][touches] > 0) < TOUCHING
        return score_of(
            reference.records,
            records,
            created=take.created,
            verdict="lost contact" if has_lost else take.environment,
        )

    def disagreement(self) -> dict[str, float]:
        """Returns how far each method's limit is from the central one in JND, 0 for that one.

        Central is the limit whose median distance to all is least: the one that most agree on. It
        is that of a method that renders the coupling that was asked for, if there is one.
        Where limits agree, they are likely the motion of the model; where not, at most one is.
        """
        found = {name: each.records for name, each in self._found.items() if each is not None}
        centers = [name for name in found if METHODS[name].has_law] or list(found)
        apart = [
            {name: felt_error(found[center], each).felt for name, each in found.items()}
            for center in centers
        ]
        return min(apart, key=lambda row: float(np.median(list(row.values()))), default={})


def fine_records(
    stage: Stage, setting: Setting, grid: float, count: int
) -> NDArray[np.void] | None:
    """Runs a stage and keeps one record per ``grid`` s; None where it diverges.

    The memory of a million ticks is not needed: the run goes from one instant to the next.

    Raises:
        StudyError: The method cannot render the scene, or ``grid`` is no multiple of the period.
    """
    every = round(grid / setting.period)
    if abs(every * setting.period / grid - 1) > 1e-9:
        raise StudyError(f"{grid:g} s is no whole number of periods of {setting.period:g} s")
    try:
        binding = stage.bound(setting)
    except HapticBridgeError as error:
        raise StudyError(f"no reference for '{setting.method.name}': {error}") from None
    kept, rows = np.zeros(count, TICK_DTYPE), np.zeros(every, TICK_DTYPE)
    for k in range(count):
        times = setting.period * np.arange(k * every + 1.0, (k + 1) * every + 1)
        if simulate(binding.state, stage.samples_at(times), binding.row, rows) < every:
            return None
        kept[k] = rows[-1]
    return kept
