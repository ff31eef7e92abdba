"""What the map ``coupling`` runs: worst hands with a wall and a free tool, and a hand that taps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.rendering import METHODS
from hapticbridge.study.closed_loop import ClosedLoop, LoopOutcome
from hapticbridge.study.maps.bisection import largest_stable
from hapticbridge.study.maps.free_tool import felt, worst_angle
from hapticbridge.study.maps.rigs import free_tool_and_wall, loop_in, swinging, wall_loop
from hapticbridge.study.maps.stability_map import Point
from hapticbridge.study.maps.verdicts import verdict_numbers
from hapticbridge.study.table import Table
from hapticbridge.theory.sampled_loop import WorstHand

PERIOD = 1e-3
"""T in s."""

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
    "compensated": "implicit",
    "lossless": "lossless",
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

SEARCHED = (1.0, 200_000.0)
"""Range of K in N/m in which a limit on a wall is searched: far beyond the picture's on both sides,
and the same for every B."""


PATH = swinging(0.0075, 1.5, duration=2.0, count=201)
"""Of a hand that goes 5 mm deep into the wall three times in 2 s."""


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
    used = METHODS[name].used(coupling, PERIOD)
    k, b = used.stiffness, used.damping
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
    return wall_loop(WALL_MASS, free_tool_and_wall)


def _limit_on_wall(name: str, damping: float) -> float:
    """Returns the largest K in N/m at which the wall's worst hand is stable; 0 for none."""

    def is_stable(stiffness: float) -> bool:
        return _worst_hand(name, _coupling(stiffness, damping), None).is_stable

    return largest_stable(is_stable, *SEARCHED).middle


def of_method(table: Table, what: str, name: str) -> Table:
    """Returns the rows of one method that are ``cell`` or ``limit``."""
    return table.select((table["what"] == what) & (table["method"] == name))


def verdicts_of(cells: Table) -> NDArray[np.int64]:
    """Returns the verdict of each cell: its place in ``VERDICTS``, shape (n,).

    Unstable is where a run that was measured failed; a missing value is no measurement.
    """
    is_stable = np.ones(len(cells), dtype=bool)
    for column in STABLE:
        value = cells.numbers(column)
        is_stable &= np.isnan(value) | (value == 1)
    return verdict_numbers(is_stable, cells.texts("environment"))
