"""How the wrench rises after a start or a re-seating, and what that may cost.

A share r of the wrench is let through, and r grows from tick to tick. The coupling that it finds
stretched grows with it: from the identity behind BC97 (6), with the wrench r_k f_k in the place of
f_k, the device is given

    W = Σ (r_k − r_{k−1}) V(e_k),    V(e) = ∫ min(K e, F) de,    F the force limit,

that nobody put in: pressed in while r is small, let out when it is one. A hand that goes 40 mm into
a wall with F = 10 N within the ramp is so given 0.2 J, and the guard's energy limit rightly ends
the run. So r rises in equal steps only while V is below V_0, and slower where it is above,

    r_k − r_{k−1} = min(1, V_0/V(e_k)) / (n + 1),

which bounds W by V_0 in every n + 1 ticks, whatever the hand does. What the scene itself took up in
the meantime at a small r, and gives back later, is not in V; there the energy limit stands alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import RAMPING
from hapticbridge.pose import norm, quaternion_of, rotation_between, subtract, vector_of


@compiled
def _spring(stiffness: float, length: float, limit: float) -> float:
    elastic = min(length, limit / stiffness) if stiffness > 0.0 else 0.0
    return 0.5 * stiffness * elastic * elastic + min(stiffness * length, limit) * (length - elastic)


@compiled
def held_energy(state: NDArray[np.void]) -> float:
    """Returns what the coupling's springs can give to the device, r V(e) + r V(φ) in J.

    r = force_scale/scale; the force of each spring stops growing where its limit is reached.
    """
    s = state[0]
    ratio = s.force_scale / s.scale
    stretch = norm(subtract(vector_of(s.handle_position), vector_of(s.tool_position)))
    tool, handle = quaternion_of(s.tool_quaternion), quaternion_of(s.handle_quaternion)
    twist = norm(rotation_between(tool, handle))
    held = _spring(s.stiffness, stretch, s.force_limit / s.force_scale)
    return float(ratio * (held + _spring(s.rotational_stiffness, twist, s.torque_limit / ratio)))


@compiled
def rise(state: NDArray[np.void]) -> float:
    """Goes one tick further in the ramp, and returns the share of the wrench that is let through.

    ``risen`` counts ticks, those in which the coupling holds more than ``ramp_energy`` in part.
    """
    s = state[0]
    full = s.rise_ticks + 1.0
    if s.risen >= full:
        return 1.0
    pace = 1.0
    if s.has_law and s.ramp_energy < np.inf:
        held = held_energy(state)
        if held > s.ramp_energy:
            pace = s.ramp_energy / held
    s.risen += pace
    if s.risen >= full:
        return 1.0
    s.flags |= RAMPING
    return float(s.risen / full)
