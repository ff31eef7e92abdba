"""Measures a chart: every point judged once, then all timed side by side. Workloads by name."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.errors import HapticBridgeError, StudyError
from hapticbridge.kernel.mujoco_c import quiet
from hapticbridge.lab.chart import contact_bodies, free_bodies, peg, resting_bodies, scene_run
from hapticbridge.lab.chart.engine_run import EngineRun
from hapticbridge.lab.chart.scene_run import Workload
from hapticbridge.lab.chart.score import PASSIVE, Panel, PeerWork, Run, Score
from hapticbridge.lab.chart.setting import OWN, Setting, simulator_name
from hapticbridge.lab.engines.base import Engine, open_engine
from hapticbridge.run.description import processor

# Workloads by name


@dataclass(frozen=True, slots=True)
class Extent:
    """Time steps of a chart that a workload depends on.

    Attributes:
        grid: Longest period T in s; runs are compared at its multiples.
        finest: Shortest period T in s.
    """

    grid: float
    finest: float


def open_workload(name: str, extent: Extent) -> Workload:
    """Returns a workload by its name, or by that of a scene.

    Raises:
        HapticBridgeError: There is no such scene, or it has no hand path.
    """
    grid, finest = extent.grid, extent.finest
    known: dict[str, Callable[[], Workload]] = {
        "hex_socket": lambda: resting_bodies.HexSocket(resting_bodies.KEY_COUPLING, grid, finest),
        "jam": lambda: peg.Jam(grid),
        "spring_arm": lambda: free_bodies.SpringArm(free_bodies.COUPLING, grid),
        "stack": lambda: resting_bodies.Stack(free_bodies.COUPLING, grid, finest),
        "tap": lambda: contact_bodies.Tap(free_bodies.COUPLING, grid, finest),
        "point_mass": lambda: free_bodies.DrivenMass(scene_run.COUPLING, grid, finest),
        "peg_in_hole": lambda: peg.PegInHole(peg.COUPLING, grid, finest),
        "rod_impact": lambda: contact_bodies.RodImpact(contact_bodies.ROD_COUPLING, grid),
        "sliding_block": lambda: contact_bodies.SlidingBlock(
            contact_bodies.BLOCK_COUPLING, grid, finest
        ),
        "spinning_body": lambda: free_bodies.SpinningBody(free_bodies.COUPLING, grid, finest),
    }
    if name in known:
        return known[name]()
    return scene_run.SceneMotion(name, scene_run.COUPLING, grid, finest)


# Points of a chart


def pareto_front(costs: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Returns the indices of the points that no other point beats, cheapest first.

    A point is beaten by one that costs no more and errs no more, and less in one of the two. Of
    equal points the first stays. Points with a cost or an error that is not finite are never on
    the front.

    Args:
        costs: One per point.
        errors: One per point.
    """
    points = np.stack([np.asarray(costs, float), np.asarray(errors, float)], axis=-1)
    order = [i for i in np.lexsort(points.T[::-1]) if np.isfinite(points[i]).all()]
    front: list[int] = []
    least = np.inf
    for index in order:
        if points[index, 1] < least:
            least = points[index, 1]
            front.append(int(index))
    return front


REPEATS = 7
"""Largest number of rounds. Three disturbed rounds do not move the median of seven."""

MIN_REPEATS = 3
"""Smallest number of rounds, however long they take: a median needs them."""

PATIENCE = 45.0
"""Time in s after which no new round begins."""

