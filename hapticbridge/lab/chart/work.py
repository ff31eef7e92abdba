"""Cost against work: growth of a tick's time with a scene, and a scene's rate beside the loop."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hapticbridge.bridge import Bridge
from hapticbridge.check.cost import TICK_SHARE, WARM_UP, TimingStats
from hapticbridge.clock import SimulatedClock
from hapticbridge.errors import HapticBridgeError, StudyError
from hapticbridge.hands import Grasp
from hapticbridge.jit import direct
from hapticbridge.kernel.mujoco_c import without_timers
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step
from hapticbridge.lab.chart.chart import machine, one_core
from hapticbridge.lab.chart.output import PICTURES, csv_text, write_files
from hapticbridge.lab.chart.scene_run import COUPLING
from hapticbridge.lab.maps.base import scene_of
from hapticbridge.lab.methods import METHODS
from hapticbridge.plotting import new_figure
from hapticbridge.record import SAMPLE_DTYPE
from hapticbridge.recording.recorder import RingObserver
from hapticbridge.rendering import (
    IMPLICIT,
    LOSSLESS_COUPLING,
    Method,
    default_method,
    unguarded_parameters,
)
from hapticbridge.scene import Scene

PERIOD = 1e-3
"""Period T in s."""

TICKS = 300
"""Number of ticks of a run; the first ``WARM_UP`` do not count."""

LONGEST = 2.0
"""Time in s after which a run ends early. Such a scene is far too slow for 1 kHz."""

SHAKE = 1e-3
"""Descent of the handle in m, at 5 Hz. It presses a tool on the floor, which thus never sleeps."""


@dataclass(frozen=True, slots=True)
class Variant:
    """A way to step a scene.

    Attributes:
        name: Name in tables.
        has_islands: True if MuJoCo divides the scene into islands that are solved separately.
        method: Rendering method; None for the default.
        is_bare: True if MuJoCo's step runs alone, without the bridge's arithmetic and with the
            timers of its stages, which a run turns off.
        sleeps: True if MuJoCo lets bodies at rest sleep. The bridge refuses that (a sleeping tool
            would not feel its coupling), so it is measured with the bare step.
    """

    name: str
    has_islands: bool = True
    method: Method | None = None
    is_bare: bool = False
    sleeps: bool = False


USUAL = Variant("bridge")
METHOD_VARIANTS = (
    USUAL,
    Variant("bridge, implicit", method=IMPLICIT),
    Variant("bridge, contacts of the scene", method=LOSSLESS_COUPLING.with_contact("scene")),
    Variant("explicit", method=METHODS["explicit"]),
)
"""Methods whose cost is compared as bodies and contacts grow."""

ALONE = Variant("MuJoCo's step alone", is_bare=True)
"""Measure of what a tick costs more."""

VARIANTS = (
    *METHOD_VARIANTS,
    Variant("bridge, islands off", has_islands=False),
    ALONE,
    Variant("MuJoCo's step alone, with sleep", is_bare=True, sleeps=True),
)


def tick_times(
    scene: Scene, variant: Variant, clock: Callable[[], int], substeps: int = 1
) -> NDArray[np.float64]:
    """Returns the time of each tick in s, for whole ticks of the live loop.

    Args:
        scene: Scene; reset first.
        variant: Way to step it.
        clock: Time in ns.
        substeps: MuJoCo steps per tick.

    Raises:
        SceneError: The scene cannot be rendered.
    """
    model, data = scene.model, scene.data
    with _flags(model, variant), nullcontext() if variant.is_bare else without_timers():
        method = variant.method or default_method(substeps)
        parameters = unguarded_parameters(scene, COUPLING, PERIOD, substeps, method)
        scene.reset()
        binding = BoundKernel(model, data, parameters)
        state, row = binding.state, binding.row
        samples = np.zeros(TICKS, SAMPLE_DTYPE)
        phase = 2 * np.pi * 5.0 * PERIOD * np.arange(1.0, TICKS + 1)
        samples["position"][:, 2] = -SHAKE / 2 * (1 - np.cos(phase))
        samples["quaternion"][:, 0] = 1.0
        before = direct(before_step, state, samples[:1], row, 0, PERIOD)
        after = direct(after_step, state, row, 0)
        step, times = mujoco.mj_step if variant.is_bare else binding.step, np.zeros(TICKS)
        started, done = clock(), 0
        for k in range(TICKS):
            sample = samples[k : k + 1]
            if variant.is_bare:
                before(state, sample, row, 0, PERIOD)
                begin = clock()
                step(model, data)
                times[k] = clock() - begin
            else:
                begin = clock()
                for substep in range(substeps):
                    before(state, sample, row, substep, PERIOD)
                    step(model, data)
                    after(state, row, substep)
                times[k] = clock() - begin
            done = k + 1
            if clock() - started > 1e9 * LONGEST and done > 2 * WARM_UP:
                break
    return 1e-9 * times[WARM_UP:done]


@contextmanager
def _flags(model: mujoco.MjModel, variant: Variant) -> Iterator[None]:
    before = int(model.opt.disableflags), int(model.opt.enableflags)
    if not variant.has_islands:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    if variant.sleeps:
        model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    try:
        yield
    finally:
        model.opt.disableflags, model.opt.enableflags = before


SPACING = 0.05
"""Distance in m between the bodies of a scene; none touches its neighbour."""

FOOT = 2e-3
"""Radius in m of the balls under a plate, one contact each."""

BALL = 0.01
"""Radius in m of a ball, and half the edge of a box."""

MOST = 200_000
"""Largest number of triangles; more take MuJoCo minutes to compile."""

_FRAME = """
<mujoco model="{name}">
  <option gravity="0 0 {gravity}" cone="elliptic"><flag diagexact="enable"/></option>
  <default>
    <geom solref="0.002 1" solimp="0.9 0.95 0.001 0.5 2" friction="0.4 0 0" condim="3"/>
  </default>
  {assets}
  <worldbody>
    {bodies}
  </worldbody>
