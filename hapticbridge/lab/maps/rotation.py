"""Map ``rotation``: speed and angle of a spinning tool, up to the cut at an angle of π."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import prepare
from hapticbridge.device import Motion, TrajectoryDevice
from hapticbridge.kernel.pose import IDENTITY_POSE
from hapticbridge.kernel.record import SAMPLE_DTYPE, TICK_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import simulate
from hapticbridge.lab.maps import base
from hapticbridge.lab.maps.base import PERIOD, Point, Sentences
from hapticbridge.lab.maps.twins import NO_LIMITS, UNGUARDED_OPTIONS, Run, Twins
from hapticbridge.lab.methods import METHODS
from hapticbridge.plotting import new_figure
from hapticbridge.run.options import RunSetup
from hapticbridge.run.summary import Ledger
from hapticbridge.scene import Scene
from hapticbridge.sweep import Table

INERTIA = np.array([1.5e-3, 3.63e-3, 4.53e-3])
"""Principal moments of inertia of the tool about x, y, z in kg m². They all differ, so that it
tumbles, and are near those of a hand tool with a long handle."""

TICKS = 1000

OBLIQUE = np.array([0.1, 1.0, 0.1])
"""Axis of the spin: near the middle principal axis, about which a free body is unstable."""

MIDDLE = np.array([0.0, 1.0, 0.0])


def cut_speed(stiffness: float) -> float:
    """Returns the speed ω = π √(K_r/I) in rad/s at which a sudden turn winds the spring to π.

    The tool starts at rest and the handle turns about the middle axis. Relative to the handle the
    tool swings with the amplitude ω √(I/K_r). The damping, also the numerical one, is left out.
    """
    return float(np.pi * np.sqrt(stiffness / INERTIA[1]))


def gyroscopic_speed(stiffness: float) -> float:
    """Returns the speed in rad/s from which on the gyroscopic torque can exceed the spring's.

    The gyroscopic torque |ω × Iω| reaches ½ (I_z − I_x) ω² in the worst attitude, the spring gives
    π K_r at most. A tool passes that attitude quickly: its angle passes π at higher speeds only.
    """
    return float(np.sqrt(2 * np.pi * stiffness / (INERTIA.max() - INERTIA.min())))


def free_creation(speed: float) -> float:
    """Returns the energy in J that the explicit gyroscopic term creates in a free tool.

    With the term at the start of the step, v⁺ = v − T I⁻¹(ω × Iω), the kinetic energy grows by

        ½ T² (ω × Iω)ᵀ I⁻¹ (ω × Iω)

    a step, since ω·(ω × Iω) = 0. Summed over the exact motion (fourth order) from a spin about
    ``OBLIQUE``. Beyond a few per cent of the kinetic energy, the created energy increases the spin,
    and the true creation is larger. ``speed`` is in rad/s.
    """
    omega = speed * OBLIQUE / np.linalg.norm(OBLIQUE)
    total = 0.0
    for _ in range(TICKS):
        torque = np.cross(omega, INERTIA * omega)
        total += 0.5 * PERIOD**2 * float(np.sum(torque**2 / INERTIA))
        first = _torque_free(omega)
        second = _torque_free(omega + PERIOD / 2 * first)
        third = _torque_free(omega + PERIOD / 2 * second)
        fourth = _torque_free(omega + PERIOD * third)
        omega = omega + PERIOD / 6 * (first + 2 * second + 2 * third + fourth)
    return total


def _torque_free(omega: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(-np.cross(omega, INERTIA * omega) / INERTIA)


MASS = 0.3
"""Mass of the tool in kg."""

STIFFNESS, DAMPING = 2000.0, 0.5
"""Translational K in N/m and B in N s/m of the coupling. They only keep the tool in its place."""

ROTATIONAL_DAMPING = 5e-4
"""Rotational damping B_r in N m s/rad; 0 where K_r = 0."""

DIVERGED = 1e3
"""Kinetic energy in J that ends a run. It is ten times that of the tool at 200 rad/s, a sure sign
of divergence. It is reached before MuJoCo warns of numbers that are not finite."""

CHUNK = 2
"""Ticks between two checks of the kinetic energy. Five ticks beyond the limit, MuJoCo would
warn."""


@dataclass(frozen=True, slots=True, eq=False)
class Spin:
    """Outcome of a run with a spinning handle.

    Attributes:
        ticks: Number of completed ticks; fewer than ``TICKS`` if it diverged.
        environment: ``strict``, ``within slack`` or ``active``.
        created: Largest Σ E_k so far at any tick, in J.
        slack_share: Largest share of the slack that was used, without unit.
        first_active: Tick of the first violation of the slack, −1 for none.
        largest_angle: Angle between handle and tool in rad, at most π.
        crossed: First tick after which the angle had passed π since the previous tick, −1 for
            never.
        torque_jump: Largest change of the torque on the tool within a tick in N m.
    """

    ticks: int
    environment: str
    created: float
    slack_share: float
    first_active: int
    largest_angle: float
    crossed: int
    torque_jump: float


def spin(
    method: str,
    coupling: Coupling,
    speed: float,
    *,
    angle: float = 0.0,
    axis: NDArray[np.float64] = OBLIQUE,
    spins_at_start: bool = True,
) -> Spin:
    """Turns the handle at a constant speed for 1 s, with the tool behind it.

    Args:
        method: One of ``methods.METHODS`` that has a coupling.
        coupling: K and B.
        speed: Speed of the handle in rad/s.
        angle: Lead of the handle over the tool at the start, about x, in rad.
        axis: Axis of the handle's rotation in the world frame, shape (3,), any length > 0.
        spins_at_start: True if the tool turns with the handle from the start; else it is at rest.

    Raises:
        HapticBridgeError: A value is out of range, or the method cannot render a free tool.
    """
    scene = base.loop_in(spinning_scene).scene
    chosen = METHODS[method]
    effective = prepare(scene, coupling, PERIOD, 1, chosen)
    quaternions = turning(speed, angle=angle, axis=axis)
    samples = np.zeros(TICKS, SAMPLE_DTYPE)
    samples["quaternion"] = quaternions[1:]
    if spins_at_start:
        _set_spin(scene, speed * axis / np.linalg.norm(axis))
    first = np.zeros(1, SAMPLE_DTYPE)
    first["quaternion"] = quaternions[0]
    setup = RunSetup(scene=scene, coupling=coupling, method=chosen, period=PERIOD)
    parameters = setup.parameters(first, effective)
    # the grip is at the device's pose without the angle, not at the device's start
    parameters = replace(parameters, device_origin=IDENTITY_POSE)
    binding = BoundKernel(scene.model, scene.data, parameters)
    records = np.zeros(TICKS, TICK_DTYPE)
    done = _run(binding, samples, records)
    return _read(binding, records[:done])


def turning(
    speed: float, *, angle: float = 0.0, axis: NDArray[np.float64] = OBLIQUE
) -> NDArray[np.float64]:
    """Returns the handle's unit quaternions (w, x, y, z) at the ticks, shape (``TICKS`` + 1, 4).

    Args:
        speed: Speed in rad/s.
        angle: Rotation about x at the start, in rad.
        axis: Axis of rotation in the world frame, shape (3,), any length > 0.
    """
    time = PERIOD * np.arange(TICKS + 1)
    about = axis / np.linalg.norm(axis)
    turns = Rotation.from_rotvec(np.outer(speed * time, about)) * Rotation.from_rotvec(
        [angle, 0.0, 0.0]
    )
    return np.asarray(turns.as_quat(canonical=True)[:, [3, 0, 1, 2]])


def coupling_of(stiffness: float) -> Coupling:
    """Returns the coupling with a K_r in N m/rad; with 0 the tool's rotation is free."""
    return Coupling(STIFFNESS, DAMPING, stiffness, ROTATIONAL_DAMPING if stiffness else 0.0)


