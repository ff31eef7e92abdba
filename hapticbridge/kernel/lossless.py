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
device that bears only the less would be thrown off for ever (``theory.compensation``).

The trees that the tool does not belong to are MuJoCo's alone: for them v = u.
"""

from __future__ import annotations

import math
from collections.abc import Container
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import LIMIT_JOINT, LIMIT_TENDON
from hapticbridge.kernel.handle import set_gains
from hapticbridge.kernel.ledger import add_body_wrenches, moment_dot
from hapticbridge.kernel.mujoco_c import (
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
from hapticbridge.pose import (
    Quaternion,
    Vector,
    add,
    conjugate,
    quaternion_of,
    rotated,
    rotation_between,
    scaled,
    store_vector,
    subtract,
    vector_of,
)

# The velocity v at which a lossless step's energy is balanced, and what is carried to the next.
#
# Formulas and symbols: ``kernel.lossless``.

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


# The coupling's wrench where half of it is solved implicitly: its law, and what was applied.


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
    handle = quaternion_of(s.handle_quaternion)
    return rotated(handle, vector_of(f)), rotated(handle, vector_of(f[3:6]))


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
    to_before, to_after = conjugate(quaternion_of(s.tool_quaternion)), conjugate(tool)
    before, after = vector_of(s.twist), twist_in_tool(state, tool)
    turn = vector_of(s.handle_turn)
    handles = scaled(0.5, add(rotated(to_after, turn), rotated(to_before, turn)))
    rate = (s.rotational_damping + 0.5 * s.period * s.rotational_stiffness) / s.period
    spring = scaled(0.5 * s.rotational_stiffness, add(after, before))
    damper = scaled(rate, subtract(handles, rotated(to_after, turned)))
    return rotated(tool, add(spring, damper))


@compiled
def twist_in_tool(state: NDArray[np.void], tool: Quaternion) -> Vector:
    """Returns φ, the rotation vector from the tool to the handle, in the tool's frame."""
    handle = quaternion_of(state[0].handle_quaternion)
    return rotated(conjugate(tool), rotation_between(tool, handle))


@compiled
def note_twist(state: NDArray[np.void]) -> None:
    """Notes φ as it is: before the first tick, and for the next one."""
    s = state[0]
    store_vector(s.twist, twist_in_tool(state, quaternion_of(s.tool_quaternion)))


# Whether the tool is near to something, touches it, or is at a joint's limit.

REACH = 5e-4
"""Distance in m within which a contact counts as near: how far a tool at 0.5 m/s comes in a tick of
1 ms. Less lets a fast tool touch before the change, more makes the tool implicit sooner and longer.

To change over only when the next step would have the contact's force, told from the distance and
the approach at its start, errs less (tapping on a wall at 4 Hz 0.25 of the implicit form instead of
0.31, at 1 Hz 0.35 instead of 0.50) and is not done: a peg led into its hole then uses 1.4 % of the
slack instead of 0.9 %, and 2 of 20 hands on a planar peg (0 of another 100) use 0.01 % of it that
use none so: chosen after seeing both, for strictness."""


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


# The kinematic tree that the tool belongs to: all that its grip can move through joints alone.

_OBJECTS = mujoco.mjtObj


@dataclass(frozen=True, slots=True, eq=False)
class ToolTree:
    """What belongs to the tool's tree.

    Attributes:
        dofs: Per degree of freedom of the model.
        joints: Per joint.
        geoms: Per geom.
        is_never_free: Whether friction in a joint, an equality constraint, a tendon with friction
            or an actuator other than the coupling's always acts on it.
    """

    dofs: NDArray[np.bool_]
    joints: NDArray[np.bool_]
    geoms: NDArray[np.bool_]
    is_never_free: bool


def tree_of_tool(model: mujoco.MjModel, body: int, own: Container[int] = ()) -> ToolTree:
    """Returns the tree of the body that carries the grip.

    Args:
        model: The compiled scene.
        body: The grip's body.
        own: The coupling's actuators, by id.
    """
    tree = model.body_treeid[body]
    bodies = model.body_treeid == tree
    dofs = model.dof_treeid == tree
    return ToolTree(
        dofs=np.asarray(dofs),
        joints=np.asarray(bodies[model.jnt_bodyid]),
        geoms=np.asarray(bodies[model.geom_bodyid]),
        is_never_free=bool(
            np.any(model.dof_frictionloss[dofs])
            or np.any(model.tendon_frictionloss)
            or _is_driven(model, bodies, own)
            or any(_touches(model, equality, bodies) for equality in range(model.neq))
        ),
    )


def _is_driven(model: mujoco.MjModel, bodies: NDArray[np.bool_], own: Container[int]) -> bool:
    """Tells whether an actuator of the scene acts on the tree; what cannot be told counts as yes.

    MuJoCo takes the whole of its force in a step where half would be due, and a servo's implicitly:
    beside a lossless coupling that creates energy (8 mJ in 1 s in a measured case).
    """
    transmission = mujoco.mjtTrn
    owner = {
        transmission.mjTRN_JOINT: model.jnt_bodyid,
        transmission.mjTRN_JOINTINPARENT: model.jnt_bodyid,
        transmission.mjTRN_SITE: model.site_bodyid,
    }
    for actuator, (kind, targets) in enumerate(
        zip(model.actuator_trntype, model.actuator_trnid, strict=True)
    ):
        owners = owner.get(transmission(kind))
        if actuator in own:
            continue
        if owners is None or any(bodies[owners[target]] for target in targets if target >= 0):
            return True
    return False


def has_passive_forces(model: mujoco.MjModel) -> bool:
    """Tells whether springs, dampers, gravity compensation or a fluid act anywhere."""
    return bool(
        np.any(model.jnt_stiffness)
        or np.any(model.dof_damping)
        or np.any(model.body_gravcomp)
        or model.ntendon
        or model.nflex
        or model.opt.density
        or model.opt.viscosity
    )


def _touches(model: mujoco.MjModel, equality: int, bodies: NDArray[np.bool_]) -> bool:
    """Tells whether an equality constraint holds the tree; what cannot be told counts as yes."""
    ids = np.array([model.eq_obj1id[equality], model.eq_obj2id[equality]])
    ids = ids[ids >= 0]
    if model.eq_type[equality] == mujoco.mjtEq.mjEQ_JOINT:  # of joints the object's type says none
        return bool(bodies[model.jnt_bodyid[ids]].any())
    if model.eq_objtype[equality] == _OBJECTS.mjOBJ_BODY:
        return bool(bodies[ids].any())
    if model.eq_objtype[equality] == _OBJECTS.mjOBJ_SITE:
        return bool(bodies[model.site_bodyid[ids]].any())
    return True


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