</mujoco>"""


SUBSTEPS = "substeps"
"""Name of the family whose count is that of MuJoCo's steps per tick, and not of the scene."""


@dataclass(frozen=True, slots=True)
class Family:
    """Scenes that differ in one count.

    Attributes:
        name: Name in tables.
        unit: Counted items.
        about: Description of the scenes in a sentence.
        sizes: The counts.
        build: Returns the scene of a count.
        variants: Ways to step it.
    """

    name: str
    unit: str
    about: str
    sizes: tuple[int, ...]
    build: Callable[[int], Scene]
    variants: tuple[Variant, ...] = (USUAL,)

    def substeps(self, size: int) -> int:
        """Returns the MuJoCo steps per tick at a size."""
        return size if self.name == SUBSTEPS else 1


def floating(count: int) -> Scene:
    """Returns ``count`` free balls, the tool among them, that touch nothing."""
    return _scene("bodies", _tool_ball() + _others(count - 1, _ball), gravity=0.0)


def plate(count: int) -> Scene:
    """Returns a tool on ``count`` feet, in a rectangle as near to a square as possible."""
    _check(count, 100_000)
    # a full rectangle: a body with feet on one side only would tilt
    rows = max(n for n in range(1, int(count**0.5) + 1) if count % n == 0)
    columns = count // rows
    feet = "".join(
        f'<geom type="sphere" size="{FOOT}" mass="0" pos="{x} {y} 0"/>'
        for x in 3 * FOOT * (np.arange(columns) - (columns - 1) / 2)
        for y in 3 * FOOT * (np.arange(rows) - (rows - 1) / 2)
    )
    tool = (
        f'<body name="tool" pos="0 0 {FOOT}"><freejoint/>'
        f'<inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>{feet}'
        '<site name="grip"/></body>'
    )
    return _scene("contacts", _FLOOR + tool)


