"""What a constraint of MuJoCo amounts to in N/m, and how deep a force sinks into it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hapticbridge.scene.contact_rule import impedance_at

_ROUNDS = 60
"""Halvings of the depth's bracket: to the last bit."""


def constraint_stiffness(
    solref: Sequence[float],
    solimp: Sequence[float],
    inertia: float,
    timestep: float,
    depth: float = 0.0,
) -> float:
    """Returns the stiffness that a contact, limit or equality constraint amounts to at rest.

        K_c = m k d²/(1 − d),
        k = min(1/(d_w timeconst dampratio)², 1/(d h²))    or    −solref[0]/d_w²

    with the inertia m that MuJoCo sees there, the impedance d at that depth, and d_w from the width
    of ``solimp`` on. The second term of the minimum is what the step h resolves (flag ``refsafe``).

    Args:
        solref: (timeconst in s, dampratio), or (−stiffness in 1/s², −damping in 1/s).
        solimp: d₀, d_w, width in m, midpoint, power.
        inertia: m in kg, > 0; of a hinge in kg m², and the result is in N m/rad.
        timestep: h in s.
        depth: In m, >= 0 (of a hinge in rad).

    Returns:
        K_c in N/m, the force over the depth.

    References:
        MuJoCo's documentation, "Solver parameters"; compared with runs at rest in the tests.
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
    """Returns how deep a steady force sinks in, in m; infinite where nothing pushes back.

    It solves F = K_c(r) r for the depth r; K_c grows or falls with depth as ``solimp`` says.

    Args:
        force: F in N, >= 0 (of a hinge in N m).
        solref: As ``constraint_stiffness`` takes it, as are the rest.
        solimp: Likewise.
        inertia: In kg.
        timestep: h in s.
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