def sudden(method: str, stiffness: float, speed: float) -> Spin:
    """Turns the handle suddenly about the middle axis, with the tool at rest."""
    return spin(method, coupling_of(stiffness), speed, axis=MIDDLE, spins_at_start=False)


def speed_of_cut(method: str, stiffness: float) -> float:
    """Returns the speed in rad/s, 1 to 1000, at which a sudden turn winds the angle past π."""
    return base.largest_stable(
        lambda speed: sudden(method, stiffness, speed).crossed < 0, 1.0, 1000.0
    ).middle


def spinning_scene() -> Scene:
    """Loads the tool, floating free of gravity."""
    return base.scene_of(base.free_body(MASS, INERTIA))


def _set_spin(scene: Scene, omega: NDArray[np.float64]) -> None:
    scene.data.qvel[3:6] = omega  # the body's axes are the world's at the start
    mujoco.mj_forward(scene.model, scene.data)


def _run(binding: BoundKernel, samples: NDArray[np.void], records: NDArray[np.void]) -> int:
    for first in range(0, TICKS, CHUNK):
        part = slice(first, first + CHUNK)
        done = simulate(binding.state, samples[part], binding.row, records[part])
        if done < CHUNK or not binding.state["energy"]["kinetic"][0] < DIVERGED:
            return first + done
    return TICKS


