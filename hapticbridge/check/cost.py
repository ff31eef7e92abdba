"""Processor cost of a scene: time of a tick, its stages, and its growth with contacts."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.case import SceneUnderCheck
from hapticbridge.check.observe import not_finite
from hapticbridge.check.version import SceneVariant
from hapticbridge.clock import LOWEST_RATE
from hapticbridge.demand.rehearsal import RunPoint, rehearsal_parameters
from hapticbridge.device import Motion
from hapticbridge.errors import SceneError
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.parameters import MAX_SCENE_TICKS
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step, publish, simulate
from hapticbridge.plotting import new_figure
from hapticbridge.recording import TAIL, Ring
from hapticbridge.recording.recorder import NOBODY_READS
from hapticbridge.scene import Scene
from hapticbridge.scene.fault import Fault
from hapticbridge.units import format_number, format_si

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Statistics of tick times

MIN_GROUP = 20
"""Smallest number of ticks with one count whose median is used."""


@dataclass(frozen=True, slots=True)
class TimingStats:
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
    def from_times(cls, times: NDArray[np.float64]) -> TimingStats:
        """Computes the distribution of times in s."""
        if not times.size:
            return cls(0, float("nan"), float("nan"))
        return cls(int(times.size), float(np.median(times)), float(np.percentile(times, 99)))


NOISE = 0.02
"""Share of a tick's time below which a difference is the machine's, no unit. A falling line of
medians would else be told as a negative growth."""


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

    @property
    def is_measurable(self) -> bool:
        """True if the times rise by more than ``NOISE`` from the lowest to the highest count."""
        if self.per_one is None:
            return False
        first, last = self.steps[0][0], self.steps[-1][0]
        return self.per_one * (last - first) > NOISE * self.steps[-1][2]


def growth_of(counts: NDArray[np.int64], times: NDArray[np.float64]) -> Growth:
    """Returns the median time by count, and a line weighted by the number of ticks.

    Both arrays have shape (n,); times are in s.
    """
    steps = []
    for count in np.unique(counts).tolist():
        those = times[counts == count]
        if those.size >= MIN_GROUP:
            steps.append((int(count), int(those.size), float(np.median(those))))
    if len(steps) < 2:
        return Growth(tuple(steps), None, None)
    x, n, y = (np.array(column, dtype=np.float64) for column in zip(*steps, strict=True))
    slope, base = np.polyfit(x, y, 1, w=np.sqrt(n))
    return Growth(tuple(steps), float(base), float(slope))


_TIMER = mujoco.mjtTimer
STAGES: dict[str, int] = {
    "kinematics": int(_TIMER.mjTIMER_POS_KINEMATICS),
    "inertia": int(_TIMER.mjTIMER_POS_INERTIA),
    "collision": int(_TIMER.mjTIMER_POS_COLLISION),
    "constraint rows": int(_TIMER.mjTIMER_POS_MAKE),
    "projection": int(_TIMER.mjTIMER_POS_PROJECT),
    "velocity": int(_TIMER.mjTIMER_VELOCITY),
    "actuation": int(_TIMER.mjTIMER_ACTUATION),
    "solver": int(_TIMER.mjTIMER_CONSTRAINT),
    "integration": int(_TIMER.mjTIMER_ADVANCE),
}
"""Stages of MuJoCo's step and the ids of its built-in timers; no stage contains another."""

REST, BRIDGE = "rest of the step", "bridge"
"""Step time that no timer covers; and time outside the step: coupling, energies, guard and
record."""

WARM_UP = 50
"""Number of ticks at the start that are not counted, because the caches are cold."""

PASSES = 2
"""Number of times that the motion is timed. The work of a tick is equal in each and disturbances
only add time, so each tick counts with its smallest time. ``hapticbridge doctor`` measures them."""

TICK_SHARE = 0.5
"""Share of a period that the tick's 99th percentile may fill, without unit. The rest is left for
the device's transfer and for late wake-ups, which cannot be measured here."""

_RING = 1 << 12  # records; without a reader the newest stay


