"""The lossless coupling: half of the wrench solved implicitly, half carried over.

MuJoCo's implicit step applies K/2 and B'/2; the other half of the last wrench is applied as a
force. Away from contact the tool then keeps the energy balance of the midpoint rule to rounding,
and the scheme is of second order. MuJoCo's velocity u lags by half a wrench. The balanced one is

    v_k = u_k + (T/2) M⁻¹ [2 J_kᵀ r_k − c(q_k, u_k) + p_k],      S_k = ½ v_kᵀ M v_k + potential

with r the carried wrench (N, N m), J the grip's Jacobian, M the inertia matrix, c MuJoCo's bias
(Coriolis, gyroscopic, gravity), p the passive and applied forces, T the period in s and S the
storage in J. The next step applies

    qfrc_applied = J_kᵀ r_k + c(q_k, u_k) − c(q_k, v_k)

so that the bias acts at v where MuJoCo evaluates it at u. Forces that the user applies enter as the
mean of their present and previous values.

In contact, half a wrench that is one step late would create energy. The tool therefore changes to
the implicit form before it touches, and back after it has been free for ``HOLDOFF`` ticks. Both
changes keep S. B' is equal on both sides, so one device condition covers both. If B' were larger in
contact, a device with just enough damping for free motion would bounce off the wall again and again
(``theory.bounds``).

About a large twist the midpoint torque would ask more damping of the device than the law does.
Beyond the twist for which the device's reserve pays, it turns into the law's own torque
(``midpoint_torque``). Nothing else of the step changes, so its balance holds as before.

Springs and dampers of the tool's joints and tendons are taken at the midpoint too
(``kernel.springs``).

Kinematic trees other than the tool's belong to MuJoCo alone: for them v = u.
"""

from __future__ import annotations

import math
from collections.abc import Container
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.codes import (
    COUPLING_ACTUATORS,
    LIMIT_JOINT,
    LIMIT_TENDON,
    LOSSLESS_TICK,
    Part,
    State,
)
from hapticbridge.kernel.explicit_bias import take_back, write_bias
from hapticbridge.kernel.force_level import limited_wrench, limited_wrench_after_step
from hapticbridge.kernel.handle import handle_of_step, note_tool, tool_after_step
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.law import (
    applied_wrench,
    law_wrench,
    pulled_after_step,
    set_gains,
    torque_across,
    turned_on,
)
from hapticbridge.kernel.ledger import (
    add_body_wrenches,
    set_kinetic_energy,
)
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
    wide_ints,
)
from hapticbridge.kernel.pose import (
    Quaternion,
    Vector,
    add,
    conjugate,
    norm,
    product,
    quaternion_exp,
    quaternion_of,
    rotated,
    rotation_between,
    scaled,
    store_vector,
    subtract,
    vector_of,
)
from hapticbridge.kernel.springs import (
    add_rest,
    apply_shares,
    begin_springs,
    bind_springs,
    carry_springs,
    evaluate_passive,
    note_rest,
    note_solved,
    restore_springs,
)

_OWN_VECTORS = (
    "last_written",
    "carried_force",
    "external",
    "velocity",
    "half_step",
    "bias_at_u",
    "bias_at_v",
    "generalised",
    "work_buffer",
)
_OWN_LISTS = (
    "geom_in_tree",
    "joint_in_tree",
    "dof_in_tree",
    "dofs_of_tree",
    "awake_lists",
    "awake_counts",
    "wrench_buffer",
)
_ADDRESSES = (*_OWN_LISTS, "qfrc_written", "qfrc_passive")

LOSSLESS_DTYPE = np.dtype(
    [
        *((name, "<i8") for name in _OWN_VECTORS + _ADDRESSES),
        ("has_passive", "<i8"),
        ("dof_count", "<i8"),
        ("has_other_trees", "<i8"),
        ("is_never_free", "<i8"),
        ("is_midpoint", "<i8"),
        ("was_midpoint", "<i8"),
        ("is_near", "<i8"),
        ("is_constrained", "<i8"),
        ("holdoff", "<i8"),
        ("ticks", "<i8"),
        ("active_contacts", "<i8"),
        ("energy_debt", "<f8"),
        ("twist", "<f8", 3),
        ("applied_half", "<f8", 6),
    ]
)
"""Sub-record ``lossless``, written by this module alone.

Addresses of vectors over the degrees of freedom come first. ``is_midpoint`` and ``was_midpoint``
are the form of the next and of the last step; ``holdoff`` counts the ticks until the tool may be
lossless again; ``energy_debt`` in J is created energy that is still to be taken back; ``twist``
in rad is φ in the tool's frame; ``applied_half`` is the wrench that the actuators applied."""

