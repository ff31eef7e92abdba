"""The lossless coupling: half of the wrench solved implicitly, half carried over.

With K/2 and B'/2 in MuJoCo's implicit step and the other half of the last wrench applied, a tool
away from contact keeps the midpoint rule's energy balance to rounding, and is second order.
MuJoCo's velocity u is then half a wrench late; the velocity whose energy is balanced is

    v_k = u_k + (T/2) M⁻¹ [2 J_kᵀ r_k − c(q_k, u_k) + p_k],      S_k = ½ v_kᵀ M v_k + potential

with r the wrench that is carried over, c MuJoCo's bias (Coriolis, gyroscopic, gravity) and p the
passive and applied forces. In the step after it

    qfrc_applied = J_kᵀ r_k + c(q_k, u_k) − c(q_k, v_k)

puts the bias at v where MuJoCo takes it at u. What the user applies enters as the mean of now and
before. In contact half of a wrench that is a step late would create energy, so the tool changes
over to the implicit form before it touches, and back after it has been free for a while; both ways
keep S. B' stays the same, so that one device condition holds on both sides: with more in contact, a
device that bears only the less would be thrown off for ever (``passivity.compensation``).

The trees that the tool does not belong to are MuJoCo's alone: for them v = u.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.balanced_velocity import (
    balance,
    carry,
    keep_carried,
    settle,
    write_bias,
    write_external,
    write_half_step,
)
from hapticbridge.kernel.midpoint import note_twist
from hapticbridge.kernel.native import floats, ints, mj_factor_m, mj_passive
from hapticbridge.kernel.tuning import set_gains
from hapticbridge.pose import Vector, scaled, subtract, vector_of

HOLD_TICKS = 5
"""Ticks without anything near before the tool is lossless again, no unit. In twelve random hands on
a wall 5 and 20 changed over equally often, in a peg's hole 17 and 10 times in 5 s; the largest jump
of the wrench is that of the implicit form with both. More keeps the implicit form's damping longer
after a contact: tapping on a wall errs by 33 µm at 5 ticks and by 48 µm at 20."""


@compiled
def apply_carried(state: NDArray[np.void]) -> None:
    """Before the step: applies what is carried over, beside what the user applies.

    The user writes the same array. What is not what was written here last is the user's. Where
    that changes from p to p', a lossless step takes ½(p + p'): then v gains T M⁻¹ p', and the work
    h p'·u of the external port is exact. With all of p', a force that varies would create energy.
    """
    s = state[0]
    applied, users = floats(s.qfrc_written, s.nv), floats(s.qfrc_applied, s.nv)
    own, last = floats(s.carried_force, s.nv), floats(s.last_written, s.nv)
    for i in range(s.nv):
        if applied[i] != last[i]:
            users[i] = applied[i]
        applied[i] = users[i] + own[i]
    if s.is_midpoint:
        write_external(state, s.kept)
        before, after = floats(s.external, s.nv), floats(s.kept, s.nv)
        in_tree = ints(s.dof_in_tree, s.nv)
        for i in range(s.nv):
            applied[i] += 0.5 * in_tree[i] * (before[i] - after[i])
    for i in range(s.nv):
        last[i] = applied[i]


@compiled
def leave(state: NDArray[np.void]) -> None:
    """Goes over to the implicit form: u becomes v, nothing is carried over."""
    s = state[0]
    u, v = floats(s.qvel, s.nv), floats(s.velocity, s.nv)
    own = floats(s.carried_force, s.nv)
    for i in range(s.nv):
        u[i] = v[i]
        own[i] = 0.0
    set_gains(state, 1.0)
    s.is_midpoint = 0


@compiled
def _enter(state: NDArray[np.void], force: Vector, torque: Vector) -> None:
    """Goes over to the lossless form: the velocity becomes v, and u follows from it.

    u = v − (T/2) M⁻¹ [Jᵀf − c(q, u) + p] stands on both sides; two passes leave O(T³).
    """
    s = state[0]
    if not s.has_positions:
        mj_factor_m(s.model, s.data)
    carry(state, scaled(0.5, force), scaled(0.5, torque))
    u, v, half = floats(s.qvel, s.nv), floats(s.velocity, s.nv), floats(s.half_step, s.nv)
    for i in range(s.nv):
        v[i] = u[i]
    write_external(state, s.external)
    if s.has_passive:
        mj_passive(s.model, s.data)
    for _ in range(2):
        write_bias(state, s.qvel, s.bias_at_u)
        write_half_step(state)
        for i in range(s.nv):
            u[i] = v[i] - half[i]
    write_bias(state, s.qvel, s.bias_at_u)
    keep_carried(state)
    set_gains(state, 0.5)
    s.is_midpoint = 1


@compiled
def finish_lossless(state: NDArray[np.void]) -> None:
    """Ends a step: balances it at v, carries the rest of the wrench over, changes the form.

    Needs the poses and energies after the step, and what ``wrench_of_step`` noted: the wrench, its
    work (``law_work``, not in its sum yet), what the actuators applied, and what was near.
    """
    s = state[0]
    force, torque = vector_of(s.wrench_on_tool), vector_of(s.wrench_on_tool[3:6])
    if s.was_midpoint:
        if not s.has_positions:
            mj_factor_m(s.model, s.data)
        rest = subtract(force, vector_of(s.applied_half))
        carry(state, rest, subtract(torque, vector_of(s.applied_half[3:6])))
        settle(state, s.law_work)
    elif not s.is_held:
        # free, but not yet or no longer lossless: that balances to first order only
        v, u = floats(s.velocity, s.nv), floats(s.qvel, s.nv)
        for i in range(s.nv):
            v[i] = u[i]
        balance(state, s.law_work)
    s.hold = HOLD_TICKS if s.is_near else max(s.hold - 1, 0)
    if s.was_midpoint and s.is_near:
        leave(state)
    elif not s.was_midpoint and s.hold == 0:
        _enter(state, force, torque)
    note_twist(state)
