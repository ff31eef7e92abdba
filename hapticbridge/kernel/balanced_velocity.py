"""The velocity v at which a lossless step's energy is balanced, and what is carried to the next.

Formulas and symbols: ``kernel.lossless``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.native import (
    floats,
    ints,
    mj_apply_ft,
    mj_com_vel,
    mj_mul_m,
    mj_passive,
    mj_rne,
    mj_solve_m,
)
from hapticbridge.kernel.ports import add_body_wrenches
from hapticbridge.pose import Vector

LARGEST_SHARE_BACK = 1e-3
"""Share of the tool's kinetic energy that a tick gives back at most, no unit: a speed of 0.05 %,
hundreds of times what free motion needs. More would be felt where there is next to no motion."""


@compiled
def write_bias(state: NDArray[np.void], velocity: int, result: int) -> None:
    """Writes c(q_k, v) for a velocity by address; MuJoCo's own velocity stays as it is."""
    s = state[0]
    qvel, given, kept = floats(s.qvel, s.nv), floats(velocity, s.nv), floats(s.kept, s.nv)
    for i in range(s.nv):
        kept[i] = qvel[i]
        qvel[i] = given[i]
    mj_com_vel(s.model, s.data)
    mj_rne(s.model, s.data, np.int32(0), result)
    for i in range(s.nv):
        qvel[i] = kept[i]


@compiled
def carry(state: NDArray[np.void], force: Vector, torque: Vector) -> None:
    """Writes J_kᵀ r_k for a wrench in the world frame, about the grip."""
    s = state[0]
    generalised, wrench = floats(s.generalised, s.nv), floats(s.wrench_buffer, 6)
    generalised[:] = 0.0
    for i in range(3):
        wrench[i], wrench[3 + i] = force[i], torque[i]
    mj_apply_ft(
        s.model,
        s.data,
        s.wrench_buffer,
        s.wrench_buffer + 24,
        s.site_xpos + 24 * s.grip_site_id,
        np.int32(s.grip_body_id),
        s.generalised,
    )


@compiled
def write_external(state: NDArray[np.void], result: int) -> None:
    """Writes what the user applies, to joints and to bodies, as generalised forces."""
    s = state[0]
    users, external = floats(s.qfrc_applied, s.nv), floats(result, s.nv)
    for i in range(s.nv):
        external[i] = users[i]
    add_body_wrenches(state, result)


@compiled
def write_half_step(state: NDArray[np.void]) -> None:
    """Writes (T/2) M⁻¹ [2 Jᵀr − c(q, u) + p] of the tool's tree.

    Needs ``carry``, the bias and ``write_external``.
    """
    s = state[0]
    carried, bias = floats(s.generalised, s.nv), floats(s.bias_at_u, s.nv)
    passive, external = floats(s.qfrc_passive, s.nv), floats(s.external, s.nv)
    kick, half = floats(s.kept, s.nv), floats(s.half_step, s.nv)
    for i in range(s.nv):
        kick[i] = 2.0 * carried[i] - bias[i] + external[i]
        if s.has_passive:
            kick[i] += passive[i]
    mj_solve_m(s.model, s.data, s.half_step, s.kept, np.int32(1))
    in_tree = ints(s.dof_in_tree, s.nv)
    for i in range(s.nv):
        half[i] *= 0.5 * s.period * in_tree[i]


@compiled
def keep_carried(state: NDArray[np.void]) -> None:
    """Writes what the next step applies: Jᵀr + c(q, u) − c(q, v), on the tool's tree."""
    s = state[0]
    write_bias(state, s.velocity, s.bias_at_v)
    own, carried = floats(s.carried_force, s.nv), floats(s.generalised, s.nv)
    at_u, at_v = floats(s.bias_at_u, s.nv), floats(s.bias_at_v, s.nv)
    in_tree = ints(s.dof_in_tree, s.nv)
    for i in range(s.nv):
        own[i] = in_tree[i] * (carried[i] + at_u[i] - at_v[i])


@compiled
def settle(state: NDArray[np.void], work: float) -> None:
    """Finds v_k from u_k and the kinetic energy at v_k; needs ``carry``.

    Args:
        state: The bound state.
        work: Of the coupling in this step, in J, which is not in its sum yet.
    """
    s = state[0]
    write_bias(state, s.qvel, s.bias_at_u)
    write_external(state, s.external)
    if s.has_passive:
        mj_passive(s.model, s.data)
    write_half_step(state)
    v, u, half = floats(s.velocity, s.nv), floats(s.qvel, s.nv), floats(s.half_step, s.nv)
    for i in range(s.nv):
        v[i] = u[i] + half[i]
    balance(state, work)
    keep_carried(state)


@compiled
def balance(state: NDArray[np.void], work: float) -> None:
    """Takes the kinetic energy at v and gives back what was created."""
    s = state[0]
    v = floats(s.velocity, s.nv)
    momentum, in_tree = floats(s.kept, s.nv), ints(s.dof_in_tree, s.nv)
    mj_mul_m(s.model, s.data, s.kept, s.velocity)
    mine = others = 0.0
    for i in range(s.nv):
        energy = 0.5 * v[i] * momentum[i]
        mine += energy * in_tree[i]
        others += energy * (1 - in_tree[i])
    s.kinetic = mine + others
    _give_back(state, work, mine)


@compiled
def _give_back(state: NDArray[np.void], work: float, kinetic: float) -> None:
    """Slows the tool down by what the lossless form has created, so that (14) holds.

    Where inertia and Jacobian turn, the form keeps S to third order only: 1e-10 J a tick at what a
    hand does. That is some 1e-7 of the tool's kinetic energy, and leaves the order as it is.
    """
    s = state[0]
    stored = s.kinetic + s.potential - s.start_energy
    surplus = stored - s.coupling_work - work - s.actuator_work - s.external_work
    s.lossless_debt = max(0.0, s.lossless_debt + surplus - s.environment_energy)
    owed = min(s.lossless_debt, surplus, LARGEST_SHARE_BACK * kinetic)
    if owed <= 0.0:
        return
    slower = math.sqrt(1.0 - owed / kinetic)
    v, u, in_tree = floats(s.velocity, s.nv), floats(s.qvel, s.nv), ints(s.dof_in_tree, s.nv)
    for i in range(s.nv):
        if in_tree[i]:
            u[i] -= (1.0 - slower) * v[i]  # the next step starts from u
            v[i] *= slower
    write_bias(state, s.qvel, s.bias_at_u)
    s.kinetic -= owed
    s.lossless_debt -= owed
