"""Compiled time-domain run of a sampled loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled

_Array = NDArray[np.float64]

KICK = 1e-3
"""First displacement of the handle in m. The loop is linear, so it only scales the motion."""

HUGE = 1e100
"""Force in N at which a run counts as diverged and ends."""


@compiled
def run(
    stiffness: float,
    c: float,
    a: float,
    inverse_mass: float,
    integrator: int,
    delay: int,
    period: float,
    p: float,
    q: float,
    r: float,
    force: _Array,
    handle: _Array,
    tool: _Array,
) -> int:
    """Fills the arrays with f_k, h_k and x_k and returns the number of samples taken.

    The recursion is that of ``SampledLoop``. Its arguments c and a belong to the damper, p, q and r
    to the hand; ``integrator`` is given as samples of delay. A run that diverges in its last sample
    returns one sample fewer, so that a length below the capacity always means divergence.
    """
    h, x, v, stretch, damper, f = KICK, 0.0, 0.0, 0.0, 0.0, 0.0
    held_before, device_velocity = 0.0, 0.0
    step_compliance = period * period * inverse_mass if integrator == 0 else 0.0
    for k in range(force.size):
        if k > 0:
            x += period * v
        if integrator == 2:
            v += period * inverse_mass * f
        f = (stiffness + c) * (h - x) - c * stretch + a * damper
        f /= 1 + (stiffness + c) * step_compliance
        if integrator != 2:
            v += period * inverse_mass * f
        x += step_compliance * f
        stretch = h - x
        damper = f - stiffness * stretch
        force[k], handle[k], tool[k] = f, h, x
        if not abs(f) < HUGE:
            return k + 1 if k + 1 < force.size else k
        held = -force[k - delay] if k >= delay else 0.0
        device_velocity = p * device_velocity + q * held + r * held_before
        held_before = held
        h += period * device_velocity
    return int(force.size)