SLEEP = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
"""Bit of MuJoCo's flags that lets bodies sleep."""

# Bias and passive forces of the tool's tree alone
#
# MuJoCo evaluates them for a whole scene: in one with 100 free bodies that takes a third of its
# step, three times per tick. If bodies may sleep, its functions visit the bodies that are awake,
# and compute the same numbers for these to the bit. The bridge allows no sleep during a step, so
# the lists of what is awake are free: for the duration of a call they hold the tool's tree.


@compiled
def _exchange_awake(s: State) -> None:
    """Exchanges MuJoCo's lists of what is awake for those of the tool's tree, or back."""
    mj, lossless = s.mj, s.lossless
    lists, counts = wide_ints(lossless.awake_lists, 3), ints(lossless.awake_counts, 3)
    own_lists = (mj.body_awake_ind, mj.parent_awake_ind, mj.dof_awake_ind)
    own_counts = (mj.nbody_awake, mj.nparent_awake, mj.nv_awake)
    for i in range(3):
        at = wide_ints(own_lists[i], 1)
        lists[i], at[0] = at[0], lists[i]
        count = ints(own_counts[i], 1)
        counts[i], count[0] = count[0], counts[i]
    ints(mj.enableflags, 1)[0] ^= SLEEP


@compiled
def write_tool_bias(s: State, velocity: int, result: int) -> None:
    """Does what ``write_bias`` does, for the degrees of freedom of the tool's tree alone."""
    mj, lossless = s.mj, s.lossless
    if not lossless.has_other_trees:
        write_bias(s, velocity, result)
        return
    nv = mj.nv
    dofs = ints(lossless.dofs_of_tree, lossless.dof_count)
    qvel, other, saved = floats(mj.qvel, nv), floats(velocity, nv), floats(mj.scratch, nv)
    bias, kept, target = (
        floats(mj.qfrc_bias, nv),
        floats(mj.scratch + 8 * nv, nv),
        floats(result, nv),
    )
    for dof in dofs:
        saved[dof], qvel[dof] = qvel[dof], other[dof]
        kept[dof] = bias[dof]
    _exchange_awake(s)
    mj_com_vel(mj.model, mj.data)
    # MuJoCo heeds the lists only if it writes to its own array
    mj_rne(mj.model, mj.data, np.int32(0), mj.qfrc_bias)
    _exchange_awake(s)
    for dof in dofs:
        qvel[dof], target[dof], bias[dof] = saved[dof], bias[dof], kept[dof]


@compiled
def evaluate_tool_passive(s: State) -> None:
    """Does what ``springs.evaluate_passive`` does, for the tool's tree."""
    if s.mj.has_tendons_or_flexes or not s.lossless.has_other_trees:
        evaluate_passive(s)
        return
    _exchange_awake(s)
    mj_passive(s.mj.model, s.mj.data)
    _exchange_awake(s)


# The velocity v at which a lossless step's energy is balanced, and the force carried over

MAX_SHARE_BACK = 1e-3
"""Largest share of the tool's kinetic energy that a tick takes back; no unit. It changes the speed
by 0.05 %, hundreds of times the need of free motion. A larger share would be felt in slow
motion."""


@compiled
def carry(s: State, force: Vector, torque: Vector) -> None:
    """Writes J_kᵀ r_k for a wrench r_k in the world frame, about the grip."""
    mj, lossless = s.mj, s.lossless
    generalised, wrench = (floats(lossless.generalised, mj.nv), floats(lossless.wrench_buffer, 6))
    generalised[:] = 0.0
    for i in range(3):
        wrench[i], wrench[3 + i] = force[i], torque[i]
    mj_apply_ft(
        mj.model,
        mj.data,
        lossless.wrench_buffer,
        lossless.wrench_buffer + 24,
        mj.site_xpos + 24 * mj.grip_site_id,
        np.int32(mj.grip_body_id),
        lossless.generalised,
    )


@compiled
def write_external(s: State, result: int) -> None:
    """Writes the user's forces on joints and wrenches on bodies as generalised forces."""
    mj = s.mj
    users, external = floats(mj.qfrc_applied, mj.nv), floats(result, mj.nv)
    for i in range(mj.nv):
        external[i] = users[i]
    add_body_wrenches(s, result)