SEED = 7
"""Seed of the order within a round, so that no point always follows the same other one."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Processor time in s per simulated second.

    Attributes:
        median: Over the rounds; nan where a run failed before it could be timed.
        low: Smallest.
        high: Largest.
        ratio: Median of the ratio to the baseline, each taken within one round; no unit.
        ratio_low: Smallest ratio.
        ratio_high: Largest ratio.
        repeats: Number of rounds.
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
    """Keeps this thread on one core; yields its number, None if the system has no such call."""
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
    """Returns the name of the machine and of the measured core."""
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
    """Runs all in rounds, in another order each round, so that a disturbance affects every run.

    The runs were executed once before, which warmed them up.

    Args:
        runs: Functions to time.
        baseline: Index of the run that ratios refer to.
        repeats: Largest number of rounds, >= 1.
        patience: Time in s after which no further round begins, from the third round on.
        clock: Time in s.
        progress: Called with the number of runs done.
    """
    generator = np.random.default_rng(SEED)
    rounds: list[NDArray[np.float64]] = []
    start, done = clock(), 0
    while len(rounds) < repeats:
        if len(rounds) >= min(MIN_REPEATS, repeats) and clock() - start > patience:
            break
        costs = np.zeros(len(runs))
        for index in generator.permutation(len(runs)):
            costs[index] = runs[index].run() / runs[index].seconds
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
    """Returns median, smallest and largest of the timed rounds; nan without any."""
    known = values[np.isfinite(values)]
    if not known.size:
        return (float("nan"),) * 3
    return float(np.median(known)), float(known.min()), float(known.max())


@dataclass(frozen=True, slots=True)
class Measurement:
    """One point in one panel.

    Attributes:
        panel: Key of the panel.
        setting: Setting of the simulation.
        cost: Processor time.
        score: Errors.
        chosen: Contacts and solver of the engine, by name.
        limit_apart: Where errors are counted from each method's own limit: the distance in JND of
            that limit from the central one (``OwnReferences``). 0 where they are counted from the
            truth.
    """

    panel: str
    setting: Setting
    cost: Cost
    score: Score
    chosen: Mapping[str, str | int] = field(default_factory=dict)
    limit_apart: float = 0.0

    @property
    def is_comparable(self) -> bool:
        """True if its error can be compared with those of other methods.

        An error below the distance between the methods' references cannot be compared.
        """
        return not self.score.jnd < self.limit_apart

    @property
    def is_sound(self) -> bool:
        """True if the environment was passive and the run stayed in contact."""
        return self.score.verdict in PASSIVE

    @property
    def is_usual(self) -> bool:
        """True if nothing but method and period was chosen."""
        setting = self.setting
        is_plain = setting.has_usual_contact and setting.iterations is None
        return is_plain and setting.substeps == 1 and not setting.scene_ticks

    def cells(self, workload: str, coupling: Coupling) -> dict[str, object]:
        """Returns the row of a table with every choice and every number."""
        setting, method = self.setting, self.setting.method
        used = method.law_coupling(coupling, setting.timestep)
        return {
            "workload": workload,
            "panel": self.panel,
            "engine": setting.engine,
            "method": method.name,
            "integrator": method.integrator,
            "period_s": setting.period,
            "substeps": setting.substeps,
            "scene_ticks": setting.scene_ticks,
            "timestep_s": setting.timestep,
            "contact": setting.contact_name,
            **self.chosen,
            "stiffness": coupling.stiffness,
            "damping": coupling.damping,
            "rotational_stiffness": coupling.rotational_stiffness,
            "rotational_damping": coupling.rotational_damping,
            "damping_used": used.damping,
            "rotational_damping_used": used.rotational_damping,
            **{f"cost_{name}": value for name, value in asdict(self.cost).items()},
            **{f"error_{name}": value for name, value in asdict(self.score).items()},
            "limit_apart": self.limit_apart,
        }


RESOLVED = 1e-5
"""Error in JND that the reference's own error may reach, no unit. Smaller errors give no order. It
is five times the error of the tumbling body's reference."""

SETTLED = 0.1
"""Difference of the powers over the two smallest halvings up to which an order counts as settled,
no unit. A method of order p whose next term is of order p + 1 is within it if that term is less
than a tenth of the error. A larger difference would accept the slope of a knee as an order."""

LEVEL = 0.1
"""Settled powers up to this value count as none, no unit: the error does not shrink with the
step."""


@dataclass(frozen=True, slots=True)
class Order:
    """Order of convergence of a method, from its three smallest resolved steps.

        p = log(felt_2/felt_1) / log(T_2/T_1),   T_1 < T_2 < T_3

    Attributes:
        power: p between the two smaller steps, no unit.
        before: p between the two larger ones.
        finest: T_1 in s.
        coarsest: T_3 in s.
    """

    power: float
    before: float
    finest: float
    coarsest: float

    @property
    def is_settled(self) -> bool:
        """True if both powers agree; else the steps are too large for an order."""
        return abs(self.power - self.before) <= SETTLED

    @property
    def is_level(self) -> bool:
        """True if the error stays constant: it is then the model's, not the step's."""
        return self.is_settled and abs(self.power) <= LEVEL

    @property
    def words(self) -> str:
        """Text of the order for a picture; empty if the steps do not settle it."""
        if self.is_level:
            return "level"
        return f"order {self.power:.1f}" if self.is_settled else ""


def convergence_orders(points: Sequence[Measurement]) -> dict[str, Order]:
    """Returns the orders by method or engine, from points with nothing but the period chosen.

    A method is left out if fewer than three of its steps have an error that is finite and at least
    ``RESOLVED``.
    """
    series: dict[str, list[tuple[float, float]]] = {}
    for each in points:
        jnd = each.score.jnd
        if each.is_usual and math.isfinite(jnd) and jnd >= RESOLVED:
            series.setdefault(simulator_name(each.setting), []).append((each.setting.period, jnd))
    return {name: _order(sorted(values)[:3]) for name, values in series.items() if len(values) > 2}


