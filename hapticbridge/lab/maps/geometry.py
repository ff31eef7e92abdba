"""Map ``geometry``: longest stable peg, rendered directly and through the coupling.

The peg touches both walls of its hole throughout, so ``lossless`` is in its implicit form. The
methods behind the coupling then differ only in the B' that their law uses, with (6) in B'.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import UNLIMITED
from hapticbridge.device import Motion, SimulatedDevice
from hapticbridge.lab.closed_loop import LoopOutcome
from hapticbridge.lab.maps import base
from hapticbridge.lab.maps.base import PERIOD, Point, Sentences
from hapticbridge.lab.maps.twins import NO_LIMITS, UNGUARDED_OPTIONS, Run, Twins
from hapticbridge.lab.methods import METHODS
from hapticbridge.plotting import new_figure
from hapticbridge.scene import Scene
from hapticbridge.sweep import Table
from hapticbridge.theory.sampled_loop import WorstHand

DEVICE_DAMPING = 2e-3
"""Rotational damping b_θ in N m s/rad, that of the default simulated device."""

ROTATIONAL_DAMPING = 5e-4
"""Damping B_r of the coupling in N m s/rad: b_θ/4, the bridge's own choice."""

COUPLING_STIFFNESS = 2000.0
"""Stiffness K of the coupling in N/m. It is well below its own limit 2b/T, so that translation does
not fail."""

GROWTH = 1.001
"""Multiple of the knock's torque above which it counts as grown, without unit. It is above the
rounding of depths of less than a micrometre."""

TICKS = 500
"""Ticks of a run. One per cent beyond the limit the knock has grown more than a thousandfold by
then."""

KNOCK = np.array([0.0, 0.0, 0.0, 0.0, 1e-4, 0.0])
"""Turn that starts a run, in rad. At every length its depth is below the thickness of the walls."""