@compiled
def write_half_step(s: State) -> None:
    """Writes (T/2) M⁻¹ [2 Jᵀr − c(q, u) + p] for the tool's tree.

    Needs the results of ``carry``, ``write_tool_bias`` and ``write_external``.
    """
    mj, lossless = s.mj, s.lossless
    carried, bias = floats(lossless.generalised, mj.nv), floats(lossless.bias_at_u, mj.nv)
    passive, external = (floats(lossless.qfrc_passive, mj.nv), floats(lossless.external, mj.nv))
    impulse, half = floats(lossless.work_buffer, mj.nv), floats(lossless.half_step, mj.nv)
    for i in range(mj.nv):
        impulse[i] = 2.0 * carried[i] - bias[i] + external[i]
        if lossless.has_passive:
            impulse[i] += passive[i]
    add_rest(s, impulse)
    mj_solve_m(mj.model, mj.data, lossless.half_step, lossless.work_buffer, np.int32(1))
    in_tree = ints(lossless.dof_in_tree, mj.nv)
    for i in range(mj.nv):
        half[i] *= 0.5 * s.run.period * in_tree[i]


@compiled
def keep_carried(s: State) -> None:
    """Writes the force that the next step applies: Jᵀr + c(q, u) − c(q, v), on the tool's tree."""
    mj, lossless = s.mj, s.lossless
    write_tool_bias(s, lossless.velocity, lossless.bias_at_v)
    own, carried = (floats(lossless.carried_force, mj.nv), floats(lossless.generalised, mj.nv))
    at_u, at_v = floats(lossless.bias_at_u, mj.nv), floats(lossless.bias_at_v, mj.nv)
    in_tree = ints(lossless.dof_in_tree, mj.nv)
    for i in range(mj.nv):
        own[i] = in_tree[i] * (carried[i] + at_u[i] - at_v[i])
    carry_springs(s, own, in_tree)


@compiled
def balance_midpoint(s: State) -> None:
    """Computes v_k from u_k and the kinetic energy at v_k; needs the result of ``carry``."""
    mj, lossless = s.mj, s.lossless
    write_tool_bias(s, mj.qvel, lossless.bias_at_u)
    write_external(s, lossless.external)
    if lossless.has_passive:
        evaluate_tool_passive(s)
        note_rest(s)
    write_half_step(s)
    v, u, half = (
        floats(lossless.velocity, mj.nv),
        floats(mj.qvel, mj.nv),
        floats(lossless.half_step, mj.nv),
    )
    for i in range(mj.nv):
        v[i] = u[i] + half[i]
    balance(s)
    keep_carried(s)


@compiled
def balance(s: State) -> None:
    """Takes the kinetic energy at v, and takes created energy back from the tool's motion."""
    lossless = s.lossless
    mj = s.mj
    v = floats(lossless.velocity, mj.nv)
    momentum, in_tree = floats(lossless.work_buffer, mj.nv), ints(lossless.dof_in_tree, mj.nv)
    mj_mul_m(mj.model, mj.data, lossless.work_buffer, lossless.velocity)
    own = others = 0.0
    for i in range(mj.nv):
        energy = 0.5 * v[i] * momentum[i]
        own += energy * in_tree[i]
        others += energy * (1 - in_tree[i])
    kinetic = own + others
    set_kinetic_energy(s.energy, kinetic - _take_back(s, kinetic, own))
    if take_back(s, lossless.velocity, s.loop.law_work):
        write_tool_bias(s, mj.qvel, lossless.bias_at_u)


@compiled
def _take_back(s: State, kinetic: float, own: float) -> float:
    """Slows the tool by the energy that the lossless form created, so that (14) holds.

    If inertia and Jacobian turn, the form keeps S to third order only: 1e-10 J per tick at the
    speed of a hand. That is 1e-7 of the tool's kinetic energy, and leaves the order unchanged.

    Args:
        s: The bound state; the coupling's work in this step is not in its sum yet.
        kinetic: Kinetic energy of the scene at v in J.
        own: The part of it in the tool's tree, in J.

    Returns:
        The energy taken, in J.
    """
    mj = s.mj
    energy, lossless = s.energy, s.lossless
    stored = kinetic + energy.potential - energy.start_energy
    surplus = (
        stored
        - energy.coupling_work
        - s.loop.law_work
        - energy.actuator_work
        - energy.external_work
    )
    lossless.energy_debt = max(0.0, lossless.energy_debt + surplus - energy.environment_energy)
    taken = min(lossless.energy_debt, surplus + s.impact.taken, MAX_SHARE_BACK * own)
    if taken <= 0.0:
        return 0.0
    slower = math.sqrt(1.0 - taken / own)
    nv = mj.nv
    v, u, in_tree = (
        floats(lossless.velocity, nv),
        floats(mj.qvel, nv),
        ints(lossless.dof_in_tree, nv),
    )
    for i in range(nv):
        if in_tree[i]:
            u[i] -= (1.0 - slower) * v[i]  # the next step starts from u
            v[i] *= slower
    write_tool_bias(s, mj.qvel, lossless.bias_at_u)
    lossless.energy_debt -= taken
    return float(taken)