@dataclass(frozen=True, slots=True)
class Cost:
    """Tick times of a scene on this machine, in s.

    Attributes:
        free: Whole ticks out of contact.
        contact: Whole ticks in contact.
        all_ticks: All whole ticks.
        stages: Median time of each stage, out of contact and in contact; nan if there was no such
            tick.
        highest_rate: Rate in Hz at which the 99th percentile of all ticks fills ``TICK_SHARE`` of a
            period.
        by_contacts: Growth with the number of contacts.
        by_rows: Growth with the number of constraint rows.
    """

    free: TimingStats
    contact: TimingStats
    all_ticks: TimingStats
    stages: dict[str, tuple[float, float]]
    highest_rate: float
    by_contacts: Growth
    by_rows: Growth

    def fault(self, case: SceneUnderCheck) -> Fault | None:
        """Returns a fault if this machine cannot hold the rate; None if it can."""
        rate = 1.0 / case.period
        if not self.highest_rate < rate:
            return None
        highest = math.floor(self.highest_rate)
        p99, left = self.all_ticks.p99, TICK_SHARE * case.period
        lower = f"and run with --rate {highest}; or " if highest >= LOWEST_RATE else ""
        ticks = math.ceil(self.all_ticks.p99 / (TICK_SHARE * case.period))
        beside = format_number(rate / min(max(ticks, 2), MAX_SCENE_TICKS), 3)
        return Fault(
            "rate",
            case.places.option("timestep"),
            f"cannot hold {rate:g} Hz here: 99 of 100 ticks take up to "
            f"{format_si(p99, 's')}; beside the device and late wake-ups {format_si(left, 's')} of "
            "a period are left for them",
            f"'hapticbridge run' lets it step beside the loop, with --scene-rate {beside}; or "
            f"{case.places.option_change('timestep', f'{1.0 / max(highest, 1):.3g}')} {lower}"
            "see with 'hapticbridge check --lean' what may go",
        )


def measure_cost(
    scene: Scene,
    samples: NDArray[np.void],
    setting: RunPoint,
    *,
    clock: Callable[[], int] = time.perf_counter_ns,
    progress: Callable[[int, int], None] | None = None,
) -> Cost:
    """Times a scene under its motion: whole ticks as in the live loop, then the stages.

    A tick is the bridge's arithmetic before and after MuJoCo's step, the step, and the hand-over of
    the record. Device and recorder are left out. Arguments are those of ``rehearse``. ``clock``
    returns the time in ns; ``progress`` is called with the number of ticks done and the total.

    Raises:
        SceneError: A value is out of range, or a result is not finite.
    """
    total = (PASSES + 1) * samples.size

    def report_progress(number: int) -> None:
        if progress is not None:
            progress(number * samples.size, total)

    passes = []
    for k in range(PASSES):
        report_progress(k)
        times, in_contact, rows = _time_ticks(scene, samples, setting, clock)
        passes.append(times[WARM_UP:])
    report_progress(PASSES)
    stages, touching = _time_stages(scene, samples, setting)
    report_progress(PASSES + 1)
    time_of, contacts_of = np.min(passes, axis=0), in_contact[WARM_UP:]
    is_free = contacts_of == 0
    free, contact = (
        TimingStats.from_times(time_of[is_free]),
        TimingStats.from_times(time_of[~is_free]),
    )
    all_ticks = TimingStats.from_times(time_of)
    medians = {
        name: (
            TimingStats.from_times(times[touching == 0]).median,
            TimingStats.from_times(times[touching > 0]).median,
        )
        for name, times in stages.items()
    }
    whole = [sum(each[k] for each in medians.values()) for k in (0, 1)]
    medians[BRIDGE] = (max(free.median - whole[0], 0.0), max(contact.median - whole[1], 0.0))
    return Cost(
        free=free,
        contact=contact,
        all_ticks=all_ticks,
        stages=medians,
        highest_rate=float(np.divide(TICK_SHARE, all_ticks.p99)),
        by_contacts=growth_of(contacts_of, time_of),
        by_rows=growth_of(rows[WARM_UP:], time_of),
    )


