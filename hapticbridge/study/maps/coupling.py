"""Map ``coupling``: stiffness against damping at one device, for every method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import Motion, SimulatedDevice
from hapticbridge.passivity import WorstHand, maximum_stiffness
from hapticbridge.picture import new_figure
from hapticbridge.rendering import METHODS
from hapticbridge.study.closed_loop import ClosedLoop, LoopOutcome
from hapticbridge.study.maps.bisection import agreement, largest_stable, per_cent
from hapticbridge.study.maps.free_tool import felt, worst_angle
from hapticbridge.study.maps.rigs import free_tool_and_wall, loop_in, set_tool_mass
from hapticbridge.study.maps.stability_map import Finding, Point, StabilityMap
from hapticbridge.study.maps.verdicts import (
    VERDICTS,
    draw_verdicts,
    verdict_legend,
    verdict_numbers,
)
from hapticbridge.study.table import Table

PERIOD = 1e-3
DEVICE_DAMPING = 2.0
"""b in N s/m, that of the default simulated device."""

TOOL_MASS = 0.05
"""In kg, that of the scene ``virtual_wall``, whose tool and wall these are, without the rail."""

WALL_MASS = 1e6
"""In kg: a tool that moves for no hand, and so a wall of known place without MuJoCo's contact. Its
limit is (6) to within T (KT/2 + B)/(2 m) = 1e-9; a lighter one drifts, which is no decay."""

STABLE = ("stable_on_wall", "stable_free", "stable_tapping")
"""Columns that must all be true where a loop is stable; one that was not measured is left out."""

TICKS = 2000
KNOCK = np.array([1e-4, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Displacement that starts a run of the worst hand, in m: 0.1 mm, so that a loop that decays never
reaches the wall 10 mm away."""

THEORIES: Mapping[str, str] = {
    "implicit": "implicit",
    "implicitfast": "implicitfast",
    "implicitfast:compensated": "implicit",
    "explicit": "explicit",
    "explicit:rk4": "explicit:rk4",
    "weld": "implicit",
}
"""Which theory of a free tool a method's worst hand is tuned with. The weld's law is not the
coupling's: its hand is that of the nominal K and B. On a heavy tool it is stiffer by the mass, so
for it there is no wall without contact."""

STIFFNESS = (100.0, 20_000.0)
"""Range of K in N/m, even in its logarithm: from soft to five times the bound at B = 0."""

DAMPING = (0.0, 3.0)
"""Range of B in N s/m, up to one and a half times b, beyond which nothing is passive."""


CONTOUR = 41
"""Points along each axis from which the free tool's bound is drawn; more make it smoother."""

SEARCHED = (1.0, 200_000.0)
"""Range of K in N/m in which a limit on a wall is searched: far beyond the picture's on both sides,
and the same for every B."""


def _touching() -> Motion:
    """Returns the path of a hand that goes 5 mm deep into the wall three times in 2 s."""
    time = np.linspace(0.0, 2.0, 201)
    path = np.zeros((time.size, 3))
    path[:, 0] = 0.0075 * (1 - np.cos(3 * np.pi * time))
    return Motion(time, path)


PATH = _touching()


def points(count: int) -> Sequence[Point]:
    """Returns a grid of K and B for every method, ``count`` runs in all, and a limit per column.

    A cell takes three runs.
    """
    side = max(2, round((count / 3 / len(THEORIES)) ** 0.5))
    stiffness = np.geomspace(*STIFFNESS, side)
    damping = np.linspace(*DAMPING, side)
    cells: list[Point] = [
        {"what": "cell", "method": method, "stiffness": float(k), "damping": float(b)}
        for method in THEORIES
        for b in damping
        for k in stiffness
    ]
    limits: list[Point] = [
        {"what": "limit", "method": method, "stiffness": 0.0, "damping": float(b)}
        for method in THEORIES
        if METHODS[method].has_law
        for b in damping[damping < DEVICE_DAMPING]
    ]
    return cells + limits