def _read(binding: BoundKernel, records: NDArray[np.void]) -> Spin:
    ledger = Ledger.from_state(binding.state)
    handle = Rotation.from_quat(records["handle_quaternion"][:, [1, 2, 3, 0]])
    tool = Rotation.from_quat(records["tool_quaternion"][:, [1, 2, 3, 0]])
    between = (handle * tool.inv()).as_rotvec()
    angles = np.linalg.norm(between, axis=1)
    # just before and behind the cut the rotation vectors have opposite directions
    opposite = np.sum(between[1:] * between[:-1], axis=1) < 0
    crossed = np.flatnonzero(opposite & (angles[1:] > np.pi / 2) & (angles[:-1] > np.pi / 2))
    jumps = np.linalg.norm(np.diff(records["wrench_on_tool"][:, 3:], axis=0), axis=1)
    return Spin(
        ticks=records.size,
        environment=ledger.environment,
        created=float(records["environment_energy"].max(initial=0.0)),
        slack_share=ledger.slack_share,
        first_active=-1 if ledger.first_active is None else ledger.first_active,
        largest_angle=float(angles.max(initial=0.0)),
        crossed=int(crossed[0]) + 1 if crossed.size else -1,
        torque_jump=float(jumps.max(initial=0.0)),
    )


SOFT, HARD = 2.0, 20.0
"""Stiffnesses K_r in N m/rad: that of the simulated device, and one ten times stiffer."""

UNCORRECTED = "explicit"
"""Method with MuJoCo's explicit bias. ``implicit`` takes back what the bias creates
(``kernel.ledger``)."""

METHODS_SHOWN = ("implicit", "compensated", "lossless", "implicitfast", "explicit", "weld")

SPEED = (0.0, 200.0)
ANGLE = (0.0, 3.1)
"""Ranges in rad/s and rad; the angle ends before the cut."""

SLOWEST = 2.0
"""Speed in rad/s at which the lines over the logarithm of the speed begin."""

LINES = (
    (UNCORRECTED, 0.0),
    ("implicit", SOFT),
    ("implicit", HARD),
    ("compensated", SOFT),
    ("lossless", SOFT),
    ("implicitfast", SOFT),
    ("explicit", SOFT),
)
"""Method and K_r in N m/rad of the curves over the speed; with 0 the coupling acts on translation
alone."""


DEFAULT_POINTS = 1500
"""Approximate number of points by default."""


def points(count: int) -> Sequence[Point]:
    """Returns a grid of speed and angle for each method, and lines over the speed."""
    side = max(2, round((0.85 * count / len(METHODS_SHOWN)) ** 0.5))
    many = max(4, round(0.15 * count / (len(LINES) + len(METHODS_SHOWN))))
    cells = [
        _point("cell", method, SOFT, speed, angle)
        for method in METHODS_SHOWN
        for angle in np.linspace(*ANGLE, side)
        for speed in np.linspace(*SPEED, side)
    ]
    lines = [
        _point("line", method, stiffness, speed)
        for method, stiffness in LINES
        for speed in np.geomspace(SLOWEST, SPEED[1], many)
    ]
    cuts = [
        _point("cut", method, SOFT, speed)
        for method in METHODS_SHOWN
        for speed in np.linspace(SLOWEST, SPEED[1], many)
    ]
    return [*cells, *lines, *cuts, _point("limit", "implicit", SOFT, 0.0)]