def mesh_ball(count: int) -> Scene:
    """Returns a tool that is a convex mesh of about ``count`` triangles on a box."""
    _check(count, MOST)
    points = " ".join(f"{value:.6g}" for value in (BALL * sphere(count // 2 + 2)).ravel())
    assets = f'<asset><mesh name="ball" vertex="{points}"/></asset>'
    tool = (
        f'<body name="tool" pos="0 0 {BALL}"><freejoint/>'
        '<geom type="mesh" mesh="ball" mass="0.1"/><site name="grip"/></body>'
    )
    floor = '<geom type="box" size="1 1 0.1" pos="0 0 -0.1"/>'
    return _scene("triangles", floor + tool, assets=assets)


def resting(count: int) -> Scene:
    """Returns a free tool beside ``count`` boxes that rest on the floor, four contacts each."""
    return _scene("resting", _FLOOR + _tool_ball(0.3) + _others(count, _box))


def sphere(count: int) -> NDArray[np.float64]:
    """Returns points spread evenly on the unit sphere (Fibonacci's lattice), shape (count, 3).

    Their convex hull has 2 count − 4 triangles.
    """
    index = np.arange(count) + 0.5
    height, angle = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=-1)


FAMILIES = (
    Family(
        "bodies",
        "free bodies",
        "free balls that touch nothing",
        (1, 2, 5, 10, 20, 50, 100, 200),
        floating,
        (*METHOD_VARIANTS, ALONE),
    ),
    Family(
        "contacts",
        "contacts",
        "one body that stands on many feet",
        (1, 3, 10, 30, 100, 200, 500),
        plate,
        METHOD_VARIANTS,
    ),
    Family(
        "triangles",
        "triangles",
        "a ball that is a convex mesh, on a box",
        (12, 100, 1000, 10_000, 100_000),
        mesh_ball,
    ),
    Family(
        "resting",
        "boxes at rest",
        "on the floor, four contacts each",
        (1, 3, 10, 30, 100),
        resting,
        (USUAL, *VARIANTS[len(METHOD_VARIANTS) :]),
    ),
    Family(
        SUBSTEPS,
        "substeps",
        "MuJoCo's steps in a tick, on ten feet",
        (1, 2, 4, 8, 16),
        lambda _: plate(10),
    ),
)

_FLOOR = '<geom name="floor" type="plane" size="20 20 1"/>'


def _scene(name: str, bodies: str, *, gravity: float = -9.81, assets: str = "") -> Scene:
    return scene_of(_FRAME.format(name=name, gravity=gravity, assets=assets, bodies=bodies))


def _tool_ball(height: float = 0.0) -> str:
    return (
        f'<body name="tool" pos="0 0 {height}" gravcomp="1"><freejoint/>'
        f'<geom type="sphere" size="{BALL}" mass="0.1"/><site name="grip"/></body>'
    )


def _others(count: int, body: Callable[[float, float], str]) -> str:
    _check(count + 1, 10_000)
    side = int(np.ceil(np.sqrt(max(count, 1))))
    return "".join(body(SPACING * (1 + i % side), SPACING * (1 + i // side)) for i in range(count))


def _ball(x: float, y: float) -> str:
    return (
        f'<body pos="{x} {y} 0"><freejoint/><geom type="sphere" size="{BALL}" mass="0.1"/></body>'
    )


def _box(x: float, y: float) -> str:
    return (
        f'<body pos="{x} {y} {BALL}"><freejoint/>'
        f'<geom type="box" size="{BALL} {BALL} {BALL}" mass="0.1"/></body>'
    )


def _check(count: int, most: int) -> None:
    if not 1 <= count <= most:
        raise StudyError(f"the scene has {count} parts; it must have 1 to {most}")


ROUNDS = 3
"""Number of runs of every scene, in turn with the others."""

LARGE = 0.1
"""Share of a family's largest size above which its exponent is fitted, no unit. Below it, the
constant cost of a tick hides the growth."""


@dataclass(frozen=True, slots=True)
class Work:
    """Cost of a scene.

    Attributes:
        family: Name of the family.
        variant: Name of the variant.
        size: Requested count.
        contacts: Contacts at the end.
        rows: Constraint rows at the end.
        freedoms: Degrees of freedom.
        time: Time of a tick in s, all rounds together.
        low: Smallest median of a round in s.
        high: Largest median of a round in s.
        rate: Rate in Hz at which the 99th percentile of a tick fills half a period.
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
    """Growth of a tick's time with the size: time ~ size^p.

    Attributes:
        exponent: p, fitted to the larger sizes; no unit.
        low: Smallest p from one of these sizes to the next.
        high: Largest p from one of these sizes to the next. Far from ``low``, the growth is no
            power of the size.
        start: Smallest size of the fit.
    """

    exponent: float
    low: float
    high: float
    start: float


@dataclass(frozen=True, slots=True)
class LoopCost:
    """Processor time of the loop's own thread in a tick of the bridge.

    Attributes:
        name: Hands, recording and view.
        median: Over the rounds in s.
        low: Smallest in s.
        high: Largest in s.
    """

    name: str
    median: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class WorkChart:
    """Results of the measurement.

    Attributes:
        points: One per family, size and variant.
        machine: Description of the machine.
        loops: Costs of whole loops.
    """

    points: tuple[Work, ...]
    machine: str
    loops: tuple[LoopCost, ...] = ()

    def points_of(self, family: Family, variant: Variant) -> list[Work]:
        """Returns the points of a family by size."""
        return [p for p in self.points if (p.family, p.variant) == (family.name, variant.name)]

    def variants(self, family: Family) -> list[Variant]:
        """Returns the measured variants of a family."""
        return [variant for variant in VARIANTS if self.points_of(family, variant)]

    def growth(self, family: Family, variant: Variant) -> Growth | None:
        """Returns the growth of the time with the larger sizes; None for fewer than two."""
        points = self.points_of(family, variant)
        return growth_of(
            np.array([each.size for each in points], dtype=np.float64),
            np.array([each.time.median for each in points]),
        )

    def beyond(self, family: Family, variant: Variant, size: int) -> tuple[float, float] | None:
        """Returns a tick's time beyond MuJoCo's step alone in s, and over it, without unit.

        None where a variant is that step itself, or the step was not measured.
        """
        times = {
            each.is_bare: point.time.median
            for each in (variant, ALONE)
            for point in self.points_of(family, each)
            if point.size == size
        }
        if set(times) != {False, True}:
            return None
        return times[False] - times[True], times[False] / times[True]


def growth_of(sizes: NDArray[np.float64], times: NDArray[np.float64]) -> Growth | None:
    """Fits time ~ size^p to the sizes from ``LARGE`` of the largest on.

    Args:
        sizes: Sizes, > 0, increasing, shape (n,).
        times: Times in s, > 0, shape (n,).

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
    """Times ticks of growing scenes, all in turn, on one core.

    Args:
        families: Families of scenes.
        most: Largest size; None for all.
        rounds: Number of runs of every scene.
        clock: Time in ns; by default the thread's own, which excludes other work of the machine.
        progress: Called with the finished and all runs.
    """
    jobs = [
        (family, variant, size)
        for family in families
        for size in family.sizes
        if most is None or size <= most
        for variant in family.variants
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
                substeps = family.substeps(size)
                times[index].append(tick_times(scenes[key], variant, clock, substeps))
                data = scenes[key].data
                counts[index] = int(data.ncon), int(data.nefc), int(scenes[key].model.nv)
        where = machine(core)
    if progress is not None:
        progress(rounds * len(jobs), rounds * len(jobs))
    points = []
    for index, (family, variant, size) in enumerate(jobs):
        spread = TimingStats.from_times(np.concatenate(times[index]))
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


BAR = """
<mujoco model="bar">
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="bar"><freejoint/>
      <geom type="capsule" size="0.01" fromto="-0.1 0 0 0.1 0 0" mass="0.2"/>
      <site name="grip" pos="-0.1 0 0"/><site name="other" pos="0.1 0 0"/>
    </body>
  </worldbody>
</mujoco>"""
"""Bar in free space that one hand or two hold."""

LOOP_TICKS = 2000
"""Timed ticks of a loop per round, after a quarter as many that warm it up."""

LOOPS = ("one hand", "two hands", "one hand, recorded", "one hand, viewed")
"""Loops whose cost is compared; the last needs the extra ``view``."""


def measure_loops(rounds: int = ROUNDS, ticks: int = LOOP_TICKS) -> tuple[LoopCost, ...]:
    """Times whole loops of the bridge in turn: device, tick, record; with a recording, with a view.

    The recorder and the view are processes of their own, whose time does not count.

    Args:
        rounds: Number of runs of every loop.
        ticks: Timed ticks of a run.
    """
    found: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        bar = Path(folder) / "bar.xml"
        bar.write_text(BAR, encoding="utf-8")
        for turn, name in product(range(rounds), LOOPS):
            path = Path(folder) / f"{turn}.mcap" if name.endswith("recorded") else None
            try:
                window = _window() if name.endswith("viewed") else None
            except HapticBridgeError:
                continue
            hands = [Grasp("grip"), Grasp("other")] if name == "two hands" else "simulated"
            with Bridge(
                bar, hands, clock=SimulatedClock(), recording=path, observer=window
            ) as bridge:
                bridge.run(ticks // 4 * bridge.period)
                begin = time.thread_time()
                bridge.run(ticks * bridge.period)
                found.setdefault(name, []).append((time.thread_time() - begin) / ticks)
    return tuple(
        LoopCost(name, float(np.median(times)), min(times), max(times))
        for name, times in found.items()
    )


def _window() -> RingObserver:
    from hapticbridge.view import Address, Window  # noqa: PLC0415 - needs the extra 'view'

    return Window(Address(0))


RATE = 1000.0
"""Rate in Hz for the paragraph."""

WORK_ENDINGS = (*PICTURES, "csv", "json")
"""Endings of the files; there is no page."""

HOLDS = f"A rate is held where 99 of 100 ticks take at most {100 * TICK_SHARE:g} % of its period"
"""Definition of the rate in the paragraph."""

ROOM = 15.0
"""Ratio of the upper end of the time axis to half of a tick, without unit. The legend stands above
the curves."""


def draw_work(chart: WorkChart) -> Figure:
    """Draws the tick's time over the count, one panel per family."""
    figure = new_figure(8, 10)
    panels = figure.subplots(3, 2)
    for axes, family in zip(panels.ravel(), FAMILIES, strict=False):
        _draw_family(axes, chart, family)
    _draw_loops(panels.ravel()[-1], chart.loops)
    figure.suptitle(
        "Processor time of a tick at 1 kHz; n^p (least and largest p between two sizes)\n"
        f"{chart.machine}",
        fontsize="medium",
        parse_math=False,
    )
    return figure


def _draw_family(axes: Axes, chart: WorkChart, family: Family) -> None:
    axes.set_xlabel(f"{family.unit}: {family.about}", fontsize="x-small")
    if not chart.variants(family):
        axes.set_title("not measured", fontsize="small")
        return
    for place, variant in enumerate(chart.variants(family)):
        colour = f"C{place}"
        points = chart.points_of(family, variant)
        sizes = [each.size for each in points]
        growth = chart.growth(family, variant)
        text = variant.name if growth is None else f"{variant.name}: {_power(growth)}"
        axes.plot(
            sizes, [1e6 * p.time.median for p in points], "o-", color=colour, ms=4, label=text
        )
        axes.plot(sizes, [1e6 * p.time.p99 for p in points], ":", color=colour, lw=1)
    axes.plot([], [], ":", color="grey", label="99th percentile")
    axes.axhline(1e6 * TICK_SHARE / RATE, color="black", ls="--", lw=0.9)
    axes.annotate(
        "half of a tick at 1 kHz", (0.02, 1e6 * TICK_SHARE / RATE), va="bottom",
        xycoords=("axes fraction", "data"), fontsize="x-small",
    )  # fmt: skip
    axes.set(xscale="log", yscale="log")
    axes.set_ylabel("processor time of a tick (µs)", fontsize="small")
    axes.grid(visible=True, alpha=0.3)
    low, high = axes.get_ylim()
    axes.set_ylim(low, max(high, ROOM * 1e6 * TICK_SHARE / RATE))
    axes.legend(fontsize="xx-small", loc="upper left")


def _draw_loops(axes: Axes, loops: Sequence[LoopCost]) -> None:
    names = [each.name.replace(", ", ",\n") for each in loops]
    axes.barh(names, [1e6 * each.median for each in loops], color="C0")
    axes.invert_yaxis()
    axes.set_xlabel(
        "processor time of a tick of the whole loop (µs), a bar in free space", size="x-small"
    )
    axes.tick_params(labelsize="x-small")


def paragraph(chart: WorkChart) -> str:
    """States the growth of a tick's time, and the largest scenes that fit into a tick at 1 kHz."""
    facts = []
    for family in FAMILIES:
        for variant in chart.variants(family):
            points = chart.points_of(family, variant)
            first, last = points[0], points[-1]
            most = max((each.size for each in points if each.rate >= RATE), default=0)
            growth = chart.growth(family, variant)
            slope = (
                "" if growth is None else f", as n^{growth.exponent:.2f} from {growth.start:g} on"
            )
            facts.append(
                f"{family.unit.capitalize()}, {variant.name}: {1e6 * first.time.median:.3g} µs a "
                f"tick for {first.size}, {1e6 * last.time.median:.3g} µs for {last.size}{slope}; "
                f"up to {most} hold 1 kHz{_beyond(chart, family, variant)}"
            )
    facts += [f"Whole loop, {each.name}: {1e6 * each.median:.3g} µs a tick" for each in chart.loops]
    return ". ".join([*facts, HOLDS]) + "."


def _beyond(chart: WorkChart, family: Family, variant: Variant) -> str:
    """States what a tick costs beyond MuJoCo's step for the least and the most; empty without it.

    For the least it is the fixed cost of a tick, the rest grows with the scene.
    """
    points = chart.points_of(family, variant)
    found = {p.size: chart.beyond(family, variant, p.size) for p in (points[0], points[-1])}
    parts = [
        f"{1e6 * extra[0]:.3g} µs for {size} ({extra[1]:.2f} times the step)"
        for size, extra in found.items()
        if extra is not None
    ]
    return f"; beyond {ALONE.name} " + " and ".join(parts) if parts else ""


def _power(growth: Growth) -> str:
    return f"n^{growth.exponent:.2f} ({growth.low:.2f} to {growth.high:.2f})"


def write_work(chart: WorkChart, paths: Mapping[str, Path]) -> dict[str, Any]:
    """Writes picture, table and JSON; returns the content of the JSON file.

    Args:
        chart: The measurement.
        paths: By ending, as ``prepared_files`` returned them.

    Raises:
        HapticBridgeError: A file cannot be written.
    """
    rows = [_row(each) | {"machine": chart.machine} for each in chart.points]
    growths = {
        family.name: {
            variant.name: None if growth is None else asdict(growth)
            for variant in chart.variants(family)
            for growth in (chart.growth(family, variant),)
        }
        for family in FAMILIES
    }
    facts = {
        "machine": chart.machine,
        "paragraph": paragraph(chart),
        "growth": growths,
        "loops": [asdict(each) for each in chart.loops],
        "points": rows,
    }
    texts = {"csv": csv_text(rows), "json": json.dumps(facts, indent=2, allow_nan=False) + "\n"}
    write_files(paths, texts, draw_work(chart))
    return facts


def _row(each: Work) -> dict[str, object]:
    row = asdict(each)
    spread = row.pop("time")
    return row | {f"time_{name}": value for name, value in spread.items()}