# The coupling's wrench by the midpoint rule, and the half that the actuators applied


@compiled
def midpoint_torque(s: State, tool: Quaternion, turned: Vector, law: Vector) -> Vector:
    """Returns the coupling's torque on the tool, in the world frame, by the midpoint rule.

    In the tool's frame, with B_r = B'_r + K_r T/2,

        τ = K_r (φ_k + φ_{k−1})/2 + (B_r/T) [½ (R_kᵀ + R_{k−1}ᵀ) δφ_h − R_kᵀ δφ_x]

    The force keeps its law: K (e_k + e_{k−1})/2 + (B/T) δe = K e_k + (B'/T) δe in translation. In
    rotation this torque differs from the law's by K_r φ/4 times the motion, across it. Beyond the
    twist for which the device's damping pays (``law.torque_across``) the difference grows no more.

    Args:
        s: The bound state, still with the tool's orientation before the step.
        tool: Its orientation after it.
        turned: Its rotation vector δφ_x in rad.
        law: The torque K_r φ_k + (B'_r/T) (δφ_h − δφ_x) in N m.
    """
    to_before, to_after = conjugate(quaternion_of(s.pose.tool_quaternion)), conjugate(tool)
    before = vector_of(s.lossless.twist)
    after = turned_on(before, twist_in_tool(s, tool))
    turn = vector_of(s.pose.handle_turn)
    handles = scaled(0.5, add(rotated(to_after, turn), rotated(to_before, turn)))
    rate = (
        s.coupling.rotational_damping + 0.5 * s.run.period * s.coupling.rotational_stiffness
    ) / s.run.period
    spring = scaled(0.5 * s.coupling.rotational_stiffness, add(after, before))
    damper = scaled(rate, subtract(handles, rotated(to_after, turned)))
    torque = rotated(tool, add(spring, damper))
    across = 0.25 * s.coupling.rotational_stiffness * max(norm(before), norm(after))
    most = torque_across(s)
    if across <= most:
        return torque
    return add(law, scaled(most / across, subtract(torque, law)))


@compiled
def twist_in_tool(s: State, tool: Quaternion) -> Vector:
    """Returns φ, the rotation vector from the tool to the handle, in the tool's frame."""
    handle = quaternion_of(s.pose.handle_quaternion)
    return rotated(conjugate(tool), rotation_between(tool, handle))


@compiled
def note_twist(s: State) -> None:
    """Notes the present φ for the next tick."""
    store_vector(s.lossless.twist, twist_in_tool(s, quaternion_of(s.pose.tool_quaternion)))


@compiled
def note_slip(s: State) -> None:
    """Notes φ of the last tick anew after a slip, as if the handle had slipped before its turn."""
    back = quaternion_exp(scaled(-1.0, vector_of(s.pose.handle_turn)))
    handle = product(back, quaternion_of(s.pose.handle_quaternion))
    tool = quaternion_of(s.pose.tool_quaternion)
    store_vector(s.lossless.twist, rotated(conjugate(tool), rotation_between(tool, handle)))