def _point(what: str, method: str, stiffness: float, speed: float, angle: float = 0.0) -> Point:
    return {
        "what": what,
        "method": method,
        "rotational_stiffness": float(stiffness),
        "speed": float(speed),
        "angle": float(angle),
    }


def evaluate(point: Point) -> Mapping[str, float | int | str]:
    """Spins a handle for 1 s, or searches for the speed at which the angle passes π.

    The tool spins with the handle from the start in a ``cell`` or on a ``line``, and is at rest in
    a ``cut``.
    """
    method, stiffness = str(point["method"]), float(point["rotational_stiffness"])
    if point["what"] == "limit":
        return {"limit": speed_of_cut(method, stiffness)}
    speed, angle = float(point["speed"]), float(point["angle"])
    coupling = coupling_of(stiffness)
    if point["what"] == "cut":
        motion = sudden(method, stiffness, speed)
    else:
        motion = spin(method, coupling, speed, angle=angle)
    return asdict(motion)


STYLES = {0.0: "s:", SOFT: "o-", HARD: "^--"}
"""Marker and line by K_r in N m/rad."""

LEAST = 1e-12
"""Energy in J that represents zero on a logarithmic axis."""

HIGHEST = 5 * np.pi * SOFT
"""Upper end of the axis of torque in N m: the jump at the cut, and room for the names above it."""


def draw(table: Table, _boundary: Mapping[str, Any]) -> Figure:
    """Draws verdicts over speed and angle, creation over speed, and the jump at the cut."""
    figure = new_figure(8, 8.4)
    grid = figure.add_gridspec(3, 6, height_ratios=[1, 1, 1.4])
    for place, method in enumerate(METHODS_SHOWN):
        row, column = divmod(place, 3)
        axes = figure.add_subplot(grid[row, 2 * column : 2 * column + 2])
        _draw_cells(axes, table, method)
        if row == 1:
            axes.set_xlabel("speed (rad/s)")
        if column == 0:
            axes.set_ylabel("angle at the start (rad)")
    _draw_creation(figure.add_subplot(grid[2, :3]), table)
    _draw_cut(figure.add_subplot(grid[2, 3:]), table)
    figure.suptitle(
        f"A free tool of {1e3 * INERTIA[0]:.3g}, {1e3 * INERTIA[1]:.3g}, "
        f"{1e3 * INERTIA[2]:.3g} g m² behind a handle that spins for 1 s at "
        f"{1 / PERIOD:g} Hz;\nabove and right: K_r = {SOFT:g} N m/rad",
        fontsize="medium",
    )
    base.verdict_legend(
        figure,
        [("angle passed π", "black", "o"), ("gyroscopic torque = π K_r", base.THEORY_COLOUR, "--")],
    )
    return figure


def _draw_cells(axes: Axes, table: Table, method: str) -> None:
    axes.set_title(method, fontsize="medium")
    cells = base.of_method(table, "cell", method)
    verdict = base.verdict_numbers(cells.numbers("ticks") == TICKS, cells.texts("environment"))
    base.draw_verdicts(axes, cells["speed"], cells["angle"], verdict)
    passed = cells.select(cells.numbers("crossed") >= 0)
    axes.plot(passed["speed"], passed["angle"], "o", color="black", ms=2, mfc="white", mew=0.5)
    axes.axvline(gyroscopic_speed(SOFT), color=base.THEORY_COLOUR, ls="--", lw=1.5)


