"""Runs of free tools of any mass by method, and the limit in mass that theory has for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.rendering import METHODS
from hapticbridge.study.closed_loop import LoopOutcome
from hapticbridge.study.maps.bisection import WIDTH, largest_stable
from hapticbridge.study.maps.bound_of_method import used_damping
from hapticbridge.study.maps.free_tool import felt, worst_angle
from hapticbridge.study.maps.rigs import loop_in, set_tool_mass, swinging
from hapticbridge.study.maps.stability_map import Point
from hapticbridge.study.table import Table
from hapticbridge.theory.sampled_loop import WorstHand

PERIOD = 1e-3
"""T in s."""

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

PATH = swinging(0.0025, 3.0, duration=2.0, count=401)
"""Of a hand that swings the tool by 5 mm at 3 Hz, and turns nothing."""

THEORIES: Mapping[str, str] = {
    "implicit": "implicit",
    "compensated": "implicit",
    "lossless": "lossless",
    "implicitfast": "implicitfast",
    "explicit": "explicit",
    "explicit:rk4": "explicit:rk4",
}
"""Methods shown, and the theory of a free tool of each."""

LIMITS = 9
"""Values of K per method at which the limits in mass are searched."""

SEARCHES = ("held still", "worst hand")
"""How the handle is held where a limit in mass is searched."""


def points(count: int) -> Sequence[Point]:
    """Returns a grid of mass and stiffness per method, and searches for the limit in mass."""
    side = max(2, round((count / len(THEORIES)) ** 0.5))
    stiffness = np.geomspace(*STIFFNESS, side)
    cells: list[Point] = [
        {"what": "cell", "method": name, "stiffness": float(k), "mass": float(m)}
        for name in THEORIES
        for k in stiffness
        for m in np.geomspace(*MASS, side)
    ]
    # two to a column of the picture, and away from the grid's own values
    limits: list[Point] = [
        {"what": what, "method": name, "stiffness": float(k), "mass": 0.0}
        for name in THEORIES
        for k in np.geomspace(1.1 * STIFFNESS[0], STIFFNESS[1] / 1.1, min(LIMITS, side))
        for what in SEARCHES
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
    device = SimulatedDevice(hand=hand_worst_for(name, stiffness, mass))
    return _run(device, name, stiffness, mass)


def hand_worst_for(name: str, stiffness: float, mass: float) -> WorstHand:
    """Returns the hand that needs most damping for this method, mass and stiffness."""
    law = THEORIES[name], stiffness, law_damping(name, stiffness), mass, PERIOD
    angle, _ = worst_angle(*law)
    response = complex(felt(*law, angle))
    return WorstHand(DEVICE_DAMPING, angle / PERIOD, PERIOD, response)


def law_damping(name: str, stiffness: float) -> float:
    """Returns B' in N s/m, which a method's law uses where ``DAMPING`` is asked for."""
    return float(used_damping(name, stiffness, DAMPING, PERIOD))


def coupling_of(stiffness: float) -> Coupling:
    """Returns the coupling of every run at a stiffness; nothing turns."""
    return Coupling(stiffness, DAMPING, 0.0, 0.0)


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
        coupling_of(stiffness),
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
        name: One of ``THEORIES``.
        stiffness: K in N/m, > 0.
        is_held: Whether the handle is held still, or held by the worst hand of the device.

    Returns:
        ``limit`` in kg, NaN where there is none; ``stable_if_light`` and ``stable_if_heavy``: at
        the ends of the range.

    Raises:
        StudyError: The stiffness is out of range.
    """
    theory, damping = THEORIES[name], law_damping(name, stiffness)

    def is_stable(mass: float) -> bool:
        needed = worst_angle(theory, stiffness, damping, mass, PERIOD)[1]
        return np.isfinite(needed) if is_held else needed < DEVICE_DAMPING

    return _change(is_stable, WIDTH / 10)


def _change(is_stable: Callable[[float], bool], width: float) -> Mapping[str, float | bool]:
    first, last = (is_stable(mass) for mass in MASS)
    found = {"limit": float("nan"), "stable_if_light": first, "stable_if_heavy": last}
    if first == last:
        return found
    bracket = largest_stable(lambda mass: is_stable(mass) == first, *MASS, width)
    return found | {"limit": bracket.middle}


def of_method(table: Table, what: str, name: str) -> Table:
    """Returns the rows of one kind of point and one method."""
    return table.select((table["what"] == what) & (table["method"] == name))


def is_stable(cells: Table) -> NDArray[np.bool_]:
    """Returns where a tool was stable, held still and in the worst hand."""
    return np.asarray(
        (cells.numbers("stable_held_still") == 1) & (cells.numbers("stable_worst_hand") == 1)
    )
