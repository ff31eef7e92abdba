"""What a delay leaves of *stability*, which is less than passivity."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.passivity.grid import checked, plain, scalar, together


def coupled_stability_limit(
    device_damping: ArrayLike, period: float, *, damping: ArrayLike = 0.0, delay: float = 0.0
) -> float | NDArray[np.float64]:
    """Returns the stiffness up to which device and coupling against a wall stay stable.

        K = (b + B) / (T/2 + t_d),    t_d = delay · T

    A rule for design, not a guarantee: it says nothing of a hand, and it holds for low damping; at
    B = 20 N s/m and a delay of one sample it is 28 % too optimistic. B enters with the sign
    opposite to ``minimum_damping``: a damper helps stability and costs passivity.

    Args:
        device_damping: b in N s/m, finite and >= 0.
        period: T in s, finite and > 0.
        damping: B in N s/m, finite and >= 0.
        delay: Delay from position to force in samples, >= 0; fractions are meant.

    Returns:
        K in N/m, of the shape that the arguments broadcast to.

    Raises:
        CouplingError: An argument is out of range.

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
