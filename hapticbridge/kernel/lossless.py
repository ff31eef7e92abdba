"""The lossless coupling: half of the wrench solved implicitly, half carried over.

With K/2 and B'/2 in MuJoCo's implicit step and the other half of the last wrench applied, a tool
away from contact keeps the midpoint rule's energy balance to rounding, and is second order.
MuJoCo's velocity u is then half a wrench late; the velocity whose energy is balanced is

    v_k = u_k + (T/2) M⁻¹ [2 J_kᵀ r_k − c(q_k, u_k) + p_k],      S_k = ½ v_kᵀ M v_k + potential

with r the wrench that is carried over, c MuJoCo's bias (Coriolis, gyroscopic, gravity) and p the
passive and applied forces. In the step after it

    qfrc_applied = J_kᵀ r_k + c(q_k, u_k) − c(q_k, v_k)

puts the bias at v where MuJoCo takes it at u. In contact half of a wrench that is a step late would
create energy, so the tool changes over to the implicit form, with the same B', before it touches,
and back after it has been free for a while; both ways keep S.

The trees that the tool does not belong to are MuJoCo's alone: for them v = u.
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
    mj_factor_m,
    mj_mul_m,
    mj_passive,
    mj_rne,
    mj_solve_m,
    pointer_at,
)
from hapticbridge.kernel.ports import LIMIT_TENDON, moment_dot
from hapticbridge.pose import (
    Quaternion,
    Vector,
    add,
    conjugate,
    dot,
    rotated,
    rotation_between,
    scaled,
    subtract,
)

LIMIT_JOINT = 3  # mjtConstraint as a plain integer: the compiler reads no enumeration

HOLD_TICKS = 5
"""Ticks without anything near before the tool is lossless again, no unit. In twelve random hands on
a wall 5 and 20 changed over equally often, in a peg's hole 17 and 10 times in 5 s; the largest jump
of the wrench is that of the implicit form with both. More keeps the implicit form's damping longer
after a contact: tapping on a wall errs by 33 µm at 5 ticks and by 48 µm at 20."""

REACH = 5e-4
"""Distance in m at which something is near: how far a tool at 0.5 m/s comes in a tick of 1 ms. Less
lets a fast tool touch before the change, more makes the tool implicit in free space more often."""

LARGEST_SHARE_BACK = 1e-3
"""Share of the tool's kinetic energy that a tick gives back at most, no unit: a speed of 0.05 %,
hundreds of times what free motion needs. More would be felt where there is next to no motion."""

_GAINS = 10  # doubles that an actuator has for its gain, and for its bias (mjNGAIN, mjNBIAS)


@compiled
def apply_carried(state: NDArray[np.void]) -> None:
    """Before the step: applies what is carried over, beside what the user applies.

    The user writes the same array. What is not what was written here last is the user's.
    """
    s = state[0]
    applied, users = floats(s.qfrc_written, s.nv), floats(s.qfrc_applied, s.nv)
    own, last = floats(s.carried_force, s.nv), floats(s.last_written, s.nv)
    for i in range(s.nv):
        if applied[i] != last[i]:
            users[i] = applied[i]
        applied[i] = users[i] + own[i]
        last[i] = applied[i]


@compiled
def implicit_half(state: NDArray[np.void]) -> tuple[Vector, Vector]:
    """Returns the wrench on the tool that the coupling's actuators applied in the step, as a mean.

    ``actuator_force`` is theirs at the start of the step; two terms of MuJoCo's effective metric
    take it to the end (see ``ports``). The axes are the handle's. Must run before kinematics are
    refreshed.
    """
    s = state[0]
    h = s.timestep
    first = s.coupling_output_adr
    forces = floats(s.actuator_force, first + 6)
    f = np.empty(6)
    for axis in range(6):
        stiffness, damping = s.stiffness, s.damping
        if axis >= 3:
            stiffness, damping = s.rotational_stiffness, s.rotational_damping
        end = moment_dot(state, first + axis, s.qvel)
        change = moment_dot(state, first + axis, s.qacc)
        in_position, in_velocity = 0.5 * h * stiffness, 0.5 * h * (h * stiffness + damping)
        f[axis] = forces[first + axis] - in_position * (end - h * change) - in_velocity * change
    q = s.handle_quaternion
    handle = (q[0], q[1], q[2], q[3])
    return rotated(handle, (f[0], f[1], f[2])), rotated(handle, (f[3], f[4], f[5]))


@compiled
def midpoint_torque(state: NDArray[np.void], tool: Quaternion, turned: Vector) -> Vector:
    """Returns the coupling's torque on the tool, in the world frame, by the midpoint rule.

    In the tool's frame τ = K_r (φ_k + φ_{k−1})/2 + (B_r/T) [½ (R_kᵀ + R_{k−1}ᵀ) δφ_h − R_kᵀ δφ_x]
    with B_r = B'_r + K_r T/2; the force needs no other rule, because in translation
    K (e_k + e_{k−1})/2 + (B/T) δe = K e_k + (B'/T) δe.

    Args:
        state: The bound state, still with the tool's orientation before the step.
        tool: Its orientation after it.
        turned: How it turned, δφ_x.
    """
    s = state[0]
    q = s.tool_quaternion
    to_before, to_after = conjugate((q[0], q[1], q[2], q[3])), conjugate(tool)
    before, after = s.twist, twist_in_tool(state, tool)
    turn = (s.handle_turn[0], s.handle_turn[1], s.handle_turn[2])
    handles = scaled(0.5, add(rotated(to_after, turn), rotated(to_before, turn)))
    rate = (s.rotational_damping + 0.5 * s.period * s.rotational_stiffness) / s.period
    spring = scaled(0.5 * s.rotational_stiffness, add(after, (before[0], before[1], before[2])))
    damper = scaled(rate, subtract(handles, rotated(to_after, turned)))
    return rotated(tool, add(spring, damper))


@compiled
def twist_in_tool(state: NDArray[np.void], tool: Quaternion) -> Vector:
    """Returns φ, the rotation vector from the tool to the handle, in the tool's frame."""
    q = state[0].handle_quaternion
    return rotated(conjugate(tool), rotation_between(tool, (q[0], q[1], q[2], q[3])))


@compiled
def start_twist(state: NDArray[np.void]) -> None:
    """Notes φ before the first tick."""
    q = state[0].tool_quaternion
    twist = twist_in_tool(state, (q[0], q[1], q[2], q[3]))
    for i in range(3):
        state[0].twist[i] = twist[i]


@compiled
def is_near(state: NDArray[np.void]) -> bool:
    """Tells whether the step saw the tool touch something, be near to it, or at a joint's limit.

    Notes in ``is_held`` whether a constraint force acted on its tree.

    Contacts within ``REACH`` are there without a force, because the geoms' gap says so.
    """
    s = state[0]
    found = held = bool(s.is_never_free)
    s.active_contacts = 0
    contacts = pointer_at(s.contact)
    for c in range(ints(s.ncon, 1)[0]):
        contact = contacts + s.contact_size * c
        is_active = ints(contact + s.contact_row, 1)[0] >= 0
        s.active_contacts += is_active
        for geom in ints(contact + s.contact_geoms, 2):
            # a flex is no geom
            if geom < 0 or ints(s.geom_in_tree, s.ngeom)[geom] != 0:
                found, held = True, held or is_active
    count = ints(s.nefc, 1)[0]
    kinds, ids = ints(pointer_at(s.efc_type), count), ints(pointer_at(s.efc_id), count)
    for row in range(count):
        is_joint = kinds[row] == LIMIT_JOINT and ints(s.joint_in_tree, s.njnt)[ids[row]] != 0
        if is_joint or kinds[row] == LIMIT_TENDON:
            found = held = True
    s.is_held = held
    return found


@compiled
def _set_gains(state: NDArray[np.void], share: float) -> None:
    """Gives the coupling's actuators a share of K and B'."""
    s = state[0]
    for axis in range(6):
        stiffness, damping = s.stiffness, s.damping
        if axis >= 3:
            stiffness, damping = s.rotational_stiffness, s.rotational_damping
        actuator = s.coupling_actuator_id + axis
        floats(s.gainprm + 8 * _GAINS * actuator, 1)[0] = share * damping
        bias = floats(s.biasprm + 8 * _GAINS * actuator, 3)
        bias[1], bias[2] = -share * stiffness, -share * damping


@compiled
def _bias(state: NDArray[np.void], velocity: int, result: int) -> None:
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
def _carry(state: NDArray[np.void], force: Vector, torque: Vector) -> None:
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
def _half_step(state: NDArray[np.void]) -> None:
    """Writes (T/2) M⁻¹ [2 Jᵀr − c(q, u) + p] of the tool's tree; needs ``_carry`` and the bias."""
    s = state[0]
    carried, bias = floats(s.generalised, s.nv), floats(s.bias_at_u, s.nv)
    passive, users = floats(s.qfrc_passive, s.nv), floats(s.qfrc_applied, s.nv)
    kick, half = floats(s.kept, s.nv), floats(s.half_step, s.nv)
    for i in range(s.nv):
        kick[i] = 2.0 * carried[i] - bias[i] + users[i]
        if s.has_passive:
            kick[i] += passive[i]
    mj_solve_m(s.model, s.data, s.half_step, s.kept, np.int32(1))
    in_tree = ints(s.dof_in_tree, s.nv)
    for i in range(s.nv):
        half[i] *= 0.5 * s.period * in_tree[i]


@compiled
def _keep_carried(state: NDArray[np.void]) -> None:
    """Writes what the next step applies: Jᵀr + c(q, u) − c(q, v), on the tool's tree."""
    s = state[0]
    _bias(state, s.velocity, s.bias_at_v)
    own, carried = floats(s.carried_force, s.nv), floats(s.generalised, s.nv)
    at_u, at_v = floats(s.bias_at_u, s.nv), floats(s.bias_at_v, s.nv)
    in_tree = ints(s.dof_in_tree, s.nv)
    for i in range(s.nv):
        own[i] = in_tree[i] * (carried[i] + at_u[i] - at_v[i])


@compiled
def _settle(state: NDArray[np.void], work: float) -> None:
    """Finds v_k from u_k and the kinetic energy at v_k; needs ``_carry``.

    Args:
        state: The bound state.
        work: Of the coupling in this step, in J, which is not in its sum yet.
    """
    s = state[0]
    _bias(state, s.qvel, s.bias_at_u)
    if s.has_passive:
        mj_passive(s.model, s.data)
    _half_step(state)
    v, u, half = floats(s.velocity, s.nv), floats(s.qvel, s.nv), floats(s.half_step, s.nv)
    for i in range(s.nv):
        v[i] = u[i] + half[i]
    _balance(state, work)
    _keep_carried(state)


@compiled
def _balance(state: NDArray[np.void], work: float) -> None:
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
    _bias(state, s.qvel, s.bias_at_u)
    s.kinetic -= owed
    s.lossless_debt -= owed


@compiled
def _leave(state: NDArray[np.void]) -> None:
    """Goes over to the implicit form: u becomes v, nothing is carried over."""
    s = state[0]
    u, v = floats(s.qvel, s.nv), floats(s.velocity, s.nv)
    own = floats(s.carried_force, s.nv)
    for i in range(s.nv):
        u[i] = v[i]
        own[i] = 0.0
    _set_gains(state, 1.0)
    s.is_midpoint = 0


@compiled
def _enter(state: NDArray[np.void], force: Vector, torque: Vector) -> None:
    """Goes over to the lossless form: the velocity becomes v, and u follows from it.

    u = v − (T/2) M⁻¹ [Jᵀf − c(q, u) + p] stands on both sides; two passes leave O(T³).
    """
    s = state[0]
    mj_factor_m(s.model, s.data)
    _carry(state, scaled(0.5, force), scaled(0.5, torque))
    u, v, half = floats(s.qvel, s.nv), floats(s.velocity, s.nv), floats(s.half_step, s.nv)
    for i in range(s.nv):
        v[i] = u[i]
    if s.has_passive:
        mj_passive(s.model, s.data)
    for _ in range(2):
        _bias(state, s.qvel, s.bias_at_u)
        _half_step(state)
        for i in range(s.nv):
            u[i] = v[i] - half[i]
    _bias(state, s.qvel, s.bias_at_u)
    _keep_carried(state)
    _set_gains(state, 0.5)
    s.is_midpoint = 1


@compiled
def finish_lossless(
    state: NDArray[np.void],
    force: Vector,
    torque: Vector,
    half: tuple[Vector, Vector],
    near: bool,
    tool: Quaternion,
    moved: Vector,
    turned: Vector,
) -> Vector:
    """Ends a step: balances it at v, carries the rest of the wrench over, changes the form.

    Args:
        state: The bound state after ``refresh_energies``, with the tool's pose before the step.
        force: The coupling's on the tool, in the world frame.
        torque: Its torque by the implicit form's rule.
        half: What ``implicit_half`` returned, in the lossless form.
        near: What ``is_near`` returned.
        tool: The tool's orientation after the step.
        moved: How the grip moved.
        turned: How it turned.

    Returns:
        The torque by the rule of the form that the step had.
    """
    s = state[0]
    was_midpoint = s.is_midpoint != 0
    if was_midpoint:
        torque = midpoint_torque(state, tool, turned)
    work = dot(force, moved) + dot(torque, turned)
    if was_midpoint:
        mj_factor_m(s.model, s.data)
        # the torque is carried in the tool's frame, so that it turns with the tool
        q = s.tool_quaternion
        applied = rotated(tool, rotated(conjugate((q[0], q[1], q[2], q[3])), half[1]))
        _carry(state, subtract(force, half[0]), subtract(torque, applied))
        _settle(state, work)
    elif not s.is_held:
        # free, but not yet or no longer lossless: that balances to first order only
        v, u = floats(s.velocity, s.nv), floats(s.qvel, s.nv)
        for i in range(s.nv):
            v[i] = u[i]
        _balance(state, work)
    s.hold = HOLD_TICKS if near else max(s.hold - 1, 0)
    if was_midpoint and near:
        _leave(state)
    elif not was_midpoint and s.hold == 0:
        _enter(state, force, torque)
    twist = twist_in_tool(state, tool)
    for i in range(3):
        s.twist[i] = twist[i]
    return torque