@compiled
def lossless_wrench(states: NDArray[np.void]) -> tuple[Vector, Vector, Vector, Vector]:
    """Evaluates the lossless coupling after a step of MuJoCo, and notes the tool's new pose.

    Returns:
        Force, torque, and the tool's motion and rotation vector in the step.
    """
    s = states[0]
    lossless = s.lossless
    lossless.is_near = scan_contacts(s)
    lossless.was_midpoint = lossless.is_midpoint
    lossless.ticks += lossless.was_midpoint
    if not lossless.is_midpoint:
        force, torque, moved, turned = limited_wrench_after_step(states, True)
        if s.level.gain_ratio[0] < 1.0 or s.level.gain_ratio[1] < 1.0 or s.level.flags:
            lossless.is_near = True
        return force, torque, moved, turned
    note_solved(s)
    handle_frame = quaternion_of(s.pose.handle_quaternion)
    half = applied_wrench(s, 0.5)
    half_force, half_torque = rotated(handle_frame, half[0]), rotated(handle_frame, half[1])
    position, orientation, moved, turned = tool_after_step(s)
    tool = position, orientation
    stretch, twist = pulled_after_step(s, handle_of_step(s, True), tool)
    force, law = law_wrench(s, stretch, twist, moved, turned)
    torque = midpoint_torque(s, orientation, turned, law)
    # the torque is carried in the tool's frame, so that it turns with the tool
    to_before = conjugate(quaternion_of(s.pose.tool_quaternion))
    store_vector(lossless.applied_half[0:3], half_force)
    store_vector(lossless.applied_half[3:6], rotated(orientation, rotated(to_before, half_torque)))
    note_tool(s.pose, position, orientation, turned)
    # above the level the rest that is carried over is smaller than the half, which dissipates
    force, torque = limited_wrench(s, force, torque)
    if s.level.flags:
        lossless.is_near = True
    return force, torque, moved, turned


@compiled
def lossless_flag(lossless: Part) -> int:
    """Returns the record's flag of a lossless tick, or 0."""
    return LOSSLESS_TICK if lossless.was_midpoint else 0


# Contacts and joint limits near the tool

REACH = 5e-4
"""Distance in m within which a contact counts as near. A tool at 0.5 m/s moves so far in a tick of
1 ms. A smaller value lets a fast tool touch before the change; a larger one makes the tool implicit
sooner and longer.

A change only when the next step would have a contact force, predicted from distance and approach
speed, errs less: tapping on a wall at 4 Hz 0.25 of the implicit form instead of 0.31, at 1 Hz 0.35
instead of 0.50. It uses more slack: a peg led into its hole 1.4 % instead of 0.9 %, and 2 of 20
hands on a planar peg (0 of another 100) 0.01 % instead of none. The fixed distance is less accurate
but created no energy."""


@compiled
def scan_contacts(s: State) -> bool:
    """Counts contacts with a force, and notes if a constraint force acted on the tool's tree.

    Returns:
        True if the step saw the tool near a contact, in contact, or at a joint's limit. Contacts
        within ``REACH`` exist without a force, because the geoms' gap includes them.
    """
    mj = s.mj
    lossless = s.lossless
    touches = constrained = bool(lossless.is_never_free)
    lossless.active_contacts = 0
    contacts = pointer_at(mj.contact)
    for c in range(ints(mj.ncon, 1)[0]):
        contact = contacts + mj.contact_size * c
        is_active = ints(contact + mj.contact_row, 1)[0] >= 0
        lossless.active_contacts += is_active
        for geom in ints(contact + mj.contact_geoms, 2):
            # a flex is no geom
            if geom < 0 or ints(lossless.geom_in_tree, mj.ngeom)[geom] != 0:
                touches, constrained = True, constrained or is_active
    count = ints(mj.nefc, 1)[0]
    kinds, ids = ints(pointer_at(mj.efc_type), count), ints(pointer_at(mj.efc_id), count)
    for row in range(count):
        in_tree = ints(lossless.joint_in_tree, mj.njnt)
        is_joint = kinds[row] == LIMIT_JOINT and in_tree[ids[row]] != 0
        if is_joint or kinds[row] == LIMIT_TENDON:
            touches = constrained = True
    lossless.is_constrained = constrained
    return touches


# The tool's kinematic tree: all bodies that its grip can move through joints alone

_OBJECTS = mujoco.mjtObj


@dataclass(frozen=True, slots=True, eq=False)
class ToolTree:
    """Membership in the tool's kinematic tree.

    Attributes:
        dofs: True for each degree of freedom of the model in the tree.
        bodies: True for each body in the tree.
        joints: True for each joint in the tree.
        geoms: True for each geom in the tree.
        tendons: True for each tendon that pulls on the tree by a spring or a damper.
        is_never_free: True if joint friction, an equality constraint, a tendon with friction or an
            actuator other than the coupling's always acts on the tree.
    """

    dofs: NDArray[np.bool_]
    bodies: NDArray[np.bool_]
    joints: NDArray[np.bool_]
    geoms: NDArray[np.bool_]
    tendons: NDArray[np.bool_]
    is_never_free: bool


