"""Energy that a force sent late may have given to the hand, tick by tick.

The condition b >= N, N = K T/2 + B', assumes one tick every T, and a force that acts from the
moment of its sample. A tick comes τ after the one before, and its force is sent t_d after its
sample: until then the old force acts on. With f on the tool, d the device's motion between two
samples and η its part before the new force was sent, the hand gets

    (f_{k−1} − f_{k−2})·η_k

beyond the account of a hold. The tool gets f at once, so the delay is on the device's side alone.
For any motion within the tick, any hand and any strict environment, the damping needed then is

    b_k = N τ_k/T + 3 κ t_d/T,    κ = (K T/2)²/N

With B' = 0 this is K (τ/2 + 3 t_d/2): K t_d as for a wall, and half as much again for a tool that
moves and a hand that moves just while the old force acts. It is exact there. With B' > 0 it is an
upper bound, found by comparison with the largest value of a quadratic form at all frequencies
(``tests/test_timekeeping.py``). With β = t_d/T the form is, for δe = d − δx,

    −Re f_{−1}*d + Re (f_{−1} − f_{−2})*η + Re f*δx − (b/T) (|d|² + |η − β d|²/(β (1 − β)))

Its last term is what b burns at least, if η is not the even share β d. It must never be positive.

The first term of b_k beyond N is paid by ``law.charge_lateness``: after a late sample the handle
slips. A debt that the springs cannot cover is carried on. The hand is assumed to have it, but no
more than the net energy that it received: the work of the wrenches less what b burned. The second
term is not paid, so it is summed here, for translation and rotation each, as

    A_k = max(0, A_{k−1} + 3 κ (t_d/T) D_k²/τ_k − (b − N τ_k/T) d_k²/τ_k)

d is the handle's motion with the device, D the larger one of this sample and the last.

A sample may come in one of m ticks only. The forces of two samples then differ by the deflections
of m ticks, and the form holds with them all. It asks for m κ in place of κ, and for b >= m N_m,
N_m = N + (m − 1) (K T)²/(4 N), as ``theory.bounds.late_minimum_damping`` has it; τ is the time
between two samples. Both are exact for B' = 0. N has here
what a torque across the motion costs (``law.twist_price``), but not in κ. Each joule
that b burns is counted once: first against the cost of late samples, whose sum is ``lent``, then
against A.
"""

from __future__ import annotations

import numpy as np

from hapticbridge.kernel.codes import State
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.law import lateness

TIMING_DTYPE = np.dtype(
    [
        ("delay", "<f8"),  # t_d of the last tick in s
        ("delays", "<f8"),  # sum of all t_d in s
        ("lateness", "<f8"),  # of the last sample after its deadline, in s
        ("jitter", "<f8"),  # sum of all rises of the lateness in s
        ("lent", "<f8", 2),  # energies in J in the scene, of translation and rotation
        ("uncovered", "<f8", 2),  # A
        ("last_square", "<f8", 2),  # d² of the last sample in m² and rad²
        ("max_uncovered", "<f8"),  # largest sum of A and of what is owed so far, in J at the hand
    ]
)
"""Sub-record ``timing``, written by this module alone."""

DELAY_PRICE = 3.0
"""Damping in κ that a delay of a whole period needs."""


@compiled
def note_delay(s: State, deadline_ns: int, read_ns: int, write_ns: int) -> None:
    """Notes the times from the tick's deadline to its sample, and from its sample to its force."""
    t, late = s.timing, 1e-9 * (read_ns - deadline_ns)
    t.delay = 1e-9 * (write_ns - read_ns)
    t.delays += t.delay
    t.jitter += max(late - t.lateness, 0.0)
    t.lateness = late


@compiled
def meter_delay(s: State, interval: float, ticks: int) -> None:
    """Adds the energy that the last tick's delay may have given, in a tick with a new sample.

    Args:
        s: The bound state, with the handle's new step.
        interval: τ, time since the last sample that was new, in s.
        ticks: m, ticks in this time.
    """
    t = s.timing
    if s.guard.consecutive_stale > 0:
        return
    for kind in range(2):
        stiffness, needed, late, square = lateness(s, kind, interval, ticks)
        paying = min(t.lent[kind] + late, 0.0)
        t.lent[kind] = max(t.lent[kind] + late, 0.0)
        cost = 0.0
        if stiffness > 0.0:
            half = 0.5 * stiffness
            cost = ticks * DELAY_PRICE * half * half / needed * t.delay / interval
        cost *= max(square, t.last_square[kind])
        t.uncovered[kind] = max(t.uncovered[kind] + cost + paying, 0.0)
        t.last_square[kind] = square


@compiled
def meter_debt(s: State) -> None:
    """Notes the most that delays may have given, once the springs have paid for a late sample."""
    t, owed, ratio = s.timing, s.coupling.owed, s.run.force_scale / s.run.scale
    carried = min(ratio * (owed[0] + owed[1]), max(s.observer.net_device_energy, 0.0))
    t.max_uncovered = max(t.max_uncovered, ratio * (t.uncovered[0] + t.uncovered[1]) + carried)


@compiled
def skip_delay(s: State) -> None:
    """Begins anew with the first tick after a start: the device's motion took an unknown time."""
    s.timing.last_square[0] = s.timing.last_square[1] = 0.0
