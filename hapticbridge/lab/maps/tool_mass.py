"""Map ``tool_mass``: mass of the tool against stiffness of the coupling, by method."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import StudyError, choices
from hapticbridge.lab.closed_loop import LoopOutcome
from hapticbridge.lab.maps import base
from hapticbridge.lab.maps.base import PERIOD, Point, Sentences
from hapticbridge.lab.maps.twins import NO_LIMITS, UNGUARDED_OPTIONS, Run, Twins
from hapticbridge.lab.methods import METHODS, THEORIES
from hapticbridge.plotting import new_figure
from hapticbridge.sweep import Table
from hapticbridge.theory.sampled_loop import WorstHand
from hapticbridge.theory.spectrum import needed_for_fixed_environment

NAMES = ("implicit", "lossless", "implicitfast", "explicit", "explicit:rk4")
"""Methods with a theory in this module."""

ANGLES = np.union1d(np.linspace(0.01, np.pi, 2000), np.geomspace(0.01, np.pi, 1000))
"""Angles θ in rad for the theory, even in θ and in log θ. The spacing is finer than the resonances
of a heavy tool, which are B/m wide."""


def min_mass(method: str, stiffness: float, damping: float, period: float) -> float:
    """Returns the mass that a free tool must exceed to be stable behind a handle held still.

        implicit        0
        lossless        0
        implicitfast    (T/2)(K T/2 − B), at least 0
        explicit        (T/2)(K T/2 + B)
        explicit:rk4    (B T/2)(2B + K T)/(2B − K T);  inf for B <= K T/2

    From Jury's test of the loop z-transformed: the actuators of implicitfast have the spring at the
    old place and the damper at the new velocity; RK4 holds the force exactly.

    Args:
        method: One of ``NAMES``.
        stiffness: K in N/m, > 0.
        damping: B in N s/m, >= 0.
        period: T in s, > 0.

    Returns:
        m in kg.

    Raises:
        StudyError: The method is none of these.

    References:
        Brown & Colgate 1997, conditions that belong to eq. (19), for the semi-implicit step; the
        other two are derived here by the same test.
    """
    _check(method)
    kt, b = stiffness * period, damping
    if method in ("implicit", "lossless"):
        return 0.0
    if method == "implicitfast":
        return max(0.0, period / 2 * (kt / 2 - b))
    if method == "explicit":
        return period / 2 * (kt / 2 + b)
    return b * period / 2 * (2 * b + kt) / (2 * b - kt) if 2 * b > kt else float("inf")


def effective_response(
    method: str, stiffness: float, damping: float, mass: float, period: float, angle: ArrayLike
) -> NDArray[np.complex128]:
    """Returns the transfer function of a free tool, force per displacement of the handle.

        H = C / (1 + C P),    C = K + B D/T,    D = 1 − z⁻¹,    P = (T²/m) n / D²
        n = 1 (implicit),  (1 + z⁻¹)/2 (lossless),  z⁻¹ (explicit),
        z⁻¹(1 + z⁻¹)/2 (explicit:rk4, the exact hold)
        H = C (m D²/T² − K D) / (m D²/T² + K z⁻¹ + B D/T)          (implicitfast)

    Args:
        method: One of ``NAMES``.
        stiffness: K in N/m, > 0.
        damping: B in N s/m, >= 0.
        mass: m in kg, > 0.
        period: T in s, > 0.
        angle: θ = ωT in rad, 0 < θ <= π, any shape.

    Returns:
        H in N/m, shaped like the angle.

    Raises:
        StudyError: The method is none of these.
    """
    _check(method)
    back = np.exp(-1j * np.asarray(angle, dtype=np.float64))
    change = 1 - back
    coupling = stiffness + damping / period * change
    inertia = mass * change**2 / period**2
    if method == "implicitfast":
        rest = inertia + stiffness * back + damping / period * change
        return np.asarray(coupling * (inertia - stiffness * change) / rest)
    late = {
        "implicit": 1 + 0 * back,
        "lossless": (1 + back) / 2,
        "explicit": back,
        "explicit:rk4": back * (1 + back) / 2,
    }
    return np.asarray(coupling / (1 + coupling * late[method] / inertia))


def worst_angle(
    method: str, stiffness: float, damping: float, mass: float, period: float
) -> tuple[float, float]:
    """Returns θ in rad at which a free tool needs most device damping, and that b in N s/m.

    The damping covers every passive hand if the tool is stable behind a handle held still
    (``min_mass``); else it is inf.

    Raises:
        StudyError: The method is none of ``NAMES``.

    References:
        Colgate & Schenkel 1997.
    """
    response = effective_response(method, stiffness, damping, mass, period, ANGLES)
    needed = needed_for_fixed_environment(response, period, ANGLES)
    place = int(np.flatnonzero(needed >= needed.max() - 1e-12 * abs(needed.max()))[-1])
    is_stable = mass > min_mass(method, stiffness, damping, period)
    return float(ANGLES[place]), float(needed[place]) if is_stable else float("inf")


def _check(method: str) -> None:
    if method not in NAMES:
        raise StudyError(f"no theory for method '{method}' here; choose {choices(NAMES)}")


DEVICE_DAMPING = 20.0
"""Device damping b in N s/m: a well damped device, so that stiff couplings are possible. The loop
is linear. With a tenth of b, B and K everything here happens at a tenth of the tool's mass."""