def tree_of_tool(model: mujoco.MjModel, body: int, own: Container[int] = ()) -> ToolTree:
    """Returns the tree of the body that carries the grip.

    Trees that a tendon's spring or damper joins to it belong to it.

    Args:
        model: The compiled scene.
        body: The grip's body.
        own: The coupling's actuators, by id.
    """
    trees, tendons = {int(model.body_treeid[body])}, _elastic_tendons(model)
    for _ in tendons:
        for tendon in tendons:
            joined = {int(tree) for tree in model.tendon_treeid[tendon] if tree >= 0}
            trees |= joined if joined & trees else set()
    bodies = np.isin(model.body_treeid, list(trees))
    dofs = np.isin(model.dof_treeid, list(trees))
    pulls = np.zeros(model.ntendon, np.bool_)
    pulls[[t for t in tendons if trees & set(model.tendon_treeid[t].tolist())]] = True
    return ToolTree(
        dofs=np.asarray(dofs),
        bodies=bodies,
        joints=np.asarray(bodies[model.jnt_bodyid]),
        geoms=np.asarray(bodies[model.geom_bodyid]),
        tendons=pulls,
        is_never_free=bool(
            np.any(model.dof_frictionloss[dofs])
            or np.any(model.tendon_frictionloss)
            or _is_driven(model, bodies, own)
            or any(_touches(model, equality, bodies) for equality in range(model.neq))
        ),
    )


def _elastic_tendons(model: mujoco.MjModel) -> list[int]:
    return [
        tendon
        for tendon in range(model.ntendon)
        if np.any(model.tendon_stiffness[tendon])
        or np.any(model.tendon_stiffnesspoly[tendon])
        or np.any(model.tendon_damping[tendon])
        or np.any(model.tendon_dampingpoly[tendon])
    ]


def _is_driven(model: mujoco.MjModel, bodies: NDArray[np.bool_], own: Container[int]) -> bool:
    """Returns True if an actuator of the scene acts on the tree; unknown transmissions count.

    MuJoCo applies the whole force of an actuator in a step that is due half of it, and a servo's
    force implicitly. Beside a lossless coupling that creates energy: 8 mJ in 1 s as measured.
    Gravity compensation of a joint's actuators (``actuatorgravcomp``) is such a force, too.
    """
    if model.ngravcomp and np.any(model.jnt_actgravcomp[bodies[model.jnt_bodyid]]):
        return True
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
    """Returns True if springs, dampers, gravity compensation or a fluid act on any body."""
    return bool(
        np.any(model.jnt_stiffness)
        or np.any(model.jnt_stiffnesspoly)
        or np.any(model.dof_damping)
        or np.any(model.dof_dampingpoly)
        or np.any(model.body_gravcomp)
        or model.ntendon
        or model.nflex
        or model.opt.density
        or model.opt.viscosity
    )


def spring_at_the_end(model: mujoco.MjModel, tree: ToolTree) -> str:
    """Returns a spring of the tree that cannot be taken at the midpoint; empty if all can.

    A force with a corner would generate energy there: 0.3 µJ in 2 s with a tool of 50 g on 500 N/m.
    With such a spring all springs of the tree stay MuJoCo's own, taken at the end of the step, and
    lossless is of first order: 1 kg on a tendon with slack errs by 0.49 %, implicit by 2.5 %.
    """
    at_rest = model.tendon_lengthspring[tree.tendons]
    if np.any(at_rest[:, 0] != at_rest[:, 1]):
        return "a tendon's spring with slack (springlength of two lengths)"
    if np.any(model.jnt_springyield[tree.joints]) or np.any(model.tendon_springyield[tree.tendons]):
        return "a spring that yields (springyield)"
    if np.any(model.tendon_treenum[tree.tendons] > 2):
        return "a spring or damper on a tendon between more than two kinematic trees"
    if np.any(tree.bodies[np.append(model.flex_vertbodyid, model.flex_nodebodyid)]):
        return "a flex"
    return ""


def _touches(model: mujoco.MjModel, equality: int, bodies: NDArray[np.bool_]) -> bool:
    """Returns True if an equality constraint acts on the tree; unknown kinds count."""
    ids = np.array([model.eq_obj1id[equality], model.eq_obj2id[equality]])
    ids = ids[ids >= 0]
    if model.eq_type[equality] == mujoco.mjtEq.mjEQ_JOINT:  # of joints the object's type says none
        return bool(bodies[model.jnt_bodyid[ids]].any())
    if model.eq_objtype[equality] == _OBJECTS.mjOBJ_BODY:
        return bool(bodies[ids].any())
    if model.eq_objtype[equality] == _OBJECTS.mjOBJ_SITE:
        return bool(bodies[model.site_bodyid[ids]].any())
    return True


