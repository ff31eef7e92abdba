"""Measures a chart: every point judged once, then all timed side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from hapticbridge.check.observation import quiet
from hapticbridge.errors import HapticBridgeError, StudyError
from hapticbridge.study.chart.engine_run import EngineRun, PeerWork
from hapticbridge.study.chart.front import pareto_front
from hapticbridge.study.chart.measurement import Measurement
from hapticbridge.study.chart.score import Score
from hapticbridge.study.chart.setting import OWN, SHIPPED, Setting
from hapticbridge.study.chart.timing import REPEATS, interleaved_costs, machine, one_core
from hapticbridge.study.chart.workload import Panel, Run, Workload
from hapticbridge.study.engines.base import Engine
from hapticbridge.study.engines.library import open_engine

ORDER_POINTS = 3
"""How many of the smallest steps an order of convergence is fitted to."""

RESOLVED = 1e-5
"""Error in JND below which a reference's own error may count: no order is fitted to it."""


@dataclass(frozen=True, slots=True)
class Chart:
    """What was measured.

    Attributes:
        workload: What was simulated.
        measurements: One per point and panel; the points' order is that of the settings.
        skipped: What could not be simulated, by method or engine, and why.
        machine: Where it was measured, in words.
        baseline: The setting that ratios are to.
        notes: What else is to be known, a sentence each.
        engines: The other engines on it, by name, with their settings.
    """

    workload: Workload
    measurements: tuple[Measurement, ...]
    skipped: dict[str, str]
    machine: str
    baseline: str
    notes: tuple[str, ...] = ()
    engines: Mapping[str, Engine] = field(default_factory=dict)

    def of(self, panel: Panel) -> list[Measurement]:
        """Returns the points of a panel."""
        return [each for each in self.measurements if each.panel == panel.key]

    def front(self, panel: Panel) -> list[Measurement]:
        """Returns the Pareto front, cheapest first.

        Of the points that are sound and render the coupling that was asked for: a weld, or a tool
        that is where the handle is, renders another one, however well it converges.
        """
        points = [each for each in self.of(panel) if each.is_sound and each.setting.method.has_law]
        chosen = pareto_front(
            [each.cost.median for each in points], [each.score.felt for each in points]
        )
        return [points[index] for index in chosen]

    def orders(self, panel: Panel) -> dict[str, float]:
        """Returns by method the power of the period that its error goes with."""
        return convergence_orders(self.of(panel))


def convergence_orders(points: Sequence[Measurement]) -> dict[str, float]:
    """Fits felt ~ T^p to the smallest steps of each method, all else as usual.

    Returns:
        p by method or engine; nan where there are fewer than three points, or an error is below
        ``RESOLVED``.
    """
    series: dict[str, list[tuple[float, float]]] = {}
    for each in points:
        if each.is_usual:
            value = (each.setting.period, each.score.felt)
            series.setdefault(who(each.setting), []).append(value)
    found = {}
    for name, values in series.items():
        period, felt = np.array(sorted(values)[:ORDER_POINTS]).T
        is_clear = period.size == ORDER_POINTS and np.isfinite(felt).all()
        is_clear = bool(is_clear and (felt > RESOLVED).all())
        found[name] = (
            float(np.polyfit(np.log(period), np.log(felt), 1)[0]) if is_clear else float("nan")
        )
    return found


def who(setting: Setting) -> str:
    """Returns the method's name, or the engine's where it is another."""
    return setting.method.name if setting.engine == OWN else setting.engine


def measure_chart(
    workload: Workload,
    settings: Sequence[Setting],
    *,
    repeats: int = REPEATS,
    progress: Callable[[int, int], None] | None = None,
) -> Chart:
    """Judges and times every setting.

    A setting that the workload cannot be rendered by is left out and named in ``skipped``; one that
    diverges, or whose engine fails on the way, stays in.

    Args:
        workload: What to simulate.
        settings: How.
        repeats: Rounds of timing at most.
        progress: Called with steps done and all of them.

    Raises:
        StudyError: No setting could be simulated.
    """
    total = len(settings) * (1 + repeats)

    def tell(done: int) -> None:
        if progress is not None:
            progress(min(done, total), total)

    runs: list[tuple[Setting, Run, dict[str, Score]]] = []
    skipped: dict[str, str] = {}
    peer_work = cache(workload.peer_work)
    # the chart tells of every run that diverges; MuJoCo need not
    with quiet(), one_core() as core:
        for index, setting in enumerate(settings):
            tell(index)
            try:
                run = _opened(workload, setting, peer_work)
                runs.append((setting, run, dict(run.scores())))
            except HapticBridgeError as error:
                skipped.setdefault(who(setting), str(error))
        if not runs:
            raise StudyError(
                f"workload '{workload.name}': no point could be simulated; first: "
                f"{next(iter(skipped.values()), 'no setting')}"
            )
        baseline = _baseline(
            [setting for setting, _, _ in runs],
            {i for i, (_, _, scores) in enumerate(runs) if _has_failed(scores)},
        )
        costs = interleaved_costs(
            [run for _, run, _ in runs],
            baseline,
            repeats=repeats,
            progress=lambda done: tell(len(settings) + done),
        )
        where = machine(core)
    tell(total)
    measurements = tuple(
        Measurement(panel.key, setting, cost, scores[panel.key], run.chosen)
        for panel in workload.panels
        for (setting, run, scores), cost in zip(runs, costs, strict=True)
        # what another engine converges to is no error of its own
        if panel.is_truth or setting.engine == OWN
    )
    label = runs[baseline][0].label
    engines = {each.engine.name: each.engine for _, each, _ in runs if isinstance(each, EngineRun)}
    return Chart(workload, measurements, skipped, where, label, tuple(_notes(workload)), engines)


def _opened(workload: Workload, setting: Setting, peer_work: Callable[[], PeerWork]) -> Run:
    if setting.engine == OWN:
        return workload.run(setting)
    return EngineRun(open_engine(setting.engine), peer_work(), setting)


def _has_failed(scores: Mapping[str, Score]) -> bool:
    return any(score.verdict == "failed" for score in scores.values())


def _baseline(settings: Sequence[Setting], failed: Set[int]) -> int:
    """Returns the index of ``implicit`` at the period nearest to 1 ms, or what comes nearest."""

    def distance(index: int) -> tuple[bool, bool, bool, float]:
        setting = settings[index]
        is_plain = setting.substeps == 1 and setting.contact == SHIPPED
        return (
            index in failed,  # it may not have been timed
            setting.engine != OWN or setting.method.name != "implicit",
            not (is_plain and setting.iterations is None),
            abs(np.log(setting.period / 1e-3)),
        )

    return min(range(len(settings)), key=distance)


def _notes(workload: Workload) -> Iterator[str]:
    apart = {} if workload.references is None else workload.references.disagreement()
    if apart:
        listed = ", ".join(f"{name} {felt:.2g}" for name, felt in apart.items())
        yield (
            "How far the methods' own limits lie from that of the first method, in JND: "
            f"{listed}. Limits that agree are those of one model; a limit far away is another "
            "model's, however well its method converges."
        )