def _time_ticks(
    scene: Scene, samples: NDArray[np.void], setting: RunPoint, clock: Callable[[], int]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Returns time in s, contacts and constraint rows of every tick."""
    binding = BoundKernel(scene.model, scene.data, rehearsal_parameters(scene, setting))
    state, row, ring, period = binding.state, binding.row, Ring.local(_RING), setting.period
    ring.cursors[TAIL] = NOBODY_READS
    before = direct(before_step, state, samples[:1], row, 0, period)
    after = direct(after_step, state, row, 0)
    hand_over = direct(publish, row, ring.rows, ring.cursors, 0, 0, 0, 0, 0)
    step, model, data = binding.step, scene.model, scene.data
    records, cursors = ring.rows, ring.cursors
    times = np.zeros(samples.size)
    contacts, rows = np.zeros((2, samples.size), np.int64)
    singles = [samples[k : k + 1] for k in range(samples.size)]
    for k, sample in enumerate(singles):
        begin = clock()
        code = before(state, sample, row, 0, period)
        step(model, data)
        code = max(code, after(state, row, 0))
        hand_over(row, records, cursors, begin, begin, begin, begin, 0)
        times[k] = clock() - begin
        if code != OK:
            raise not_finite(scene, k, samples.size)
        contacts[k], rows[k] = (int(row["contacts"][0]), data.nefc)  # without near misses
    ring.close()
    return 1e-9 * times, contacts, rows


def _time_stages(
    scene: Scene, samples: NDArray[np.void], setting: RunPoint
) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.int64]]:
    """Returns the time in s of every stage of every step by MuJoCo's timers, and the contacts."""
    binding = BoundKernel(scene.model, scene.data, rehearsal_parameters(scene, setting))
    state, row, model, data = binding.state, binding.row, scene.model, scene.data
    step = binding.step
    spent = np.zeros((samples.size, int(_TIMER.mjNTIMER)))
    contacts = np.zeros(samples.size, np.int64)
    durations = data.timer.duration
    for k in range(samples.size):
        before_step(state, samples[k : k + 1], row, 0, setting.period)
        earlier = durations.copy()  # energies are refreshed after the step, by stages with timers
        step(model, data)
        spent[k] = durations - earlier
        after_step(state, row, 0)
        contacts[k] = int(row["contacts"][0])
    stages = {name: spent[WARM_UP:, timer] for name, timer in STAGES.items()}
    whole = spent[WARM_UP:, int(_TIMER.mjTIMER_STEP)]
    stages[REST] = np.maximum(whole - sum(stages.values()), 0.0)
    return stages, contacts[WARM_UP:]


# Plot of a scene's cost

_FREE, _CONTACT, _LINE = "tab:blue", "tab:orange", "0.3"
_MIN_SHARE = 0.01  # of the tick; smaller stages are not drawn


def _known(seconds: float) -> float:
    return seconds if math.isfinite(seconds) else 0.0


def draw_cost(cost: Cost, title: str) -> Figure:
    """Draws the stages of a tick and its growth with constraint rows."""
    figure = new_figure(8.0, 4.4)
    figure.suptitle(f"{title} (rate: p99 within {100 * TICK_SHARE:g} % of the period)")
    stages, growth = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    whole = max(_known(cost.free.median), _known(cost.contact.median))
    drawn = {
        name: times
        for name, times in cost.stages.items()
        if name == BRIDGE or max(map(_known, times)) >= _MIN_SHARE * whole
    }
    places = range(len(drawn))
    kinds = ((0, "out of contact", cost.free, _FREE), (1, "in contact", cost.contact, _CONTACT))
    for k, label, spread, colour in kinds:
        if spread.ticks:
            stages.barh(
                [place + 0.2 * (2 * k - 1) for place in places],
                [1e6 * times[k] for times in drawn.values()],
                height=0.38,
                color=colour,
                label=f"{label}: {1e6 * spread.median:.3g} µs, p99 {1e6 * spread.p99:.3g} µs",
            )
    stages.set_yticks(list(places), list(drawn))
    stages.invert_yaxis()
    stages.set_xlabel("median time per tick in µs")
    stages.set_title("where it goes", fontsize="medium")
    figure.legend(fontsize="small", loc="outside lower left", ncols=2)

    steps = cost.by_rows.steps
    growth.plot(
        [rows for rows, _, _ in steps],
        [1e6 * seconds for _, _, seconds in steps],
        "o",
        color=_LINE,
        label="median of a tick",
    )
    base, per_one = cost.by_rows.base, cost.by_rows.per_one
    if base is not None and per_one is not None:
        ends = [steps[0][0], steps[-1][0]]
        growth.plot(
            ends,
            [1e6 * (base + per_one * rows) for rows in ends],
            color=_LINE,
            label=f"{1e6 * base:.3g} µs + {1e6 * per_one:.2g} µs per row"
            if cost.by_rows.is_measurable
            else "no growth that can be measured",
        )
    growth.set_xlabel("constraint rows in the tick")
    growth.set_ylabel("median time per tick in µs")
    slowest = max((seconds for _, _, seconds in steps), default=0.0)
    growth.set_ylim(0.0, 1.15e6 * (slowest or whole))
    rate = math.floor(cost.highest_rate)
    growth.set_title(f"how it grows; up to {rate:,} Hz", fontsize="medium")
    if steps:
        growth.legend(fontsize="small", loc="lower right")
    else:
        growth.text(0.5, 0.5, "the motion is too short", ha="center", transform=growth.transAxes)
    return figure


# Costs of two versions measured side by side

CHUNKS = 40
"""Number of stretches into which a motion is cut. The two versions take turns after each, so that a
disturbance of the machine slows both. More stretches cost 20 µs each."""

REPEATS = 5
"""Largest number of passes. The work is equal in each and disturbances only add time, so each
stretch counts with its smallest time. Beside six other processes on two cores, a scene measured
against itself came out within 1 %; the median scattered twice as much."""

PATIENCE = 0.6
"""Processor time in s after which a comparison stops with fewer passes."""

CostMeter: TypeAlias = Callable[[SceneVariant, SceneVariant, Motion], tuple[float, float]]
"""Returns the processor time in s of each of two versions per second of motion."""


def processor_costs(
    first: SceneVariant, second: SceneVariant, motion: Motion
) -> tuple[float, float]:
    """Measures the processor time of two versions in s per second of motion.

    It covers MuJoCo's step and the bridge's arithmetic, by the thread's own clock. The first pass
    is a warm-up and is dropped if there are at least three.

    Raises:
        SceneError: A version does not compile, or a result is not finite.
    """
    stages = [VariantRun(draft, motion) for draft in (first, second)]
    passes: list[NDArray[np.float64]] = []
    start = time.thread_time()
    while len(passes) <= REPEATS:
        passes.append(one_pass(stages))
        if (time.thread_time() - start) * (1 + 1 / len(passes)) > PATIENCE:
            break
    kept = passes[1:] if len(passes) > 2 else passes
    seconds = np.min(kept, axis=0).sum(axis=1)
    return float(seconds[0] / motion.duration), float(seconds[1] / motion.duration)


class VariantRun:
    """A version of a scene that runs through a motion in stretches.

    Attributes:
        rows: Records of the run, ``TICK_DTYPE``.
    """

    def __init__(self, draft: SceneVariant, motion: Motion) -> None:
        """Compiles the scene; call ``reset`` before the first stretch."""
        self._scene = draft.compiled()
        self._setting = draft.setting
        self._samples = draft.samples(motion)
        self.rows = np.zeros(self._samples.size, TICK_DTYPE)
        self._edges = np.linspace(0, self._samples.size, CHUNKS + 1).astype(int)

    def reset(self) -> None:
        """Resets the scene."""
        parameters = rehearsal_parameters(self._scene, self._setting)
        self._binding = BoundKernel(self._scene.model, self._scene.data, parameters)

    def run(self, chunk: int) -> float:
        """Runs one stretch; returns its processor time in s.

        Raises:
            SceneError: A result is not finite.
        """
        binding, part = self._binding, slice(self._edges[chunk], self._edges[chunk + 1])
        rows = self.rows[part]
        start = time.thread_time()
        done = simulate(binding.state, self._samples[part], binding.row, rows)
        seconds = time.thread_time() - start
        if done < rows.size:
            raise SceneError(f"scene '{self._scene.name}' is not finite within the motion")
        return seconds


def one_pass(stages: list[VariantRun]) -> NDArray[np.float64]:
    """Runs all versions through the whole motion in turns; returns s by version and stretch."""
    for stage in stages:
        stage.reset()
    return np.array([[stage.run(chunk) for stage in stages] for chunk in range(CHUNKS)]).T