# Binding, and the change between the two forms

HOLDOFF = 5
"""Ticks without a near contact before the tool is lossless again. Twelve random hands on a wall
changed form equally often with 5 and 20 ticks; in a peg's hole they changed 17 and 10 times in 5 s.
The largest jump of the wrench is that of the implicit form with both. A larger value keeps the
implicit form's damping longer after a contact: tapping on a wall errs by 33 µm at 5 ticks and by
48 µm at 20."""


def bind_lossless(
    s: State, model: mujoco.MjModel, data: mujoco.MjData, grip: int, first_actuator: int
) -> dict[str, NDArray[np.generic]]:
    """Fills in addresses and facts about the tool's tree, its springs and dampers.

    Args:
        s: The state to bind.
        model: The prepared scene.
        data: Its data; ``qfrc_applied`` holds the user's forces.
        grip: Body that carries the grip.
        first_actuator: First of the coupling's six actuators.

    Returns:
        Arrays that must outlive the state. ``user_forces`` replaces ``qfrc_applied`` as the place
        of the user's forces, because the method writes its own forces to the latter.
    """
    nv, lossless = max(model.nv, 1), s["lossless"]
    own = range(first_actuator, first_actuator + len(COUPLING_ACTUATORS))
    tree = tree_of_tool(model, grip, own)
    owned: dict[str, NDArray[np.generic]] = {
        "geom_in_tree": np.ascontiguousarray(tree.geoms, dtype=np.int32),
        "joint_in_tree": np.ascontiguousarray(tree.joints, dtype=np.int32),
        "dof_in_tree": np.ascontiguousarray(tree.dofs, dtype=np.int32),
        "wrench_buffer": np.zeros(6),
    }
    owned |= _bind_tree(lossless, tree)
    owned |= {name: np.zeros(nv) for name in _OWN_VECTORS}
    owned["last_written"][: model.nv] = data.qfrc_applied
    for name in _OWN_VECTORS + _OWN_LISTS:
        lossless[name] = owned[name].ctypes.data
    lossless["qfrc_written"] = data.qfrc_applied.ctypes.data
    lossless["qfrc_passive"] = data.qfrc_passive.ctypes.data
    lossless["is_never_free"] = tree.is_never_free
    lossless["has_passive"] = has_passive_forces(model)
    if not spring_at_the_end(model, tree):
        chosen = {"jnt": tree.joints, "dof": tree.dofs, "tendon": tree.tendons}
        owned |= bind_springs(s["springs"], model, data, chosen)
    return owned | {"user_forces": owned["last_written"].copy()}


def _bind_tree(lossless: Part, tree: ToolTree) -> dict[str, NDArray[np.generic]]:
    """Fills in how many of the scene are in the tool's tree; returns their lists for MuJoCo."""
    bodies, dofs = (np.flatnonzero(each).astype(np.int32) for each in (tree.bodies, tree.dofs))
    lossless["dof_count"] = dofs.size
    lossless["has_other_trees"] = 0 < dofs.size < tree.dofs.size
    with_world = np.append(np.int32(0), bodies)
    lists = [with_world.ctypes.data, bodies.ctypes.data, dofs.ctypes.data]
    return {
        "awake_bodies": with_world,
        "awake_parents": bodies,
        "dofs_of_tree": dofs,
        "awake_lists": np.array(lists, dtype=np.int64),
        "awake_counts": np.array([with_world.size, bodies.size, dofs.size], dtype=np.int32),
    }


@compiled
def restart_lossless(s: State) -> None:
    """Starts in the implicit form again after the scene was reset; nothing is carried over."""
    mj, lossless = s.mj, s.lossless
    restore_springs(s)
    lossless.is_midpoint = 0
    lossless.is_near = 0
    lossless.holdoff = 0
    written, users = floats(lossless.qfrc_written, mj.nv), floats(mj.qfrc_applied, mj.nv)
    last, carried = floats(lossless.last_written, mj.nv), floats(lossless.carried_force, mj.nv)
    for i in range(mj.nv):
        users[i] = last[i] = written[i]
        carried[i] = 0.0
    set_gains(s, 1.0)
    note_twist(s)


