"""Statics of the Falcon's legs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.falcon.kinematics import FLATTEST, THIGH, closure, solve
from hapticbridge.jit import compiled


@compiled
def jacobian(
    position: NDArray[np.float64], angles: NDArray[np.float64], matrix: NDArray[np.float64]
) -> bool:
    """Computes ∂θ/∂p = −(∂h/∂θ)⁻¹ ∂h/∂p at a pose where the legs close.

    Args:
        position: Shape (3,), in m.
        angles: Shape (3,), in rad, those of the position.
        matrix: Output, shape (3, 3), in rad/m.

    Returns:
        False if a leg is stretched or folded.
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
    """Computes the thigh torques of a force at the grip: τ = J⁻ᵀ F, J = ∂θ/∂p.

    By virtual work τ·δθ = F·δp for every motion.

    Args:
        position: Shape (3,), in m.
        angles: Shape (3,), in rad, those of the position.
        force: Shape (3,), in N, in the maker's frame.
        torques: Output, shape (3,), in N m; zero without a solution.

    Returns:
        Whether a solution exists.
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
