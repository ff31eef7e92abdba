"""Forces at the Falcon's grip and torques at its thighs, by virtual work."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.falcon.kinematics import FLATTEST, THIGH, closure, solve
from hapticbridge.jit import compiled


@compiled
def jacobian(
    position: NDArray[np.float64], angles: NDArray[np.float64], matrix: NDArray[np.float64]
) -> bool:
    """Writes ∂θ/∂p = −(∂h/∂θ)⁻¹ ∂h/∂p at a pose where the legs close.

    Args:
        position: Shape (3,), in m.
        angles: Shape (3,), in rad, those of the position.
        matrix: Shape (3, 3), in rad/m, filled in place.

    Returns:
        Whether there is one: no leg is stretched or folded.
    """
    gaps, gradients, levers = np.empty(3), np.empty((3, 3)), np.empty(3)
    if not closure(position, angles, gaps, gradients, levers):
        return False
    for i in range(3):
        if not abs(levers[i]) >= FLATTEST * THIGH:
            return False
    for i in range(3):
        for j in range(3):
            matrix[i, j] = -gradients[i, j] / levers[i]
    return True


@compiled
def thigh_torques(
    position: NDArray[np.float64],
    angles: NDArray[np.float64],
    force: NDArray[np.float64],
    torques: NDArray[np.float64],
) -> bool:
    """Writes the thigh torques that push the grip with a force: τ = J⁻ᵀ F, J = ∂θ/∂p.

    By virtual work τ·δθ = F·δp for every motion.

    Args:
        position: Shape (3,), in m.
        angles: Shape (3,), in rad, those of the position.
        force: Shape (3,), in N, in the maker's frame.
        torques: Shape (3,), in N m, filled in place; zero where there is no answer.

    Returns:
        Whether there is an answer.
    """
    torques[:] = 0.0
    gaps, gradients, levers = np.empty(3), np.empty((3, 3)), np.empty(3)
    if not closure(position, angles, gaps, gradients, levers):
        return False
    answer = np.empty(3)
    if not abs(solve(gradients.T.copy(), force, answer)) >= FLATTEST:
        return False
    for i in range(3):
        torques[i] = -levers[i] * answer[i]
    return True
