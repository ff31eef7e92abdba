"""Motion in closed form, for every test that follows a mass behind a coupling."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.theory.rigid_body import exact_mass_response


def swing_from_rest(
    times: NDArray[np.floating[Any]], coupling: Coupling, mass: float, frequency: float = 2.0
) -> NDArray[np.float64]:
    """Returns a mass's path behind a handle that begins to swing as sin(2π f t)."""
    omega = 2 * np.pi * frequency
    steady = complex(exact_mass_response(coupling, mass, frequency))
    roots = np.roots([mass, coupling.damping, coupling.stiffness])
    at_start = [-steady.imag, -(1j * omega * steady).imag]
    own = np.linalg.solve(np.vstack([np.ones(2), roots]), at_start)
    swing = (steady * np.exp(1j * omega * times)).imag
    return np.asarray(swing + (np.exp(np.outer(times, roots)) @ own).real)


def sprung_swing(
    times: NDArray[np.floating[Any]], coupling: Coupling, joint: tuple[float, float]
) -> NDArray[np.float64]:
    """Returns the path of 1 kg on a joint's spring and damper, behind a handle sin(4π t)."""
    omega, (stiffness, damping) = 4 * np.pi, joint
    k, b = coupling.stiffness + stiffness, coupling.damping + damping
    steady = (coupling.stiffness + 1j * omega * coupling.damping) / (k - omega**2 + 1j * omega * b)
    roots = np.roots([1.0, b, k])
    at_start = [-steady.imag, -(1j * omega * steady).imag]
    own = np.linalg.solve(np.vstack([np.ones(2), roots]), at_start)
    swing = (steady * np.exp(1j * omega * times)).imag
    return np.asarray(swing + (np.exp(np.outer(times, roots)) @ own).real)
