"""Stability limit of a delayed coupling."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.passivity.grid import checked, plain, scalar, together


def coupled_stability_limit(
    device_damping: ArrayLike, period: float, *, damping: ArrayLike = 0.0, delay: float = 0.0
) -> float | NDArray[np.float64]:
    """Returns the stiffness in N/m below which device and coupling are stable against a wall.

        K = (b + B) / (T/2 + t_d),    t_d = delay · T

    This is a design rule for *stability*, which is weaker than passivity: it ignores the hand. It
    holds for low damping; at B = 20 N s/m and one sample of delay it is 28 % too optimistic. The
    sign of B is opposite to that in ``minimum_damping``, because a damper helps stability and costs
    passivity.

    b and B in N s/m must be finite and >= 0, T in s > 0, the delay in samples >= 0 (fractions are
    allowed); otherwise CouplingError is raised. Arrays broadcast.

    References:
        Gil et al. 2009.
    """
    period = scalar("period", period, "s", positive=True)
    delay = scalar("delay", delay, "samples")
    available, own = together(
        device_damping=checked("device damping", device_damping, "N s/m"),
        coupling_damping=checked("coupling damping", damping, "N s/m"),
    )
    return plain((available + own) / (period * (0.5 + delay)))