def _order(steps: Sequence[tuple[float, float]]) -> Order:
    (finest, first), (middle, second), (coarsest, third) = steps
    return Order(
        power=math.log(second / first) / math.log(middle / finest),
        before=math.log(third / second) / math.log(coarsest / middle),
        finest=finest,
        coarsest=coarsest,
    )


@dataclass(frozen=True, slots=True)
class Chart:
    """Result of a measurement.

    Attributes:
        workload: The simulated workload.
        measurements: One per point and panel, in the order of the settings.
        skipped: Reason for each method or engine that could not simulate the workload.
        machine: Description of the machine.
        baseline: Setting that ratios refer to.
        notes: Further remarks, one sentence each.
        engines: The other engines by name, with their settings.
    """

    workload: Workload
    measurements: tuple[Measurement, ...]
    skipped: dict[str, str]
    machine: str
    baseline: str
    notes: tuple[str, ...] = ()
    engines: Mapping[str, Engine] = field(default_factory=dict)

    def points_of(self, panel: Panel) -> list[Measurement]:
        """Returns the points of a panel."""
        return [each for each in self.measurements if each.panel == panel.key]

    def front(self, panel: Panel) -> list[Measurement]:
        """Returns the Pareto front, cheapest first.

        Its points are sound and comparable, and render the requested coupling. A weld, or a tool at
        the handle's place, renders another coupling, however well it converges.
        """
        points = [
            each
            for each in self.points_of(panel)
            if each.is_sound and each.is_comparable and each.setting.method.has_law
        ]
        chosen = pareto_front(
            [each.cost.median for each in points], [each.score.jnd for each in points]
        )
        return [points[index] for index in chosen]

    def orders(self, panel: Panel) -> dict[str, Order]:
        """Returns the order of convergence by method."""
        return convergence_orders(self.points_of(panel))


def measure_chart(
    workload: Workload,
    settings: Sequence[Setting],
    *,
    repeats: int = REPEATS,
    progress: Callable[[int, int], None] | None = None,
) -> Chart:
    """Judges and times every setting.

    A setting that cannot render the workload is left out and named in ``skipped``. A setting that
    diverges, or whose engine fails on the way, stays in.

    Args:
        workload: The workload.
        settings: Settings to simulate.
        repeats: Largest number of rounds of timing.
        progress: Called with the finished and all steps.

    Raises:
        StudyError: No setting could be simulated.
    """
    total = len(settings) * (1 + repeats)

    def report_progress(done: int) -> None:
        if progress is not None:
            progress(min(done, total), total)

    runs: list[tuple[Setting, Run, dict[str, Score]]] = []
    skipped: dict[str, str] = {}
    peer_work = cache(workload.peer_work)
    # the chart reports every run that diverges; MuJoCo's warnings would repeat it
    with quiet(), one_core() as core:
        for index, setting in enumerate(settings):
            report_progress(index)
            try:
                run = _opened(workload, setting, peer_work)
                runs.append((setting, run, dict(run.scores())))
            except HapticBridgeError as error:
                skipped.setdefault(simulator_name(setting), str(error))
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
            progress=lambda done: report_progress(len(settings) + done),
        )
        where = machine(core)
    report_progress(total)
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
        # the limit of another engine includes its model, so it is not its own error
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
    """Returns the index of ``implicit`` at the period nearest to 1 ms, or of its substitute."""

    def distance(index: int) -> tuple[bool, bool, bool, float]:
        setting = settings[index]
        is_plain = setting.substeps == 1 and setting.has_usual_contact
        return (
            index in failed,  # it may be without a time
            setting.engine != OWN or setting.method.name != "implicit",
            not (is_plain and setting.iterations is None),
            abs(np.log(setting.period / 1e-3)),
        )

    return min(range(len(settings)), key=distance)


def _notes(apart: Mapping[str, float]) -> Iterator[str]:
    if len(apart) > 1:
        central = min(apart, key=lambda name: apart[name])
        listed = ", ".join(f"{name} {jnd:.2g}" for name, jnd in apart.items() if name != central)
        yield (
            f"How far the methods' own limits lie from that of {central}, in JND: {listed}. A "
            "point that is nearer to its own limit than that limit is to this one cannot be "
            "compared: it is drawn pale, and is neither on the front nor recommended."
        )