def _draw_creation(axes: Axes, table: Table) -> None:
    lines = table.select(table["what"] == "line")
    for method, stiffness in LINES:
        selected = lines.select(
            (lines["method"] == method) & (lines["rotational_stiffness"] == stiffness)
        )
        if stiffness == 0:
            predicted = [max(free_creation(float(speed)), LEAST) for speed in selected["speed"]]
            axes.plot(
                selected["speed"],
                predicted,
                color=base.THEORY_COLOUR,
                lw=4,
                alpha=0.5,
                label=r"½T²|ω×Iω|²/I",
            )
        axes.plot(
            selected["speed"],
            np.maximum(selected.numbers("created"), LEAST),
            STYLES[stiffness],
            color=base.METHOD_COLOURS[method],
            ms=3,
            lw=1,
            label=f"{method}, K_r = {stiffness:g}" if stiffness else "no K_r, uncorrected",
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(1e-4 * LEAST, 1e4)  # room for the names below the curves
    axes.set_xlabel("speed (rad/s)")
    axes.set_ylabel("energy created (J)")
    axes.legend(fontsize="x-small", loc="lower right", ncols=2, handlelength=1.5)


def _draw_cut(axes: Axes, table: Table) -> None:
    cuts = table.select(table["what"] == "cut")
    widths = (7, 5.5, 4, 2.5, 1, 1)  # all but the last coincide
    for method, width in zip(METHODS_SHOWN, widths, strict=True):
        selected = cuts.select(cuts["method"] == method)
        # the weld's jumps are far larger: they are drawn at the upper edge
        jump = np.minimum(selected.numbers("torque_jump"), 0.97 * HIGHEST)
        colour = base.METHOD_COLOURS[method]
        axes.plot(selected["speed"], jump, "o-", color=colour, ms=3, lw=width, label=method)
    axes.axvline(cut_speed(SOFT), color=base.THEORY_COLOUR, ls="--", lw=1.2, label="ω = π √(K_r/I)")
    axes.axhline(2 * np.pi * SOFT, color=base.THEORY_COLOUR, ls=":", lw=1.2, label="2π K_r")
    axes.set(
        xlabel="speed of a sudden turn (rad/s)",
        ylabel="largest jump of torque\nin a tick (N m)",
        ylim=(0, HIGHEST),
    )
    axes.legend(fontsize="x-small", loc="upper right", bbox_to_anchor=(1.0, 0.95))


TELLING = (1e-4, 0.05)
"""Share of the kinetic energy within which creation is compared with theory. It is above rounding,
and too small to change the motion."""


def summarize(table: Table) -> dict[str, Any]:
    """Finds passive ranges, the creation with translation alone, and the cut at π."""
    cells = table.select(table["what"] == "cell")
    free = table.select((table["what"] == "line") & (table["rotational_stiffness"] == 0))
    predicted = np.array([free_creation(float(speed)) for speed in free["speed"]])
    kinetic = 0.5 * INERTIA[1] * free["speed"] ** 2
    share = predicted / kinetic
    comparable = (share > TELLING[0]) & (share < TELLING[1])
    created = free.numbers("created")
    ratio = created[comparable] / predicted[comparable]
    cuts = table.select(table["what"] == "cut")
    selected = cuts.select(cuts["method"] == "implicit")
    passed = selected.select(selected.numbers("crossed") >= 0)
    limit = table.select(table["what"] == "limit").numbers("limit")
    return {
        "period": PERIOD,
        "rotational_stiffness": SOFT,
        "gyroscopic_speed": gyroscopic_speed(SOFT),
        "fastest_passive": {name: _fastest(cells, name) for name in METHODS_SHOWN},
        "share_strict_below": {name: _strict_share(cells, name) for name in METHODS_SHOWN},
        "first_passed": {name: _first_passed(cells, name) for name in METHODS_SHOWN},
        "translation_only": {
            "speed": free["speed"].tolist(),
            "created": created.tolist(),
            "predicted": predicted.tolist(),
            "grows_up_to": _grows_up_to(free),
            "compared_up_to": float(free["speed"][comparable].max()) if comparable.any() else None,
            "largest_deviation": float(np.abs(ratio - 1).max()) if ratio.size else None,
        },
        "cut": {
            "speed_measured": float(limit[0]) if limit.size else None,
            "speed_predicted": cut_speed(SOFT),
            "torque_jump": float(passed["torque_jump"].max()) if len(passed) else None,
            "torque_jump_predicted": 2 * np.pi * SOFT,
            "largest_torque_jump": {name: _largest_jump(cuts, name) for name in METHODS_SHOWN},
            "created": float(passed["created"].max()) if len(passed) else None,
        },
    }


def _largest_jump(cuts: Table, method: str) -> float | None:
    """Returns the largest jump of torque of a method in N m; None without a run."""
    jump = cuts.select(cuts["method"] == method).numbers("torque_jump")
    return float(jump.max()) if jump.size else None


def _grows_up_to(free: Table) -> float | None:
    """Returns the speed in rad/s above which every faster point creates more."""
    if not len(free):
        return None
    falls = np.flatnonzero(np.diff(free.numbers("created")) <= 0)
    return float(free["speed"][falls[0] if falls.size else -1])


def _first_passed(cells: Table, method: str) -> float | None:
    """Returns the slowest speed in rad/s at which the angle passed π in a run; None for none."""
    selected = cells.select((cells["method"] == method) & (cells.numbers("crossed") >= 0))
    return float(selected["speed"].min()) if len(selected) else None


def _fastest(cells: Table, method: str) -> float | None:
    """Returns the speed in rad/s up to which a method is passive at every angle; None for none."""
    selected = cells.select(cells["method"] == method)
    is_good = (selected.texts("environment") != "active") & (selected.numbers("ticks") == TICKS)
    bad = selected["speed"][~is_good].min(initial=np.inf)
    # a tool at rest creates nothing; 0 is no speed
    good = selected["speed"][(selected["speed"] < bad) & (selected["speed"] > 0)]
    return float(good.max()) if good.size else None


def _strict_share(cells: Table, method: str) -> float | None:
    """Returns the share of strict runs below ``gyroscopic_speed``."""
    rows = (cells["method"] == method) & (cells["speed"] < gyroscopic_speed(SOFT))
    return float(np.mean(cells.texts("environment")[rows] == "strict")) if rows.any() else None


def sentences(boundary: Mapping[str, Any]) -> Sentences:
    """States passive ranges, the creation with translation alone, and the cut at π."""
    for name in METHODS_SHOWN:
        selected = {"name": name, "gyroscopic_speed": boundary["gyroscopic_speed"]}
        selected |= {key: boundary[key][name] for key in ("fastest_passive", "first_passed")}
        selected |= {"strict": boundary["share_strict_below"][name]}
        yield "'{name}' is passive at every angle up to {fastest_passive:.3g} rad/s", selected
        yield (
            "'{name}' is strict in {strict:.0%} of its runs below {gyroscopic_speed:.3g} rad/s, "
            "where the gyroscopic torque reaches what the spring gives at π",
            selected,
        )
        yield "The angle of '{name}' first passes π at {first_passed:.3g} rad/s", selected
    yield (
        "Coupled in translation alone and uncorrected, the tool creates ½T²|ω × Iω|²/I a step "
        "within {largest_deviation:.2%} up to {compared_up_to:.3g} rad/s, and more the faster up "
        "to {grows_up_to:.3g} rad/s",
        boundary["translation_only"],
    )
    cut = boundary["cut"]
    yield (
        "A sudden turn passes the cut at π at {speed_measured:.4g} rad/s, predicted "
        "{speed_predicted:.4g} rad/s",
        cut,
    )
    yield (
        "Behind the cut the torque of 'implicit' flips by {torque_jump:.3g} N m within a tick, and "
        "it creates {created:.2g} J at most",
        cut,
    )
    yield (
        "The gains of a 'weld' are those of the translation: its torque jumps by up to "
        "{weld:.1g} N m",
        cut["largest_torque_jump"],
    )


TWIN_SPEED = 96.0
"""Speed in rad/s of the twins' handle: 1.3 times ``cut_speed(SOFT)``; the angle passes π."""


def twins() -> Twins:
    """Returns a handle that turns suddenly and winds the coupling past π, by two methods."""
    quaternions = turning(TWIN_SPEED, axis=MIDDLE)
    times = PERIOD * np.arange(len(quaternions))
    motion = Motion(times, np.zeros((len(times), 3)), quaternions)
    return Twins(
        shared=f"A handle turns suddenly at {TWIN_SPEED:g} rad/s with the tool at rest, "
        f"K_r = {SOFT:g} N m/rad",
        name="method",
        values=(UNCORRECTED, "implicit"),
        run=lambda method: Run(
            scene=spinning_scene,
            device=partial(TrajectoryDevice, motion, **NO_LIMITS),
            coupling=coupling_of(SOFT),
            options=replace(UNGUARDED_OPTIONS, method=method, contact="scene", rate=1 / PERIOD),
            duration=0.5,
        ),
    )