def length_limit(contact_stiffness: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Returns the largest L in m at which ``direct`` is stable: 2 √(b_θ/(T K_c)), K_c in N/m."""
    return np.asarray(2 * np.sqrt(DEVICE_DAMPING / (PERIOD * np.asarray(contact_stiffness))))


def contact_stiffness_limit(length: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Returns the largest K_c in N/m at which ``direct`` is stable: 4 b_θ/(T L²), L in m."""
    return np.asarray(4 * DEVICE_DAMPING / (PERIOD * np.asarray(length) ** 2))


def device_and_coupling(name: str, stiffness: float) -> tuple[SimulatedDevice, Coupling]:
    """Returns the rotational damper behind which a peg is run, and its coupling.

    At Nyquist, where a spring is worst, that damper is device and worst hand in one. The damper of
    the translation is four times the need of two contacts, so that translation does not fail.

    Args:
        name: ``direct``, or a method with a coupling.
        stiffness: K_c in N/m per wall, or K_r in N m/rad.
    """
    if name == "direct":
        # box against box makes two contacts on a wall, one at each end of the 20 mm of its width
        coupling = Coupling(stiffness / 2, 0.0, 0.0, 0.0)
        damping = 4 * stiffness * PERIOD
    else:
        coupling = Coupling(COUPLING_STIFFNESS, 0.0, stiffness, ROTATIONAL_DAMPING)
        damping = 4 * COUPLING_STIFFNESS * PERIOD
    nyquist = np.pi / PERIOD
    device = SimulatedDevice(
        damping=damping,
        rotational_damping=DEVICE_DAMPING,
        hand=WorstHand(damping, nyquist, PERIOD),
        rotational_hand=WorstHand(DEVICE_DAMPING, nyquist, PERIOD),
        force_limit=UNLIMITED.force,
        torque_limit=UNLIMITED.torque,
    )
    return device, coupling


def run(name: str, length: float, stiffness: float) -> LoopOutcome:
    """Runs a peg that fills its hole, handle midway, behind the rotational damper alone.

    Args:
        name: ``direct``, or a method with a coupling.
        length: L in m, length of the peg, and so the distance between contacts on opposite walls.
        stiffness: K_c in N/m per wall, or K_r in N m/rad.

    Returns:
        The outcome, with its records.
    """
    loop = base.loop_in("planar_peg", "geometry")
    set_length(loop.scene.model, length)
    mujoco.mj_setConst(loop.scene.model, loop.scene.data)
    device, coupling = device_and_coupling(name, stiffness)
    return loop.run(
        device, coupling, METHODS[name], period=PERIOD, ticks=TICKS, knock=KNOCK, keep_records=True
    )


def set_length(model: mujoco.MjModel, length: float) -> None:
    """Sets the length of the peg of ``planar_peg``, midway in a hole that it just fills.

    Mass and inertia stay, so that nothing but the geometry changes with L.

    Args:
        model: Changed in place; ``mj_setConst`` must follow.
        length: L in m.
    """
    peg = model.geom("peg").id
    model.geom_size[peg, 2] = length / 2
    model.body_pos[model.body("peg").id] = 0.0
    walls = [model.geom("hole_east").id, model.geom("hole_west").id]
    for side, wall in zip((1.0, -1.0), walls, strict=True):
        model.geom_size[wall, 2] = length  # twice the peg's length, so that its ends meet no edge
        model.geom_pos[wall] = [side * (model.geom_size[peg, 0] + model.geom_size[wall, 0]), 0, 0]
    bottom = model.geom("hole_bottom").id
    model.geom_pos[bottom, 2] = -2 * length - model.geom_size[bottom, 2]
    for geom in (peg, *walls, bottom):
        model.geom_rbound[geom] = np.linalg.norm(model.geom_size[geom])
        model.geom_aabb[geom, 3:] = model.geom_size[geom]


def is_stable(name: str, length: float, stiffness: float) -> bool:
    """Returns True if the response to a knock in rotation falls and never reached its double."""
    return has_calmed(run(name, length, stiffness), name, length, stiffness)


def has_calmed(outcome: LoopOutcome, name: str, length: float, stiffness: float) -> bool:
    """Returns True if a run's torque falls and never reached double its value after the knock.

    A peg that was thrown out of the hole is calm too, but its torque had grown before.
    """
    largest = torque(outcome).max(initial=0.0)
    return outcome.is_stable and bool(largest < 2 * knocked(name, length, stiffness))


def first_growth(outcome: LoopOutcome, name: str, length: float, stiffness: float) -> int:
    """Returns the first tick at which the device torque exceeds that of the knock, −1 for none."""
    grown = np.flatnonzero(torque(outcome) > GROWTH * knocked(name, length, stiffness))
    return int(grown[0]) if grown.size else -1


def torque(outcome: LoopOutcome) -> NDArray[np.float64]:
    """Returns the size of the torque about the hinge at each tick in N m."""
    return np.asarray(np.abs(outcome.records["wrench_on_tool"][:, 4]))


def knocked(name: str, length: float, stiffness: float) -> float:
    """Returns the torque in N m that the knock causes before the loop responds."""
    twist = float(KNOCK[4])
    if name == "direct":
        return 0.5 * stiffness * length**2 * twist
    return (stiffness + ROTATIONAL_DAMPING / PERIOD) * twist


LENGTH = (5e-3, 0.5)
"""Range of L in m, even in its logarithm."""

CONTACT_STIFFNESS = (10.0, 1e6)
"""Range of K_c in N/m, even in its logarithm. It contains the limit at both ends of ``LENGTH``."""

ROTATIONAL_STIFFNESS = (0.1, 10.0)
"""Range of K_r in N m/rad, even in its logarithm, about the bounds of 3 and 4 N m/rad."""

LIMITS_AMONG = 60
"""Number of cells per search for a limit; a search takes about a dozen runs."""

BEHIND = ("implicit", "compensated", "lossless")
"""Methods with a coupling, all with an equal requested B_r."""

METHODS_SHOWN = ("direct", *BEHIND)

BOUNDS = {name: float(base.limit_by_6(name, DEVICE_DAMPING, ROTATIONAL_DAMPING)) for name in BEHIND}
"""Largest K_r in N m/rad by (6): 2 (b_θ − B_r)/T for ``implicit``; 2 b_θ/T for the others, whose B'
is 0 there."""


DEFAULT_POINTS = 3600
"""Approximate number of points by default."""


def points(count: int) -> Sequence[Point]:
    """Returns a grid of length and stiffness for each method, about ``count`` in all, and limits.

    ``stiffness`` is K_c in N/m for ``direct`` and K_r in N m/rad behind the coupling. The limits
    are searched over L at given K_c for ``direct``, and over K_r at given L behind the coupling.
    """
    side = max(2, round((count / len(METHODS_SHOWN)) ** 0.5))
    lengths = np.geomspace(*LENGTH, side)
    ranges = {"direct": CONTACT_STIFFNESS} | dict.fromkeys(BEHIND, ROTATIONAL_STIFFNESS)
    cells: list[Point] = [
        {"what": "cell", "method": name, "length": float(length), "stiffness": float(stiffness)}
        for name in METHODS_SHOWN
        for length in lengths
        for stiffness in np.geomspace(*ranges[name], side)
    ]
    many = max(3, count // (len(METHODS_SHOWN) * LIMITS_AMONG))
    searched = np.geomspace(*LENGTH, many)
    direct: list[Point] = [
        {"what": "limit", "method": "direct", "length": 0.0, "stiffness": float(stiffness)}
        for stiffness in contact_stiffness_limit(searched[::-1])
    ]
    behind: list[Point] = [
        {"what": "limit", "method": name, "length": float(length), "stiffness": 0.0}
        for name in BEHIND
        for length in searched
    ]
    return cells + direct + behind


def evaluate(point: Point) -> Mapping[str, float | int | str | bool]:
    """Runs one peg behind its worst hand, or searches for the limit that the point leaves open."""
    name, length, stiffness = (
        str(point["method"]),
        float(point["length"]),
        float(point["stiffness"]),
    )
    if point["what"] == "limit":
        if name == "direct":
            bracket = base.largest_stable(
                lambda value: is_stable(name, value, stiffness), LENGTH[0] / 4, 4 * LENGTH[1]
            )
        else:
            lower, upper = ROTATIONAL_STIFFNESS
            bracket = base.largest_stable(
                lambda value: is_stable(name, length, value), lower / 4, 4 * upper
            )
        return {"limit": bracket.middle}
    outcome = run(name, length, stiffness)
    return {
        "stable": has_calmed(outcome, name, length, stiffness),
        "environment": outcome.environment,
        "created": outcome.created,
        "first_active": outcome.first_active,
        "first_growth": first_growth(outcome, name, length, stiffness),
    }


def draw(table: Table, _boundary: Mapping[str, Any]) -> Figure:
    """Draws contact stiffness over length, and that of the coupling, with the limits on top."""
    figure = new_figure(8, 7.6)
    panels = figure.subplots(2, 2, sharex=True).ravel()
    for axes, name in zip(panels, METHODS_SHOWN, strict=True):
        _draw_cells(axes, table, name)
        selected = base.of_method(table, "limit", name)
        if name == "direct":
            lengths = np.geomspace(*LENGTH, 100)
            axes.plot(1e3 * lengths, contact_stiffness_limit(lengths), color="black", lw=1.8)
            x, y = selected.numbers("limit"), selected["stiffness"]
            axes.set_title("direct: no coupling", fontsize="medium")
            axes.set(ylabel="contact stiffness K_c (N/m)", ylim=CONTACT_STIFFNESS)
        else:
            axes.axhline(BOUNDS[name], color=base.THEORY_COLOUR, lw=1.8, ls="--")
            x, y = selected["length"], selected.numbers("limit")
            axes.set_title(f"{name}, {base.law_in_words(name, '_r')}", fontsize="medium")
            axes.set(ylabel="coupling stiffness K_r (N m/rad)", ylim=ROTATIONAL_STIFFNESS)
        axes.plot(1e3 * x, y, "o", color="black", ms=4, mfc="white")
        axes.set_xlim(1e3 * LENGTH[0], 1e3 * LENGTH[1])
    for axes in panels[2:]:
        axes.set_xlabel("length of the peg L (mm)")
    figure.suptitle(
        f"A peg that fills its hole, handle midway, b_θ = {1e3 * DEVICE_DAMPING:g} mN m s/rad "
        f"at {1 / PERIOD:g} Hz, worst hand in rotation;\nbehind the coupling B_r = "
        f"{1e3 * ROTATIONAL_DAMPING:g} mN m s/rad is requested, and the law uses B_r′ (0 at least)",
        fontsize="medium",
    )
    base.verdict_legend(
        figure,
        [
            ("L = 2 √(b_θ/(T K_c))", "black", "-"),
            ("(6): b_θ = K_r T/2 + B_r′", base.THEORY_COLOUR, "--"),
            ("measured limit", "black", "o"),
        ],
    )
    return figure


def _draw_cells(axes: Axes, table: Table, name: str) -> None:
    cells = base.of_method(table, "cell", name)
    verdict = base.verdict_numbers(cells.numbers("stable") == 1, cells.texts("environment"))
    length = 1e3 * cells["length"]
    base.draw_verdicts(axes, length, cells["stiffness"], verdict, log_x=True, log_y=True)


def summarize(table: Table) -> dict[str, Any]:
    """Compares the limits in length and in stiffness with theory."""
    return {
        "period": PERIOD,
        "device_rotational_damping": DEVICE_DAMPING,
        "direct": _of_direct(base.of_method(table, "limit", "direct")),
        **{name: _behind(name, base.of_method(table, "limit", name)) for name in BEHIND},
    }


def _of_direct(limits: Table) -> dict[str, Any]:
    """Compares the longest pegs that were found, each at its K_c, with the printed limit."""
    predicted, measured = length_limit(limits["stiffness"]), limits.numbers("limit")
    return {
        "contact_stiffness": limits["stiffness"].tolist(),
        "measured_length": measured.tolist(),
        "predicted_length": predicted.tolist(),
        "largest_deviation": base.agreement(measured, predicted),
    }


def _behind(name: str, limits: Table) -> dict[str, Any]:
    """Compares the largest K_r that were found, each at its length, with (6) and each other."""
    measured = limits.numbers("limit")
    # 0 and infinity: all or nothing in the search range is stable, which is no limit
    known = measured[np.isfinite(measured) & (measured > 0)]
    return {
        "coupling_rotational_damping": ROTATIONAL_DAMPING,
        "length": limits["length"].tolist(),
        "measured_rotational_stiffness": measured.tolist(),
        "predicted_6": BOUNDS[name],
        "largest_deviation": base.agreement(measured, BOUNDS[name]),
        "smallest": float(known.min()) if known.size else None,
        "largest": float(known.max()) if known.size else None,
        "largest_over_smallest": float(known.max() / known.min()) if known.size else None,
    }


def sentences(boundary: Mapping[str, Any]) -> Sentences:
    """States the agreement with theory, rendered directly and behind each coupling."""
    yield (
        "Rendered directly, the longest stable peg is within {largest_deviation:.2%} of "
        "L = 2 √(b_θ/(T K_c))",
        boundary["direct"],
    )
    for name in BEHIND:
        yield (
            "Behind '{name}' the largest K_r lies between {smallest:.4g} and {largest:.4g} N m/rad "
            "over all lengths; eq. (6), which has no length in it, says {predicted_6:.4g}",
            boundary[name] | {"name": name},
        )


TWIN_STIFFNESS = 1e4
"""Contact stiffness K_c of the twins in N/m per wall; the longest stable peg is 28 mm."""

TWIN_LENGTHS = (0.05, 0.02)
"""Lengths L of the twins' pegs in m."""

TWIN_TORQUE = 1e-3
"""Torque in N m with which the twins' hand turns the peg against its walls."""


def fitting_peg(length: float) -> Scene:
    """Loads a peg of length L in m that fills its hole, as ``set_length`` makes it.

    Mass and inertia are the same for any length.
    """
    return base.scene_of(f"""
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 0" cone="elliptic"><flag diagexact="enable"/></option>
  <worldbody>
    <geom type="box" size="0.01 0.01 {length!r}" pos="0.02 0 0"/>
    <geom type="box" size="0.01 0.01 {length!r}" pos="-0.02 0 0"/>
    <body name="peg">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1"/>
      <joint type="hinge" axis="0 1 0"/>
      <inertial pos="0 0 0" mass="0.1" diaginertia="3e-5 3e-5 1e-5"/>
      <geom type="box" size="0.01 0.01 {length / 2!r}"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>""")


def twins() -> Twins:
    """Returns a hand that turns a peg in its hole, rendered directly, with two lengths."""
    turn = np.array([[1.0, 0.0, 0.0, 0.0], [np.cos(0.5), 0.0, np.sin(0.5), 0.0]])
    device = partial(
        SimulatedDevice,
        damping=4 * TWIN_STIFFNESS * PERIOD,
        rotational_damping=DEVICE_DAMPING,
        hand=replace(base.STEADY_HAND, stiffness=0.0, rotational_stiffness=TWIN_TORQUE),
        path=Motion([0.0, PERIOD], np.zeros((2, 3)), turn),  # by 1 rad
        **NO_LIMITS,
    )
    return Twins(
        shared=f"A hand turns a peg that fills its hole, method 'direct', "
        f"K_c = {1e-3 * TWIN_STIFFNESS:g} kN/m, device damping "
        f"{1e3 * DEVICE_DAMPING:g} mN m s/rad",
        name="length of peg and hole",
        unit="mm",
        factor=1e3,
        values=TWIN_LENGTHS,
        run=lambda length: Run(
            scene=partial(fitting_peg, length),
            device=device,
            # two contacts on a wall, one at each end of the width
            coupling=Coupling(TWIN_STIFFNESS / 2, 0.0, 0.0, 0.0),
            options=replace(UNGUARDED_OPTIONS, method="direct", rate=1 / PERIOD),
            duration=0.3,
        ),
    )
