"""Map ``tool_mass``: how light a tool each method can render, and how heavy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hapticbridge.coupling import Coupling
from hapticbridge.device import Motion, SimulatedDevice
from hapticbridge.passivity import WorstHand, maximum_stiffness
from hapticbridge.picture import new_figure
from hapticbridge.rendering import METHODS
from hapticbridge.study.closed_loop import LoopOutcome
from hapticbridge.study.maps.bisection import WIDTH, agreement, largest_stable
from hapticbridge.study.maps.free_tool import NAMES, felt, least_mass, worst_angle
from hapticbridge.study.maps.rigs import loop_in, set_tool_mass
from hapticbridge.study.maps.stability_map import Finding, Point, StabilityMap
from hapticbridge.study.maps.verdicts import (
    COLOURS,
    VERDICTS,
    draw_verdicts,
    verdict_numbers,
)
from hapticbridge.study.table import Table

PERIOD = 1e-3
DEVICE_DAMPING = 20.0
"""b in N s/m: a well damped device, so that stiff couplings are in play. The loop is linear: with a
tenth of b, B and K everything here happens at a tenth of the tool's mass."""

DAMPING = 5.0
"""B in N s/m, a quarter of b, as a default coupling has it."""


MASS = (1e-3, 10.0)
"""Range of the tool's mass in kg, even in its logarithm."""

STIFFNESS = (1000.0, 60_000.0)
"""Range of K in N/m, even in its logarithm: up to twice the bound (6) of 30 kN/m."""

TICKS = 2000
SWINGS = 8.0
"""Swings of the tool on the coupling that a run must hold at least: a fifth of it is judged, and a
fraction of a swing would be taken for growth or decay. More takes longer."""

