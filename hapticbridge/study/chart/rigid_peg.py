"""Where a rigid peg without friction comes to rest in its hole, by constrained optimisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.errors import StudyError

HALF_WIDTH, HALF_LENGTH = 0.01, 0.03
"""Of the peg of ``models/peg_in_hole`` in m."""

CLEARANCE, DEPTH = 0.2e-3, 0.04
"""Gap a side with the peg in the middle, and depth of the hole, in m."""

SCALE = 1e3
"""Lengths are given to the optimiser in mm and angles in mrad, so that its steps suit both; it
stops at 1e-16 of the energy, some 1e-10 m."""

_SIGNS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)])


@dataclass(frozen=True, slots=True, eq=False)
class RestingPeg:
    """A peg at rest.

    Attributes:
        position: Of its centre in m, the hole's mouth at z = 0, shape (3,).
        rotation: Rotation vector in rad, shape (3,).
        wrench: On the peg by the coupling, force in N and torque in N m, shape (6,).
        gaps: Distances in m that the contacts leave, all >= 0 but for rounding.
    """

    position: NDArray[np.float64]
    rotation: NDArray[np.float64]
    wrench: NDArray[np.float64]
    gaps: NDArray[np.float64]


def gaps(
    position: NDArray[np.float64], rotation: NDArray[np.float64], clearance: float = CLEARANCE
) -> NDArray[np.float64]:
    """Returns how far a peg is from each wall and the bottom, in m; < 0 where it would be inside.

    What of the peg lies below the mouth is a convex body; its extreme points are the four lower
    corners, and where the long edges pass the plane of the mouth. Valid while exactly those four
    edges pass it: an inserted peg that is not turned by more than some 30 degrees.

    Args:
        position: Of the centre, shape (3,).
        rotation: Rotation vector, shape (3,).
        clearance: Gap a side in m.

    Returns:
        Shape (36,): eight points by four walls, then the corners above the bottom.
    """
    axes = Rotation.from_rotvec(rotation).as_matrix()
    across = HALF_WIDTH * _SIGNS @ axes[:, :2].T
    lower = position + across - HALF_LENGTH * axes[:, 2]
    upper = position + across + HALF_LENGTH * axes[:, 2]
    share = lower[:, 2:] / (lower[:, 2:] - upper[:, 2:])
    points = np.vstack([lower, lower + share * (upper - lower)])[:, :2]
    wall = HALF_WIDTH + clearance
    return np.concatenate([(wall - points).ravel(), (wall + points).ravel(), lower[:, 2] + DEPTH])


def resting_peg(
    coupling: Coupling,
    position: ArrayLike,
    rotation: ArrayLike = (0.0, 0.0, 0.0),
    clearance: float = CLEARANCE,
) -> RestingPeg:
    """Finds the pose that a coupling to a handle that stands still pulls a rigid peg into.

        minimise  ½ K ‖h − p‖² + ½ K_r ‖log(R_h Rᵀ)‖²    subject to  gaps(p, R) >= 0

    Without friction this is where any mechanics that loses energy ends.

    Args:
        coupling: K and K_r, both > 0; the dampings play no part.
        position: h, of the handle in m.
        rotation: Of the handle, a rotation vector in rad.
        clearance: Gap a side in m.

    Raises:
        StudyError: The optimiser found no minimum, or a stiffness is not > 0.
    """
    if not (coupling.stiffness > 0 and coupling.rotational_stiffness > 0):
        raise StudyError("the coupling must hold the peg's place and turning: K > 0 and K_r > 0")
    handle, turn = np.asarray(position, float), np.asarray(rotation, float)
    handle_rotation = Rotation.from_rotvec(turn)

    def wrench(values: NDArray[np.float64]) -> NDArray[np.float64]:
        place, rotated = values[:3] / SCALE, Rotation.from_rotvec(values[3:] / SCALE)
        angle = (handle_rotation * rotated.inv()).as_rotvec()
        return np.concatenate(
            [coupling.stiffness * (handle - place), coupling.rotational_stiffness * angle]
        )

    weights = np.repeat([coupling.stiffness, coupling.rotational_stiffness], 3)

    def energy(values: NDArray[np.float64]) -> float:
        return float(np.sum(wrench(values) ** 2 / weights) / 2 * SCALE**2)

    start = np.zeros(6)
    start[2] = SCALE * max(handle[2], HALF_LENGTH - DEPTH + 1e-3)
    found = minimize(
        energy,
        start,
        method="SLSQP",
        constraints={
            "type": "ineq",
            "fun": lambda v: SCALE * gaps(v[:3] / SCALE, v[3:] / SCALE, clearance),
        },
        options={"ftol": 1e-16, "maxiter": 500},
    )
    left = gaps(found.x[:3] / SCALE, found.x[3:] / SCALE, clearance)
    # mode 8: no further descent to be found at this precision, which is the end as well
    if found.status not in (0, 8) or left.min() < -1e-8:
        raise StudyError(f"no resting pose of the peg was found: {found.message}")
    return RestingPeg(
        position=found.x[:3] / SCALE,
        rotation=found.x[3:] / SCALE,
        wrench=wrench(found.x),
        gaps=left,
    )