@compiled
def apply_carried(s: State) -> None:
    """Applies the carried force before the step, beside the user's forces.

    The user writes to the array that this method also writes to; a value that differs from the
    method's last one is the user's. If the user's force changes from p to p', a lossless step takes
    ½ (p + p'). Then v gains T M⁻¹ p', and the work h p'·u of the external port is exact. With all
    of p', a varying force would create energy.
    """
    mj, lossless = s.mj, s.lossless
    applied, users = floats(lossless.qfrc_written, mj.nv), floats(mj.qfrc_applied, mj.nv)
    own, last = floats(lossless.carried_force, mj.nv), floats(lossless.last_written, mj.nv)
    for i in range(mj.nv):
        if applied[i] != last[i]:
            users[i] = applied[i]
        applied[i] = users[i] + own[i]
    if lossless.is_midpoint:
        write_external(s, lossless.work_buffer)
        before, after = (floats(lossless.external, mj.nv), floats(lossless.work_buffer, mj.nv))
        in_tree = ints(lossless.dof_in_tree, mj.nv)
        for i in range(mj.nv):
            applied[i] += 0.5 * in_tree[i] * (before[i] - after[i])
        apply_shares(s)
    for i in range(mj.nv):
        last[i] = applied[i]


@compiled
def _leave(s: State) -> None:
    """Changes to the implicit form: u becomes v, and no force is carried over."""
    mj, lossless = s.mj, s.lossless
    u, v = floats(mj.qvel, mj.nv), floats(lossless.velocity, mj.nv)
    own = floats(lossless.carried_force, mj.nv)
    for i in range(mj.nv):
        u[i] = v[i]
        own[i] = 0.0
    set_gains(s, 1.0)
    lossless.is_midpoint = 0


@compiled
def _enter(s: State, force: Vector, torque: Vector) -> None:
    """Changes to the lossless form: the velocity becomes v, and u follows from it.

    u = v − (T/2) M⁻¹ [Jᵀf − c(q, u) + p] has u on both sides; two passes leave an error of O(T³).
    """
    mj, lossless = s.mj, s.lossless
    if not s.loop.has_positions:
        mj_factor_m(mj.model, mj.data)
    carry(s, scaled(0.5, force), scaled(0.5, torque))
    u, v, half = (
        floats(mj.qvel, mj.nv),
        floats(lossless.velocity, mj.nv),
        floats(lossless.half_step, mj.nv),
    )
    for i in range(mj.nv):
        v[i] = u[i]
    write_external(s, lossless.external)
    if lossless.has_passive:
        evaluate_tool_passive(s)
        begin_springs(s)
    for _ in range(2):
        write_tool_bias(s, mj.qvel, lossless.bias_at_u)
        write_half_step(s)
        for i in range(mj.nv):
            u[i] = v[i] - half[i]
    write_tool_bias(s, mj.qvel, lossless.bias_at_u)
    keep_carried(s)
    set_gains(s, 0.5)
    lossless.is_midpoint = 1


@compiled
def finish_lossless(s: State) -> bool:
    """Ends a step: balances its energy at v, carries half of the wrench over, changes the form.

    Needs the poses and energies after the step, and the notes of ``lossless_wrench``.

    Returns:
        True if the form changed and the model's springs with it.
    """
    mj = s.mj
    lossless, wrench = s.lossless, s.loop.wrench_on_tool
    force, torque = vector_of(wrench), vector_of(wrench[3:6])
    if lossless.was_midpoint:
        if not s.loop.has_positions:
            mj_factor_m(mj.model, mj.data)
        rest = subtract(force, vector_of(lossless.applied_half))
        carry(s, rest, subtract(torque, vector_of(lossless.applied_half[3:6])))
        balance_midpoint(s)
    else:
        take_back(s, mj.qvel, s.loop.law_work)
        if not lossless.is_constrained:
            # free, but not lossless at present: the balance holds to first order only
            v, u = floats(lossless.velocity, mj.nv), floats(mj.qvel, mj.nv)
            for i in range(mj.nv):
                v[i] = u[i]
            balance(s)
    lossless.holdoff = HOLDOFF if lossless.is_near else max(lossless.holdoff - 1, 0)
    if lossless.was_midpoint and lossless.is_near:
        _leave(s)
    elif not lossless.was_midpoint and lossless.holdoff == 0:
        _enter(s, force, torque)
    note_twist(s)
    return bool(s.springs.count > 0 and lossless.is_midpoint != lossless.was_midpoint)