def evaluate(point: Point) -> Mapping[str, float | str | bool]:
    """Runs one coupling three times for 2 s, or finds the largest K that is stable on a wall.

    A wall and a free tool, each with its worst hand, say whether the loop is stable. A wall without
    contact exists only where there is a coupling law: for the weld it is not run, and the value is
    missing. An ordinary hand that taps a wall says what the environment creates, and whether the
    device is given what nobody pays for: its run fails where it diverges, or where the first fault
    is the device's port. ``fault_tick`` and ``fault_port`` name the first fault, −1 and nothing if
    there is none.
    """
    name, damping = str(point["method"]), float(point["damping"])
    if point["what"] == "limit":
        return {"limit": _limit_on_wall(name, damping)}
    coupling = _coupling(float(point["stiffness"]), damping)
    on_wall: dict[str, bool] = {}
    if METHODS[name].has_law:
        on_wall = {"stable_on_wall": _worst_hand(name, coupling, None).is_stable}
    is_stable_free = _worst_hand(name, coupling, TOOL_MASS).is_stable
    touch = _tool().run(
        SimulatedDevice(damping=DEVICE_DAMPING, path=PATH),
        coupling,
        METHODS[name],
        period=PERIOD,
        ticks=TICKS,
    )
    tick, port = touch.fault or (-1, "")
    return on_wall | {
        "stable_free": is_stable_free,
        "stable_tapping": touch.ticks == TICKS and port != "device",
        "fault_tick": tick,
        "fault_port": port,
        "environment": touch.environment,
        "created": touch.created,
        "slack_share": touch.slack_share,
        "peak_force": touch.peak_force,
    }


def _coupling(stiffness: float, damping: float) -> Coupling:
    return Coupling(stiffness, damping, 1.0, 1e-3)  # the rail lets nothing turn


def _worst_hand(name: str, coupling: Coupling, mass: float | None) -> LoopOutcome:
    """Runs the hand that is worst for a method on a wall (no mass) or with a free tool."""
    k, b = coupling.stiffness, coupling.damping
    if mass is None:  # at Nyquist, where the damper alone is the worst hand
        hand, loop = WorstHand(DEVICE_DAMPING, np.pi / PERIOD, PERIOD), _wall()
    else:
        angle, _ = worst_angle(THEORIES[name], k, b, mass, PERIOD)
        response = complex(felt(THEORIES[name], k, b, mass, PERIOD, angle))
        hand, loop = WorstHand(DEVICE_DAMPING, angle / PERIOD, PERIOD, response), _tool()
    return loop.run(
        SimulatedDevice(hand=hand),
        coupling,
        METHODS[name],
        period=PERIOD,
        ticks=TICKS,
        knock=KNOCK,
    )


def _tool() -> ClosedLoop:
    return loop_in(free_tool_and_wall)


def _wall() -> ClosedLoop:
    return loop_in(free_tool_and_wall, "heavy", _make_heavy)


def _make_heavy(model: mujoco.MjModel) -> None:
    set_tool_mass(model, "tool", WALL_MASS)


def _limit_on_wall(name: str, damping: float) -> float:
    """Returns the largest K in N/m at which the wall's worst hand is stable; 0 for none."""

    def is_stable(stiffness: float) -> bool:
        return _worst_hand(name, _coupling(stiffness, damping), None).is_stable

    return largest_stable(is_stable, *SEARCHED).middle


def read(table: Table) -> Finding:
    """Draws K against B by method, with the bounds on top, and compares the limits with (6)."""
    cells = table.select(table["what"] == "cell")
    limits = table.select(table["what"] == "limit")
    figure = new_figure(8, 6.4)
    panels = figure.subplots(2, 3, sharex=True, sharey=True).ravel()
    shares: dict[str, float | None] = {}
    boundary: dict[str, dict[str, Any]] = {}
    for axes, name in zip(panels, THEORIES, strict=True):
        mine = cells.select(cells["method"] == name)
        is_stable = _is_stable(mine)
        verdict = verdict_numbers(is_stable, mine["environment"])
        draw_verdicts(axes, mine["damping"], mine["stiffness"], verdict, log_y=True)
        has_law = METHODS[name].has_law
        _draw_theory(axes, THEORIES[name], has_wall=has_law)
        found = limits.select(limits["method"] == name)
        axes.plot(found["damping"], found.numbers("limit"), "o", color="black", ms=4, mfc="white")
        title = name if has_law else f"{name}: free tool and tapping only"
        axes.set_title(title, fontsize="medium")
        below = mine["stiffness"] < 2 * (DEVICE_DAMPING - mine["damping"]) / PERIOD
        passive = verdict <= VERDICTS.index("within slack")
        shares[name] = float(np.mean(passive[below])) if below.any() else None
        boundary[name] = {
            "passive_share_below_6": shares[name],
            "runs_below_6": int(below.sum()),
            "environment_faults_below_6": int((mine["fault_port"][below] == "environment").sum()),
            "device_faults_below_6": int((mine["fault_port"][below] == "device").sum()),
            "most_slack_used_below_6": float(mine["slack_share"][below].max(initial=0.0)),
            "largest_tapping_force_below_6": float(mine["peak_force"][below].max(initial=0.0)),
        }
        if len(found):
            predicted = np.asarray(maximum_stiffness(DEVICE_DAMPING, PERIOD, found["damping"]))
            boundary[name] |= {
                "damping": found["damping"].tolist(),
                "measured_on_wall": found.numbers("limit").tolist(),
                "predicted_6": predicted.tolist(),
                "largest_deviation": agreement(found.numbers("limit"), predicted),
            }
    for axes in panels:
        axes.set_xlim(*DAMPING)
        axes.set_ylim(*STIFFNESS)
    for axes in panels[3:]:
        axes.set_xlabel("coupling damping B (N s/m)")
    for axes in panels[::3]:
        axes.set_ylabel("coupling stiffness K (N/m)")
    figure.suptitle(
        f"K against B, device damping b = {DEVICE_DAMPING:g} N s/m at {1 / PERIOD:g} Hz;\n"
        f"worst hands on a wall and with a tool of {1e3 * TOOL_MASS:g} g, and a hand that taps",
        fontsize="medium",
    )
    verdict_legend(
        figure,
        [
            ("(6): K = 2 (b − B)/T", "black", "-"),
            ("(7), Tustin's rule, at low frequency", "black", ":"),
            (f"free tool of {1e3 * TOOL_MASS:g} g by this method", "#1a5fb4", "--"),
            ("measured limit on a wall", "black", "o"),
        ],
    )
    return Finding(
        figure,
        _paragraph(boundary),
        {"period": PERIOD, "device_damping": DEVICE_DAMPING, "methods": boundary},
    )


