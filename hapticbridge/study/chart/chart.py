"""Measures a chart: every point judged once, then all timed side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from hapticbridge.check.observe import quiet
from hapticbridge.errors import HapticBridgeError, StudyError
from hapticbridge.study.chart.convergence import Order, convergence_orders
from hapticbridge.study.chart.engine_run import EngineRun, PeerWork
from hapticbridge.study.chart.front import pareto_front
from hapticbridge.study.chart.measurement import Measurement
from hapticbridge.study.chart.score import Score
from hapticbridge.study.chart.setting import OWN, SHIPPED, Setting, who
from hapticbridge.study.chart.timing import REPEATS, interleaved_costs, machine, one_core
from hapticbridge.study.chart.workload import Panel, Run, Workload
from hapticbridge.study.engines.base import Engine
from hapticbridge.study.engines.library import open_engine


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

        Of the points that are sound and comparable, and render the coupling that was asked for: a
        weld, or a tool that is where the handle is, renders another one, however well it converges.
        """
        points = [
            each
            for each in self.of(panel)
            if each.is_sound and each.is_comparable and each.setting.method.has_law
        ]
        chosen = pareto_front(
            [each.cost.median for each in points], [each.score.felt for each in points]
        )
        return [points[index] for index in chosen]

    def orders(self, panel: Panel) -> dict[str, Order]:
        """Returns by method how its error goes with the period."""
        return convergence_orders(self.of(panel))


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
    apart = {} if workload.references is None else workload.references.disagreement()
    measurements = tuple(
        Measurement(
            panel.key,
            setting,
            cost,
            scores[panel.key],
            run.chosen,
            limit_apart=0.0 if panel.is_truth else apart.get(setting.method.name, 0.0),
        )
        for panel in workload.panels
        for (setting, run, scores), cost in zip(runs, costs, strict=True)
        # what another engine converges to is no error of its own
        if panel.is_truth or setting.engine == OWN
    )
    label = runs[baseline][0].label
    engines = {each.engine.name: each.engine for _, each, _ in runs if isinstance(each, EngineRun)}
    return Chart(workload, measurements, skipped, where, label, tuple(_notes(apart)), engines)


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


def _notes(apart: Mapping[str, float]) -> Iterator[str]:
    if len(apart) > 1:
        central = min(apart, key=lambda name: apart[name])
        listed = ", ".join(f"{name} {felt:.2g}" for name, felt in apart.items() if name != central)
        yield (
            "How far the methods' own limits lie from the one that most of them are near, that of "
            f"{central}, in JND: {listed}. A point that is nearer to its own limit than that limit "
            "is to the others cannot be compared with them: it is drawn pale, and is neither on "
            "the front nor recommended."
        )
