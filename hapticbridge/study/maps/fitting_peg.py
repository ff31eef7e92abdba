"""A rig: a peg that fills its hole, of any length, behind the hand that is worst in rotation."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.guard import UNLIMITED
from hapticbridge.rendering import METHODS
from hapticbridge.study.closed_loop import LoopOutcome
from hapticbridge.study.maps.rigs import loop_in
from hapticbridge.theory.sampled_loop import WorstHand

PERIOD = 1e-3
"""T in s."""

DEVICE_DAMPING = 2e-3
"""b_θ in N m s/rad, that of the default simulated device."""

ROTATIONAL_DAMPING = 5e-4
"""B_r of the coupling in N m s/rad: b_θ/4, what the bridge itself would choose."""

COUPLING_STIFFNESS = 2000.0
"""K of the coupling in N/m, well below its own limit 2b/T: translation must not be what fails."""

GROWTH = 1.001
"""Share of the knock's torque beyond which it has grown, without unit: above the rounding of depths
of less than a micrometre."""

TICKS = 500
"""A run. One per cent beyond the limit the knock has grown a thousandfold by then, and more."""

KNOCK = np.array([0.0, 0.0, 0.0, 0.0, 1e-4, 0.0])
"""Turn that starts a run, in rad: at every length less deep than the walls are thick."""


def length_limit(contact_stiffness: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Returns the longest L in m that ``direct`` bears: 2 √(b_θ/(T K_c)), K_c in N/m."""
    return np.asarray(2 * np.sqrt(DEVICE_DAMPING / (PERIOD * np.asarray(contact_stiffness))))


def contact_stiffness_limit(length: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Returns the largest K_c in N/m that ``direct`` bears: 4 b_θ/(T L²), L in m."""
    return np.asarray(4 * DEVICE_DAMPING / (PERIOD * np.asarray(length) ** 2))


def device_and_coupling(name: str, stiffness: float) -> tuple[SimulatedDevice, Coupling]:
    """Returns the rotational damper behind which a peg is run, and its coupling.

    At Nyquist, where a spring is worst, that damper is device and worst hand in one. The damper of
    the translation is four times what two contacts could need: translation is not what fails.

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
        length: L in m: of the peg, and so between contacts on opposite walls.
        stiffness: K_c in N/m per wall, or K_r in N m/rad.

    Returns:
        The outcome, with its records.
    """
    loop = loop_in("planar_peg", "geometry")
    set_length(loop.scene.model, length)
    mujoco.mj_setConst(loop.scene.model, loop.scene.data)
    device, coupling = device_and_coupling(name, stiffness)
    return loop.run(
        device,
        coupling,
        METHODS[name],
        period=PERIOD,
        ticks=TICKS,
        knock=KNOCK,
        keep_records=True,
    )


def set_length(model: mujoco.MjModel, length: float) -> None:
    """Makes the peg of ``planar_peg`` as long as asked, midway in a hole that it just fills.

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
        model.geom_size[wall, 2] = length  # twice the peg's, so that its ends meet no edge
        model.geom_pos[wall] = [side * (model.geom_size[peg, 0] + model.geom_size[wall, 0]), 0, 0]
    bottom = model.geom("hole_bottom").id
    model.geom_pos[bottom, 2] = -2 * length - model.geom_size[bottom, 2]
    for geom in (peg, *walls, bottom):
        model.geom_rbound[geom] = np.linalg.norm(model.geom_size[geom])
        model.geom_aabb[geom, 3:] = model.geom_size[geom]


def is_stable(name: str, length: float, stiffness: float) -> bool:
    """Returns whether what a knock in rotation leaves falls, and was never its double."""
    return has_calmed(run(name, length, stiffness), name, length, stiffness)


def has_calmed(outcome: LoopOutcome, name: str, length: float, stiffness: float) -> bool:
    """Returns whether a run's torque falls, and was never the double of what the knock left.

    What is thrown out of the hole is calm too, but had grown before.
    """
    largest = torque(outcome).max(initial=0.0)
    return outcome.is_stable and bool(largest < 2 * knocked(name, length, stiffness))


def first_growth(outcome: LoopOutcome, name: str, length: float, stiffness: float) -> int:
    """Returns the first tick at which the device feels more than the knock left, −1 for none."""
    grown = np.flatnonzero(torque(outcome) > GROWTH * knocked(name, length, stiffness))
    return int(grown[0]) if grown.size else -1


def torque(outcome: LoopOutcome) -> NDArray[np.float64]:
    """Returns the size of the torque about the hinge at each tick in N m."""
    return np.asarray(np.abs(outcome.records["wrench_on_tool"][:, 4]))


def knocked(name: str, length: float, stiffness: float) -> float:
    """Returns the torque in N m that the knock leaves before the loop answers."""
    twist = float(KNOCK[4])
    if name == "direct":
        return 0.5 * stiffness * length**2 * twist
    return (stiffness + ROTATIONAL_DAMPING / PERIOD) * twist
