"""Motion in closed form, for every test that follows a mass behind a coupling."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling


def swing_from_rest(
    times: NDArray[np.floating[Any]],
    coupling: Coupling,
    mass: float,
    joint: tuple[float, float] = (0.0, 0.0),
) -> NDArray[np.float64]:
    """Returns a mass's path on a joint's spring and damper, behind a handle sin(4π t)."""
    omega, (stiffness, damping) = 4 * np.pi, joint
    k, b = coupling.stiffness + stiffness, coupling.damping + damping
    pull = coupling.stiffness + 1j * omega * coupling.damping
    steady = pull / (k - mass * omega**2 + 1j * omega * b)
    roots = np.roots([mass, b, k])
    at_start = [-steady.imag, -(1j * omega * steady).imag]
    own = np.linalg.solve(np.vstack([np.ones(2), roots]), at_start)
    swing = (steady * np.exp(1j * omega * times)).imag
    return np.asarray(swing + (np.exp(np.outer(times, roots)) @ own).real)
