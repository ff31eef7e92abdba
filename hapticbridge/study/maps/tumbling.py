"""What theory says of a tool that tumbles: what is created, and where a spring cannot hold it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

INERTIA = np.array([1.5e-3, 3.63e-3, 4.53e-3])
"""Of the tool about its principal axes x, y, z in kg m²: all different, so that it tumbles,
and near those of a hand tool with a long handle."""

PERIOD = 1e-3
"""T in s."""

TICKS = 1000

OBLIQUE = np.array([0.1, 1.0, 0.1])
"""Axis of the spin: near the middle principal axis, about which a free body is unstable."""

MIDDLE = np.array([0.0, 1.0, 0.0])


def cut_speed(stiffness: float) -> float:
    """Returns the speed ω = π √(K_r/I) in rad/s at which a sudden turn winds the spring to π.

    The tool starts at rest and the handle turns about the middle axis: relative to the handle it
    swings with the amplitude ω √(I/K_r). The damping, also the numerical one, is left out.
    """
    return float(np.pi * np.sqrt(stiffness / INERTIA[1]))


def gyroscopic_speed(stiffness: float) -> float:
    """Returns the speed in rad/s from which on the gyroscopic torque can exceed the spring's.

    The gyroscopic torque |ω × Iω| reaches ½ (I_z − I_x) ω² in the worst attitude, the spring gives
    π K_r at most. A tool passes that attitude quickly: its angle passes π at higher speeds only.
    """
    return float(np.sqrt(2 * np.pi * stiffness / (INERTIA.max() - INERTIA.min())))


def free_creation(speed: float, ticks: int = TICKS) -> float:
    """Returns what the explicit gyroscopic term creates in a free tool, in J.

    With the term at the start of the step, v⁺ = v − T I⁻¹(ω × Iω), the kinetic energy grows by

        ½ T² (ω × Iω)ᵀ I⁻¹ (ω × Iω)

    a step, since ω·(ω × Iω) = 0. Summed over the exact motion (fourth order) from a spin about
    ``OBLIQUE``; beyond a few per cent of the kinetic energy what was created spins faster, and
    creates more than this.

    Args:
        speed: In rad/s.
        ticks: How many.
    """
    omega = speed * OBLIQUE / np.linalg.norm(OBLIQUE)
    total = 0.0
    for _ in range(ticks):
        torque = np.cross(omega, INERTIA * omega)
        total += 0.5 * PERIOD**2 * float(np.sum(torque**2 / INERTIA))
        first = _torque_free(omega)
        second = _torque_free(omega + PERIOD / 2 * first)
        third = _torque_free(omega + PERIOD / 2 * second)
        fourth = _torque_free(omega + PERIOD * third)
        omega = omega + PERIOD / 6 * (first + 2 * second + 2 * third + fourth)
    return total


def _torque_free(omega: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(-np.cross(omega, INERTIA * omega) / INERTIA)
