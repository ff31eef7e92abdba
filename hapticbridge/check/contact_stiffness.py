"""Stiffness of MuJoCo's constraints at rest, and penetration under a force."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hapticbridge.scene.contact_rule import impedance_at

_ROUNDS = 60
"""Number of bisections of the depth's bracket; enough for the last bit."""


def constraint_stiffness(
    solref: Sequence[float],
    solimp: Sequence[float],
    inertia: float,
    timestep: float,
    depth: float = 0.0,
) -> float:
    """Returns the stiffness in N/m that a contact, limit or equality constraint has at rest.

        K_c = m k d²/(1 − d),
        k = min(1/(d_w timeconst dampratio)², 1/(d h²))    or    −solref[0]/d_w²

    m is the inertia at the constraint as MuJoCo computes it, d the impedance at that depth, and d_w
    the impedance beyond the width of ``solimp``. The second term of the minimum is the limit of the
    step h (flag ``refsafe``).

    Args:
        solref: (timeconst in s, dampratio), or (−stiffness in 1/s², −damping in 1/s).
        solimp: d₀, d_w, width in m, midpoint, power.
        inertia: m in kg, > 0; kg m² for a hinge, which gives a result in N m/rad.
        timestep: h in s.
        depth: Penetration in m, >= 0; rad for a hinge.

    Returns:
        K_c in N/m: force divided by depth.

    References:
        MuJoCo's documentation, "Solver parameters"; the tests compare it with runs at rest.
    """
    impedance, last = impedance_at(solimp, depth), impedance_at(solimp, math.inf)
    first, second = float(solref[0]), float(solref[1])
    if first > 0 and second > 0:
        spring = min(1.0 / (last * first * second) ** 2, 1.0 / (impedance * timestep**2))
    else:
        spring = max(-first, 0.0) / last**2
    return inertia * spring * impedance**2 / (1.0 - impedance)


def depth_under(
    force: float,
    solref: Sequence[float],
    solimp: Sequence[float],
    inertia: float,
    timestep: float,
) -> float:
    """Returns the penetration in m under a steady force; infinite for zero stiffness.

    It solves F = K_c(r) r for the depth r; K_c depends on r through ``solimp``. Parameters are
    those of ``constraint_stiffness``; F is in N, or in N m for a hinge.
    """

    def stiffness(depth: float) -> float:
        return constraint_stiffness(solref, solimp, inertia, timestep, depth)

    least = min(stiffness(0.0), stiffness(math.inf))
    if least <= 0.0:
        return math.inf
    low, high = 0.0, force / least
    for _ in range(_ROUNDS):
        middle = 0.5 * (low + high)
        if stiffness(middle) * middle < force:
            low = middle
        else:
            high = middle
    return high