KNOCK = np.array([1e-4, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Displacement that starts a run, in m."""

HELD_STILL = 1e9
"""Mass in kg of a device that nobody moves: the handle is held still to 1e-12 m."""


def _swinging() -> Motion:
    """Returns the path of a hand that swings the tool by 5 mm at 3 Hz, and turns nothing."""
    time = np.linspace(0.0, 2.0, 401)
    path = np.zeros((time.size, 3))
    path[:, 0] = 0.0025 * (1 - np.cos(6 * np.pi * time))
    return Motion(time, path)


PATH = _swinging()

LIMITS = 9
"""Values of K per method at which the limits in mass are searched."""

_BLUE = "#1a5fb4"
_MARKERS = {"held still": "s", "worst hand": "o"}


def points(count: int) -> Sequence[Point]:
    """Returns a grid of mass and stiffness per method, and searches for the limit in mass."""
    side = max(2, round((count / len(NAMES)) ** 0.5))
    stiffness = np.geomspace(*STIFFNESS, side)
    cells: list[Point] = [
        {"what": "cell", "method": name, "stiffness": float(k), "mass": float(m)}
        for name in NAMES
        for k in stiffness
        for m in np.geomspace(*MASS, side)
    ]
    # two to a column of the picture, and away from the grid's own values
    limits: list[Point] = [
        {"what": what, "method": name, "stiffness": float(k), "mass": 0.0}
        for name in NAMES
        for k in np.geomspace(1.1 * STIFFNESS[0], STIFFNESS[1] / 1.1, min(LIMITS, side))
        for what in ("held still", "worst hand")
    ]
    return cells + limits


def evaluate(point: Point) -> Mapping[str, float | str | bool]:
    """Runs one tool behind a handle held still, in the worst hand and in an ordinary one.

    Or searches for the mass from which on it is stable in one of the first two.
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
    """Runs a free tool in the hand that is worst for this method, mass and stiffness."""
    angle, _ = worst_angle(name, stiffness, DAMPING, mass, PERIOD)
    response = complex(felt(name, stiffness, DAMPING, mass, PERIOD, angle))
    hand = WorstHand(DEVICE_DAMPING, angle / PERIOD, PERIOD, response)
    return _run(SimulatedDevice(hand=hand), name, stiffness, mass)


def _run(
    device: SimulatedDevice, name: str, stiffness: float, mass: float, *, is_knocked: bool = True
) -> LoopOutcome:
    loop = loop_in("point_mass", "tool_mass")
    # the mass is set before every run: the loop is shared with other masses
    set_tool_mass(loop.scene.model, "tool", mass)
    mujoco.mj_setConst(loop.scene.model, loop.scene.data)
    swing = 2 * np.pi * (mass / stiffness) ** 0.5
    return loop.run(
        device,
        Coupling(stiffness, DAMPING, 0.0, 0.0),  # nothing turns
        METHODS[name],
        period=PERIOD,
        ticks=max(TICKS, round(SWINGS * swing / PERIOD)) if is_knocked else TICKS,
        knock=KNOCK if is_knocked else None,
    )


def _limit(name: str, stiffness: float, *, is_held: bool) -> Mapping[str, float | bool]:
    """Searches for the mass at which stability changes; NaN where it does not."""

    def is_stable(mass: float) -> bool:
        # a tool that is unstable by itself has no worst hand: theory tunes it to a stable one
        return held_still(name, stiffness, mass).is_stable and (
            is_held or worst_hand(name, stiffness, mass).is_stable
        )

    return _change(is_stable, WIDTH)


def predicted_limit(name: str, stiffness: float, *, is_held: bool) -> Mapping[str, float | bool]:
    """Returns where theory has the mass at which stability changes, within ``MASS``.

    Args:
        name: One of ``NAMES``.
        stiffness: K in N/m, > 0.
        is_held: Whether the handle is held still, or held by the worst hand of the device.

    Returns:
        ``limit`` in kg, NaN where there is none; ``stable_if_light`` and ``stable_if_heavy``: at
        the ends of the range.

    Raises:
        StudyError: The method is none of these, or the stiffness is out of range.
    """

    def is_stable(mass: float) -> bool:
        needed = worst_angle(name, stiffness, DAMPING, mass, PERIOD)[1]
        return np.isfinite(needed) if is_held else needed < DEVICE_DAMPING

    return _change(is_stable, WIDTH / 10)


def _change(is_stable: Callable[[float], bool], width: float) -> Mapping[str, float | bool]:
    first, last = (is_stable(mass) for mass in MASS)
    found = {"limit": float("nan"), "stable_if_light": first, "stable_if_heavy": last}
    if first == last:
        return found
    bracket = largest_stable(lambda mass: is_stable(mass) == first, *MASS, width)
    return found | {"limit": bracket.middle}


def read(table: Table) -> Finding:
    """Draws stiffness against mass by method, theory on top, and compares the limits in mass."""
    cells = table.select(table["what"] == "cell")
    figure = new_figure(9, 8)
    panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    boundary: dict[str, Any] = {}
    for axes, name in zip(panels, NAMES, strict=True):
        mine = cells.select(cells["method"] == name)
        is_stable = mine["stable_held_still"].astype(bool) & mine["stable_worst_hand"].astype(bool)
        verdict = verdict_numbers(is_stable, mine["environment"])
        draw_verdicts(axes, mine["mass"], mine["stiffness"], verdict, log_x=True, log_y=True)
        _draw_theory(axes, name)
        boundary[name] = {
            "unstable_held_still": int((~mine["stable_held_still"].astype(bool)).sum())
        }
        is_below = mine["stiffness"] < maximum_stiffness(DEVICE_DAMPING, PERIOD, DAMPING)
        boundary[name]["points_below_6"] = int(is_below.sum())
        boundary[name]["unstable_below_6"] = int((~is_stable[is_below]).sum())
        boundary[name]["most_created"] = float(mine["created"][is_stable].max(initial=0.0))
        for what, marker in _MARKERS.items():
            rows = table.select((table["what"] == what) & (table["method"] == name))
            boundary[name][what] = _compare(name, rows, is_held=what == "held still")
            axes.plot(rows["limit"], rows["stiffness"], marker, color="black", mfc="white", ms=4.5)
        axes.set_title(name, fontsize="medium")
        axes.set_xlim(*MASS)
        axes.set_ylim(*STIFFNESS)
    for axes in panels[2:]:
        axes.set_xlabel("tool mass m (kg)")
    for axes in panels[::2]:
        axes.set_ylabel("coupling stiffness K (N/m)")
    figure.suptitle(
        f"Which tool at which stiffness: free tool, B = {DAMPING:g} N s/m, "
        f"device damping b = {DEVICE_DAMPING:g} N s/m, {1 / PERIOD:g} Hz",
        fontsize="medium",
    )
    lines = [
        Line2D([], [], color="black", lw=1.8, label="(6): K = 2 (b − B)/T"),
        Line2D(
            [], [], color="black", ls="-.", lw=1.4, label="implicitfast: slack used up, K = B/T"
        ),
        Line2D([], [], color=_BLUE, ls=":", lw=2.2, label="theory, handle held still"),
        Line2D([], [], color=_BLUE, ls="--", label="theory, worst hand"),
        *(
            Line2D([], [], ls="", marker=marker, color="black", mfc="white", label=label)
            for marker, label in (("s", "measured, held still"), ("o", "measured, worst hand"))
        ),
    ]
    patches = [Patch(facecolor=c, label=v) for v, c in zip(VERDICTS, COLOURS, strict=True)]
    figure.legend(
        handles=[*patches, *lines],
        loc="outside lower center",
        ncols=4,
        fontsize="small",
        frameon=False,
    )
    return Finding(
        figure,
        _paragraph(boundary),
        {
            "period": PERIOD,
            "device_damping": DEVICE_DAMPING,
            "damping": DAMPING,
            "methods": boundary,
        },
    )


def _compare(name: str, rows: Table, *, is_held: bool) -> dict[str, Any]:
    """Returns the limits that were found beside theory's; None where there is none."""
    predicted = [predicted_limit(name, float(k), is_held=is_held) for k in rows["stiffness"]]
    theory = np.array([p["limit"] for p in predicted], dtype=np.float64)
    same = np.array(
        [
            p["stable_if_light"] == light and p["stable_if_heavy"] == heavy
            for p, light, heavy in zip(
                predicted, rows["stable_if_light"], rows["stable_if_heavy"], strict=True
            )
        ],
        dtype=bool,
    )
    return {
        "stiffness": rows["stiffness"].tolist(),
        "measured_mass": [float(m) if np.isfinite(m) else None for m in rows["limit"]],
        "predicted_mass": [float(m) if np.isfinite(m) else None for m in theory],
        "worst_ratio_error": agreement(rows["limit"], theory),
        "disagreements": int((~same).sum()),
    }


def _paragraph(boundary: Mapping[str, Any]) -> str:
    said = []
    for name in NAMES:
        mine = boundary[name]
        held = mine["held still"]
        heaviest = max((m for m in held["measured_mass"] if m is not None), default=None)
        unstable = mine["unstable_held_still"]
        text = f"'{name}': "
        if unstable == 0:
            text += "with the handle held still stable at every mass"
        else:
            text += f"with the handle held still unstable at {unstable} points"
        if heaviest is not None:
            text += f"; the heaviest limit searched for is {1e3 * heaviest:.3g} g"
        text += f"; below (6) unstable at {mine['unstable_below_6']} of {mine['points_below_6']}"
        text += f" points; most energy created where stable {mine['most_created']:.2g} J"
        said.append(text)
    errors = [
        mine[what]["worst_ratio_error"]
        for mine in boundary.values()
        for what in _MARKERS
        if mine[what]["worst_ratio_error"] is not None
    ]
    astray = sum(mine[what]["disagreements"] for mine in boundary.values() for what in _MARKERS)
    worst = f"within {100 * max(errors):.2g} %" if errors else "nowhere comparable"
    return (
        ". ".join(said) + f". Measured limits in mass agree with theory {worst}; theory and "
        f"measurement disagree on whether there is a limit at {astray} of the searches."
    )


def _draw_theory(axes: Axes, name: str) -> None:
    stiffness, mass = np.geomspace(*STIFFNESS, 45), np.geomspace(*MASS, 37)
    least = np.array([least_mass(name, k, DAMPING, PERIOD) for k in stiffness])
    is_shown = np.isfinite(least) & (least > 0)
    axes.plot(least[is_shown], stiffness[is_shown], color=_BLUE, ls=":", lw=2.2)
    needed = [[worst_angle(name, k, DAMPING, m, PERIOD)[1] for m in mass] for k in stiffness]
    axes.contour(
        mass,
        stiffness,
        np.minimum(needed, 10 * DEVICE_DAMPING),
        levels=[DEVICE_DAMPING],
        colors=_BLUE,
        linestyles="--",
        linewidths=1.6,
    )
    if name == "implicitfast":
        # its spring lags by a step, so E_k = K δx² − ½ m (Δv)², against a slack of ½ (K + B/T) δx²
        axes.axhline(DAMPING / PERIOD, color="black", ls="-.", lw=1.4)
    axes.axhline(maximum_stiffness(DEVICE_DAMPING, PERIOD, DAMPING), color="black", lw=1.8)


TOOL_MASS = StabilityMap(
    name="tool_mass",
    about="mass of the tool, 1 g to 10 kg, against stiffness of the coupling, by method",
    default_points=640,
    points=points,
    evaluate=evaluate,
    read=read,
)