def _is_stable(cells: Table) -> NDArray[np.bool_]:
    """Returns where no run that was measured failed; a missing value is no measurement."""
    is_stable = np.ones(len(cells), dtype=bool)
    for column in STABLE:
        if column in cells.columns:
            value = cells[column].astype(np.float64)
            is_stable &= np.isnan(value) | (value == 1)
    return is_stable


def _paragraph(boundary: Mapping[str, Any]) -> str:
    worst = boundary["implicit"].get("largest_deviation")
    said = [
        f"On a wall the worst hand turns 'implicit' unstable {per_cent(worst)} of "
        "K = 2 (b − B)/T, eq. (6)"
    ]
    for name, mine in boundary.items():
        if not mine["runs_below_6"]:
            said.append(f"'{name}': no point could be computed below (6)")
            continue
        text = (
            f"'{name}' is stable and passive at {100 * mine['passive_share_below_6']:.0f} % of the "
            "points below (6)"
        )
        faults = [
            f"the {port} port at {mine[f'{port}_faults_below_6']}"
            for port in ("environment", "device")
            if mine[f"{port}_faults_below_6"]
        ]
        if faults:
            text += f"; the hand that taps finds at fault {' and '.join(faults)} of "
            text += f"{mine['runs_below_6']}"
        else:
            text += "; the hand that taps finds no port at fault"
            if mine["most_slack_used_below_6"] > 0:
                text += f" and {100 * mine['most_slack_used_below_6']:.0f} % of the slack used"
        said.append(text)
    return ". ".join(said) + ". The table holds tick and port of every first fault."


def _draw_theory(axes: Axes, theory: str, *, has_wall: bool) -> None:
    """Draws what was measured against: (6) and (7) only where a wall was."""
    damping = np.linspace(DAMPING[0], DAMPING[1], 121)
    below = damping[damping < DEVICE_DAMPING]
    b = DEVICE_DAMPING
    if has_wall:
        axes.plot(below, maximum_stiffness(b, PERIOD, below), color="black", lw=1.8)
        # (7) as θ → 0: (K T)² = 2 b (K T + 2 B)
        axes.plot(
            damping, (b + np.sqrt(b**2 + 4 * b * damping)) / PERIOD, color="black", ls=":", lw=1.5
        )
    grid_b, grid_k = np.meshgrid(np.linspace(*DAMPING, CONTOUR), np.geomspace(*STIFFNESS, CONTOUR))
    needed = np.array(
        [
            worst_angle(theory, stiffness, own, TOOL_MASS, PERIOD)[1]
            for stiffness, own in zip(grid_k.flat, grid_b.flat, strict=True)
        ]
    ).reshape(grid_k.shape)
    axes.contour(
        grid_b,
        grid_k,
        np.minimum(needed, 10 * b),
        levels=[b],
        colors="#1a5fb4",
        linestyles="--",
        linewidths=1.5,
    )


COUPLING = StabilityMap(
    name="coupling",
    about="stiffness against damping of the coupling at one device, for every method: stable and "
    "passive, or not",
    default_points=4500,
    points=points,
    evaluate=evaluate,
    read=read,
)