DAMPING = 5.0
"""Damping B in N s/m, a quarter of b, as in a default coupling."""

MASS = (1e-3, 10.0)
"""Range of the tool's mass in kg, even in its logarithm."""

STIFFNESS = (1000.0, 60_000.0)
"""Range of K in N/m, even in its logarithm: up to twice the bound (6) of 30 kN/m."""

TICKS = 2000
SWINGS = 8.0
"""Smallest number of swings of the tool on the coupling in a run. A fifth of the run is judged, and
a fraction of a swing would be mistaken for growth or decay. More takes longer."""

KNOCK = np.array([1e-4, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Displacement that starts a run, in m."""

HELD_STILL = 1e9
"""Mass in kg of a device that holds the handle still, to 1e-12 m."""

PATH = base.swinging(0.0025, 3.0, duration=2.0, count=401)
"""Path of a hand that swings the tool by 5 mm at 3 Hz, without rotation."""

SHOWN = tuple(name for name in THEORIES if name not in ("implicitfast:compensated", "weld"))
"""Methods shown. The two left out have the theory of ``implicit`` by construction or nominally."""

LIMITS = 9
"""Number of K per method at which the limits in mass are searched."""

SEARCHES = ("held still", "worst hand")
"""Ways to hold the handle in a search for a limit in mass."""


DEFAULT_POINTS = 1000
"""Approximate number of points by default."""


def points(count: int) -> Sequence[Point]:
    """Returns a grid of mass and stiffness per method, and searches for the limit in mass."""
    side = max(2, round((count / len(SHOWN)) ** 0.5))
    stiffness = np.geomspace(*STIFFNESS, side)
    cells: list[Point] = [
        {"what": "cell", "method": name, "stiffness": float(k), "mass": float(m)}
        for name in SHOWN
        for k in stiffness
        for m in np.geomspace(*MASS, side)
    ]
    # two to a column of the picture, and away from the grid's own values
    limits: list[Point] = [
        {"what": what, "method": name, "stiffness": float(k), "mass": 0.0}
        for name in SHOWN
        for k in np.geomspace(1.1 * STIFFNESS[0], STIFFNESS[1] / 1.1, min(LIMITS, side))
        for what in SEARCHES
    ]
    return cells + limits


def evaluate(point: Point) -> Mapping[str, float | str | bool]:
    """Runs one tool behind a handle held still, in the worst hand and in an ordinary one.

    A limit point searches for the mass above which it is stable with one of the first two
    instead.
    """
    name, stiffness = str(point["method"]), float(point["stiffness"])
    if point["what"] != "cell":
        return _limit(name, stiffness, is_held=point["what"] == "held still")
    mass = float(point["mass"])
    held, in_hand = held_still(name, stiffness, mass), worst_hand(name, stiffness, mass)
    ordinary = SimulatedDevice(damping=DEVICE_DAMPING, path=PATH)
    moved = _run(ordinary, name, stiffness, mass, is_knocked=False)
    return {
        "stable_held_still": held.is_stable,
        "stable_worst_hand": in_hand.is_stable,
        "environment": moved.environment,
        "created": moved.created,
        "slack_share": moved.slack_share,
        "first_active": moved.first_active,
    }


def held_still(name: str, stiffness: float, mass: float) -> LoopOutcome:
    """Runs a knocked tool behind a handle held still."""
    return _run(SimulatedDevice(mass=HELD_STILL, hand=None), name, stiffness, mass)


def worst_hand(name: str, stiffness: float, mass: float) -> LoopOutcome:
    """Runs a free tool in the worst hand for this method, mass and stiffness."""
    device = SimulatedDevice(hand=hand_worst_for(name, stiffness, mass))
    return _run(device, name, stiffness, mass)


def hand_worst_for(name: str, stiffness: float, mass: float) -> WorstHand:
    """Returns the hand that needs most damping for this method, mass and stiffness."""
    law = THEORIES[name], stiffness, law_damping(name, stiffness), mass, PERIOD
    angle, _ = worst_angle(*law)
    response = complex(effective_response(*law, angle))
    return WorstHand(DEVICE_DAMPING, angle / PERIOD, PERIOD, response)


def law_damping(name: str, stiffness: float) -> float:
    """Returns B' in N s/m of a method's law where ``DAMPING`` is requested."""
    return float(base.used_damping(name, stiffness, DAMPING))


def coupling_of(stiffness: float) -> Coupling:
    """Returns the coupling of every run at a stiffness, without rotation."""
    return Coupling(stiffness, DAMPING, 0.0, 0.0)


def _run(
    device: SimulatedDevice, name: str, stiffness: float, mass: float, *, is_knocked: bool = True
) -> LoopOutcome:
    loop = base.loop_in("point_mass", "tool_mass")
    # the mass is set before every run: the loop is shared with other masses
    base.set_tool_mass(loop.scene.model, "tool", mass)
    mujoco.mj_setConst(loop.scene.model, loop.scene.data)
    swing = 2 * np.pi * (mass / stiffness) ** 0.5
    return loop.run(
        device,
        coupling_of(stiffness),
        METHODS[name],
        period=PERIOD,
        ticks=max(TICKS, round(SWINGS * swing / PERIOD)) if is_knocked else TICKS,
        knock=KNOCK if is_knocked else None,
    )


def _limit(name: str, stiffness: float, *, is_held: bool) -> Mapping[str, float | bool]:
    """Searches for the mass at which stability changes; NaN without a change."""

    def is_stable(mass: float) -> bool:
        # an unstable tool has no worst hand: theory tunes it to a stable one
        return held_still(name, stiffness, mass).is_stable and (
            is_held or worst_hand(name, stiffness, mass).is_stable
        )

    return _change(is_stable, base.WIDTH)


def predicted_limit(name: str, stiffness: float, *, is_held: bool) -> Mapping[str, float | bool]:
    """Returns the theoretical mass at which stability changes, within ``MASS``.

    Args:
        name: One of ``SHOWN``.
        stiffness: K in N/m, > 0.
        is_held: True for a handle that is held still; False for the worst hand of the device.

    Returns:
        ``limit`` in kg, NaN where there is none; ``stable_if_light`` and ``stable_if_heavy``: at
        the ends of the range.
    """
    theory, damping = THEORIES[name], law_damping(name, stiffness)

    def is_stable(mass: float) -> bool:
        needed = worst_angle(theory, stiffness, damping, mass, PERIOD)[1]
        return np.isfinite(needed) if is_held else needed < DEVICE_DAMPING

    return _change(is_stable, base.WIDTH / 10)


def _change(is_stable: Callable[[float], bool], width: float) -> Mapping[str, float | bool]:
    first, last = (is_stable(mass) for mass in MASS)
    limits = {"limit": float("nan"), "stable_if_light": first, "stable_if_heavy": last}
    if first == last:
        return limits
    bracket = base.largest_stable(lambda mass: is_stable(mass) == first, *MASS, width)
    return limits | {"limit": bracket.middle}


def is_stable(cells: Table) -> NDArray[np.bool_]:
    """Returns the stable points of a tool, held still and in the worst hand."""
    return np.asarray(
        (cells.numbers("stable_held_still") == 1) & (cells.numbers("stable_worst_hand") == 1)
    )


Array = NDArray[np.float64]

CONTOUR = 61
"""Points along each axis from which the worst hand's bound is drawn. More make it smoother and take
a tenth of a millisecond each."""

_MARKERS = {"held still": "s", "worst hand": "o"}

_LINES = (
    ("(6): b = K T/2 + B′", "black", "-"),
    ("implicitfast: slack used up, K = B/T", "black", "-."),
    ("least mass by theory, held still", base.THEORY_COLOUR, ":"),
    ("limit by theory, worst hand", base.THEORY_COLOUR, "--"),
)


def draw(table: Table, _boundary: Mapping[str, Any]) -> Figure:
    """Draws stiffness against mass by method, theory on top."""
    figure = new_figure(8, 7.6)
    panels = base.panels(figure, len(SHOWN))
    for axes, name in zip(panels, SHOWN, strict=True):
        cells = base.of_method(table, "cell", name)
        verdict = base.verdict_numbers(is_stable(cells), cells.texts("environment"))
        base.draw_verdicts(axes, cells["mass"], cells["stiffness"], verdict, log_x=True, log_y=True)
        _draw_theory(axes, name)
        for what, marker in _MARKERS.items():
            rows = base.of_method(table, what, name)
            axes.plot(
                rows.numbers("limit"), rows["stiffness"], marker, color="black", mfc="white", ms=4.5
            )
        axes.set_title(name, fontsize="medium")
        axes.set(xlim=MASS, ylim=STIFFNESS)
    for axes in panels[-3:]:
        axes.set_xlabel("tool mass m (kg)")
        axes.set_xticks(np.geomspace(MASS[0], MASS[1] / 10, 4))  # the last would touch the next
    for axes in panels[::3]:
        axes.set_ylabel("coupling stiffness K (N/m)")
    figure.suptitle(
        f"Which tool at which stiffness: free tool, B = {DAMPING:g} N s/m, "
        f"device damping b = {DEVICE_DAMPING:g} N s/m, {1 / PERIOD:g} Hz;\n"
        "the law of 'compensated' uses B′ = B − K T, of 'lossless' B − K T/2 (0 at least)",
        fontsize="medium",
    )
    measured = [(f"measured, {what}", "black", marker) for what, marker in _MARKERS.items()]
    base.verdict_legend(figure, [*_LINES, *measured], columns=3)
    return figure


@cache
def _needed(name: str) -> tuple[Array, Array, Array]:
    """Returns mass, stiffness and the required device damping in theory, (n,), (n,), (n, n)."""
    mass, stiffness = np.geomspace(*MASS, CONTOUR), np.geomspace(*STIFFNESS, CONTOUR)
    needed = [
        [worst_angle(THEORIES[name], k, law_damping(name, k), m, PERIOD)[1] for m in mass]
        for k in stiffness
    ]
    return mass, stiffness, np.array(needed)


def _draw_theory(axes: Axes, name: str) -> None:
    mass, stiffness, needed = _needed(name)
    least = np.array([min_mass(THEORIES[name], k, law_damping(name, k), PERIOD) for k in stiffness])
    is_shown = np.isfinite(least) & (least > 0)
    axes.plot(least[is_shown], stiffness[is_shown], color=base.THEORY_COLOUR, ls=":", lw=2.2)
    axes.contour(
        mass,
        stiffness,
        # no damping suffices for an unstable tool; the cap makes that a number
        np.minimum(needed, 3 * DEVICE_DAMPING),
        levels=[DEVICE_DAMPING],
        colors=base.THEORY_COLOUR,
        linestyles="--",
        linewidths=1.6,
    )
    if name == "implicitfast":
        # its spring lags by a step, so E_k = K δx² − ½ m (Δv)², against a slack of ½ (K + B/T) δx²
        axes.axhline(DAMPING / PERIOD, color="black", ls="-.", lw=1.4)
    axes.axhline(float(base.limit_by_6(name, DEVICE_DAMPING, DAMPING)), color="black", lw=1.8)


def summarize(table: Table) -> dict[str, Any]:
    """Counts failures by method, and compares the limits in mass with theory."""
    methods: dict[str, dict[str, Any]] = {}
    for name in SHOWN:
        cells = base.of_method(table, "cell", name)
        methods[name] = _counts(name, cells) if len(cells) else {}
        for what in SEARCHES:
            rows = base.of_method(table, what, name)
            if len(rows):
                methods[name][what] = _compare(name, rows, is_held=what == "held still")
    return {
        "period": PERIOD,
        "device_damping": DEVICE_DAMPING,
        "damping": DAMPING,
        "methods": methods,
    }


def _counts(name: str, cells: Table) -> dict[str, Any]:
    """Returns the number of unstable tools, and the energy that the stable ones created."""
    stable = is_stable(cells)
    is_below = base.needed_by_6(name, cells["stiffness"], DAMPING) < DEVICE_DAMPING
    return {
        "points": len(cells),
        "unstable_held_still": int((cells.numbers("stable_held_still") != 1).sum()),
        "points_below_6": int(is_below.sum()),
        "unstable_below_6": int((is_below & ~stable).sum()),
        "max_created": float(cells.numbers("created")[stable].max(initial=0.0)),
    }


def _compare(name: str, rows: Table, *, is_held: bool) -> dict[str, Any]:
    """Returns the measured limits beside theory's; None where there is none."""
    predicted = [predicted_limit(name, float(k), is_held=is_held) for k in rows["stiffness"]]
    theory = np.array([p["limit"] for p in predicted], dtype=np.float64)
    limit = rows.numbers("limit")
    ends = ("stable_if_light", "stable_if_heavy")
    is_same = [
        np.array([p[end] for p in predicted], dtype=bool) == (rows.numbers(end) == 1)
        for end in ends
    ]
    return {
        "stiffness": rows["stiffness"].tolist(),
        "measured_mass": [float(m) if np.isfinite(m) else None for m in limit],
        "predicted_mass": [float(m) if np.isfinite(m) else None for m in theory],
        "worst_ratio_error": base.agreement(limit, theory),
        "disagreements": int((~(is_same[0] & is_same[1])).sum()),
    }


def sentences(boundary: Mapping[str, Any]) -> Sentences:
    """States by method the unstable range, and the agreement of the limits in mass with theory."""
    for name, selected in boundary["methods"].items():
        yield (
            "'{name}': held still, a tool is unstable at {unstable_held_still} of {points} points "
            "of the grid; below (6), held still or in its worst hand, at {unstable_below_6} of "
            "{points_below_6}; where stable, it creates at most {max_created:.2g} J",
            selected | {"name": name},
        )
        for what in SEARCHES:
            yield (
                "'{name}', {what}: limits in mass agree with theory within "
                "{worst_ratio_error:.2%}; on whether there is one they disagree "
                "{disagreements} times",
                selected.get(what, {}) | {"name": name, "what": what},
            )


TWIN_METHOD, TWIN_STIFFNESS = "explicit", 9000.0
"""Method and K in N/m of the twins; ``min_mass`` is 4.75 g."""

TWIN_MASSES = (0.0045, 0.01)
"""Masses of the twins' tools in kg."""

TWIN_INERTIA = 1e-5
"""Moment of inertia of the twins' tools in kg m²; they do not turn."""


def twins() -> Twins:
    """Returns a hand that swings a free tool, lighter and heavier than ``min_mass``."""
    return Twins(
        shared=f"A hand swings a free tool, method '{TWIN_METHOD}', K = {TWIN_STIFFNESS:g} N/m and "
        f"B = {DAMPING:g} N s/m",
        name="mass of the tool",
        unit="g",
        factor=1e3,
        values=TWIN_MASSES,
        run=lambda mass: Run(
            scene=partial(base.scene_of, base.free_body(mass, np.full(3, TWIN_INERTIA))),
            device=partial(SimulatedDevice, damping=DEVICE_DAMPING, path=PATH, **NO_LIMITS),
            coupling=coupling_of(TWIN_STIFFNESS),
            options=replace(UNGUARDED_OPTIONS, method=TWIN_METHOD, rate=1 / PERIOD),
            duration=0.1,  # a little longer, and the lighter tool is no longer finite
        ),
    )
