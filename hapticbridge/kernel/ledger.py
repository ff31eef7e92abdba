"""The energy balance of the environment: storage, the works of all ports, and the verdict.

    E_k = S_k − S_{k−1} − (f_k·δx_k + τ_k·δφ_k) − W_actuators − W_external

S is the energy that the scene stores, f and τ the coupling's wrench on the tool, δx and δφ the
tool's motion in tick k; energies and works in J, wrenches in N and N m, motions in m and rad.
Σ E_k <= 0 means that the simulation created no energy. It is eq. (14) of Brown & Colgate (1997),
in short (14). What MuJoCo's explicit Coriolis and gyroscopic forces would create is taken back from
the motion before a tick is metered (``explicit_bias``).

The accounts of energy, all in J; q = force_scale / scale:

| account                       | formula                                | used by         |
|-------------------------------|----------------------------------------|-----------------|
| ``environment_energy``        | Σ E_k                                  | verdict         |
| ``slack``                     | Σ ½ g ‖δx‖² + ½ g_r ‖δφ‖² below level  | verdict         |
| ``device_energy``             | Σ w·δp, given to the device            | summary         |
| device without a law          | Σ w·δp − b ‖δp‖²/t + q (S − S_0 − W)   | verdict         |
| observer, ``observed_energy`` | as above less W_u, with credit capped  | ``damper``      |
| observer, ``created_energy``  | Σ E_k − slack, with its credit capped  | ``environment`` |
| observer, ``guarded_energy``  | Σ w·δp − b ‖δp‖²/t − H − q R           | energy limit    |
| audit, device port            | ``audit.energy.stored_in_springs``     | its verdict     |

``damper`` and ``environment`` are the passivity controllers. w is the wrench on the device, δp its
motion, b its damping, t the time between two new samples, W the work of the scene's actuators and
of external forces. W_u is ``passivity_controller.unfelt_work``, R that of ``observe_release``, H
what steps of the encoder may have added (``observe_energy``).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.codes import (
    CONTACT_PYRAMIDAL,
    EQUALITY,
    LIMIT_JOINT,
    LIMIT_TENDON,
    Part,
    Scheme,
    State,
)
from hapticbridge.kernel.elastic import elastic_energy, follow_elastic
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.mujoco_c import (
    floats,
    ints,
    mj_apply_ft,
    mj_com_pos,
    mj_energy_pos,
    mj_energy_vel,
    mj_fwd_kinematics,
    mj_make_constraint,
    mj_make_m,
    pointer_at,
)
from hapticbridge.kernel.pose import (
    Vector,
    add,
    cross,
    dot,
    quaternion_of,
    rotation_between,
    subtract,
    vector_of,
)

ENERGY_DTYPE = np.dtype(
    [
        ("kinetic", "<f8"),
        ("potential", "<f8"),
        ("start_energy", "<f8"),
        ("coupling_work", "<f8"),
        ("actuator_work", "<f8"),
        ("external_work", "<f8"),
        ("environment_energy", "<f8"),
        ("device_energy", "<f8"),
        ("device_dissipation", "<f8"),
        ("throughput", "<f8"),
        ("slack", "<f8"),
        ("slack_share", "<f8"),
        ("others_work", "<f8"),
        ("others_slack", "<f8"),
        ("others_throughput", "<f8"),
        ("first_unstrict", "<i8"),
        ("first_active", "<i8"),
        ("first_device_excess", "<i8"),
        ("step_actuator_work", "<f8"),
        ("step_external_work", "<f8"),
        ("mocap_has_moved", "<i8"),
        ("equality_rows", "<i8"),
        ("has_excess", "<i8"),
        ("is_constrained", "<i8"),
    ]
)
"""Sub-record ``energy``, written by this module alone. Energies and works in J, since the start;
``first_*`` are the ticks at which a condition first failed, -1 before; ``step_*`` are works of
the newest step. ``mocap_has_moved`` and ``equality_rows``, the number of residuals kept from
before a move, hold until the step that follows the move is metered. ``others_*`` are the sums
over the other hands of the scene, 0 with one hand. ``has_excess`` is 1 if energy was to be taken
back in the last tick, ``is_constrained`` if a constraint of the scene's own acted in this one."""


def start_energies(energy: Part) -> None:
    """Takes the present storage as that of the start."""
    energy["start_energy"] = energy["kinetic"] + energy["potential"]
    for name in ("first_unstrict", "first_active", "first_device_excess"):
        energy[name] = -1


# Work of the scene's own mocap bodies, which are moved between two steps


@compiled
def note_moved_mocap_bodies(s: State) -> None:
    """Finds the scene's mocap bodies that were moved before a step, and books their direct work.

    A move changes the potential energy of attached springs and weights at once; the change is work
    of the external port. The work through contacts, limits and equality constraints is known only
    after the step (``meter_ports``).
    """
    mj = s.mj
    s.energy.mocap_has_moved = 0
    positions, quaternions = (
        floats(mj.mocap_pos, 3 * mj.nmocap),
        floats(mj.mocap_quat, 4 * mj.nmocap),
    )
    previous = floats(mj.mocap_previous, 7 * mj.nmocap)
    shift = floats(mj.mocap_shift, 6 * mj.nmocap)
    for m in range(mj.nmocap):
        if mj.handle_mocap_id <= m < mj.handle_mocap_id + mj.handle_count:
            continue
        has_moved = False
        for i in range(3):
            shift[6 * m + i] = positions[3 * m + i] - previous[7 * m + i]
            has_moved = has_moved or shift[6 * m + i] != 0.0
        for i in range(4):
            has_moved = has_moved or quaternions[4 * m + i] != previous[7 * m + 3 + i]
        if has_moved:
            p, q = 7 * m + 3, 4 * m
            turn = rotation_between(quaternion_of(previous[p:]), quaternion_of(quaternions[q:]))
            for i in range(3):
                shift[6 * m + 3 + i] = turn[i]
                previous[7 * m + i] = positions[3 * m + i]
            for i in range(4):
                previous[7 * m + 3 + i] = quaternions[4 * m + i]
            s.energy.mocap_has_moved = 1
        else:
            for i in range(3, 6):
                shift[6 * m + i] = 0.0
    if s.energy.mocap_has_moved:
        _keep_residuals(s)
        mj_fwd_kinematics(mj.model, mj.data)
        mj_com_pos(mj.model, mj.data)
        s.energy.external_work += potential_energy(s) - s.energy.potential


@compiled
def _keep_residuals(s: State) -> None:
    """Keeps the residuals of equality constraints and the tendon lengths from before the move."""
    mj = s.mj
    s.energy.equality_rows = 0
    if mj.equality_capacity > 0:
        mj_make_constraint(mj.model, mj.data)  # positions are still those before the move
        s.energy.equality_rows = min(ints(mj.ne, 1)[0], mj.equality_capacity)
        residuals = floats(pointer_at(mj.efc_pos), s.energy.equality_rows)
        _copy(residuals, floats(mj.equality_before, residuals.size))
    if mj.ntendon > 0:
        _copy(floats(mj.ten_length, mj.ntendon), floats(mj.tendon_before, mj.ntendon))


@compiled
def _copy(source: NDArray[np.float64], target: NDArray[np.float64]) -> None:
    # an assignment to a slice could raise, which machine code without numba cannot
    for i in range(source.size):
        target[i] = source[i]


@compiled
def mocap_work(s: State) -> float:
    """Returns the work of moved mocap bodies through constraints, −Σ λ_i δr_i in J.

    λ_i is the force of constraint row i in the step that follows the move, δr_i the change of its
    residual by the move: an equality's error, a tendon's length or a contact's distance. Rows
    without a residual (friction, also in contacts) take no work from the move.

    Slow moves are exact (a lift costs m g h). MuJoCo treats a moved mocap body as standing still,
    so its constraint dampers resist the motion and may supply energy. That energy counts as created
    by the simulation.
    """
    mj = s.mj
    force = floats(pointer_at(mj.efc_force), ints(mj.nefc, 1)[0])
    count = force.size
    residual = floats(pointer_at(mj.efc_pos), count)
    if s.contact.is_aimed and s.contact.row_capacity > 0:
        count = min(count, s.contact.row_capacity)
        residual = floats(s.contact.row_positions, count)
    kinds, ids = ints(pointer_at(mj.efc_type), count), ints(pointer_at(mj.efc_id), count)
    work = 0.0
    if ints(mj.ne, 1)[0] == s.energy.equality_rows:
        before = floats(mj.equality_before, s.energy.equality_rows)
        for i in range(s.energy.equality_rows):
            # the handle's weld is the coupling's port: its residual changes with the handle
            if not (kinds[i] == EQUALITY and ids[i] == mj.weld_id):
                work -= force[i] * (residual[i] - before[i])
    if mj.ntendon > 0:
        lengths, tendon_before = (
            floats(mj.ten_length, mj.ntendon),
            floats(mj.tendon_before, mj.ntendon),
        )
        ranges = floats(mj.tendon_range, 2 * mj.ntendon)
        for i in range(count):
            if kinds[i] == LIMIT_TENDON:
                t = ids[i]
                to_lower = abs(residual[i] - (lengths[t] - ranges[2 * t]))
                to_upper = abs(residual[i] - (ranges[2 * t + 1] - lengths[t]))
                sign = 1.0 if to_lower <= to_upper else -1.0
                work -= sign * force[i] * (lengths[t] - tendon_before[t])
    return work + mocap_contact_work(s)


@compiled
def mocap_contact_work(s: State) -> float:
    """Returns the part of ``mocap_work`` that goes through contacts, in J."""
    mj, work = s.mj, 0.0
    force = floats(pointer_at(mj.efc_force), ints(mj.nefc, 1)[0])
    for c in range(ints(mj.ncon, 1)[0]):
        work -= _contact_work(s, pointer_at(mj.contact) + c * mj.contact_size, force)
    return work


@compiled
def _contact_work(s: State, contact: int, force: NDArray[np.float64]) -> float:
    """Returns λ δr of one contact, its normal force times the change of distance by the move."""
    mj = s.mj
    row = ints(contact + mj.contact_row, 1)[0]
    change = opened_by_mocap(s, contact) if row >= 0 else 0.0
    if change == 0.0:
        return 0.0
    rows = 1
    if ints(pointer_at(mj.efc_type), force.size)[row] == CONTACT_PYRAMIDAL:
        rows = 2 * (ints(contact + mj.contact_dim, 1)[0] - 1)  # every edge carries the normal
    normal = 0.0
    for i in range(row, row + rows):
        normal += force[i]
    return normal * change


@compiled
def opened_by_mocap(s: State, contact: int) -> float:
    """Returns the distance in m by which moved mocap bodies opened a contact since the last step.

    ``contact`` is its address. The handle is none of them.
    """
    mj = s.mj
    geoms = ints(contact + mj.contact_geoms, 2)
    if geoms[0] < 0 or geoms[1] < 0:
        return 0.0
    point, frame = floats(contact + mj.contact_point, 3), floats(contact + mj.contact_frame, 3)
    body_of, mocap_of = ints(mj.geom_bodyid, mj.ngeom), ints(mj.body_mocap, mj.nbody)
    positions, shift = (floats(mj.mocap_pos, 3 * mj.nmocap), floats(mj.mocap_shift, 6 * mj.nmocap))
    change = 0.0
    for side in range(2):
        m = mocap_of[body_of[geoms[side]]]
        if m < 0 or mj.handle_mocap_id <= m < mj.handle_mocap_id + mj.handle_count:
            continue
        p, d = 3 * m, 6 * m
        arm = subtract(vector_of(point), vector_of(positions[p:]))
        moved = add(vector_of(shift[d:]), cross(vector_of(shift[d + 3 :]), arm))
        # the normal points from the first geom to the second
        change += (2.0 * side - 1.0) * dot(vector_of(frame), moved)
    return float(change)


# Work that enters the environment in one MuJoCo step through ports other than the coupling
#
# MuJoCo's ``discrete`` step solves M (v⁺ − v)/h = f(q, v) − … in the positions and Jacobians of
# its start, and moves by h v⁺. A generalised force Q therefore does the work h Q·v⁺, with the Q
# that the step used. For a stiff servo that is its force at the end of the step;
# ``actuator_force`` is the force at the start.


@compiled
def moment_dot(s: State, output: int, vector_address: int) -> float:
    """Returns one row of the actuator moment times a vector over the degrees of freedom."""
    mj = s.mj
    nnz = ints(mj.moment_rownnz, output + 1)[output]
    adr = ints(mj.moment_rowadr, output + 1)[output]
    columns = ints(mj.moment_colind, adr + nnz)
    moment = floats(mj.actuator_moment, adr + nnz)
    vector = floats(vector_address, mj.nv)
    total = 0.0
    for i in range(adr, adr + nnz):
        total += moment[i] * vector[columns[i]]
    return total


@compiled
def _actuator_work(s: State) -> float:
    """Returns the work of the scene's own actuators in J.

        W = h Σ (F − h k_p m·v − (h² k_p + h k_v) m·a) m·v⁺

    F is the force at the step's start, m the moment, a = (v⁺ − v)/h, h the time step, k_p and k_v
    the gains of a servo. The two corrections take F to the end of the step. MuJoCo keeps them for
    the actuators in its effective metric: ``efm_ak`` = h k_p, ``efm_as`` = h² k_p + h k_v. The sum
    uses ``qfrc_actuator``, which respects the joints' force limits, and subtracts the coupling. It
    also subtracts gravity compensation (``actuatorgravcomp``), which ``potential_energy`` counts.
    """
    mj = s.mj
    h = s.run.timestep
    qvel, force = floats(mj.qvel, mj.nv), floats(mj.qfrc_actuator, mj.nv)
    compensation, is_by_actuator = (
        floats(mj.qfrc_gravcomp, mj.nv),
        floats(mj.actuator_gravcomp_dofs, mj.nv),
    )
    power = 0.0
    for i in range(mj.nv):
        power += (force[i] - compensation[i] * is_by_actuator[i]) * qvel[i]
    first, own = mj.coupling_output_adr, mj.coupling_outputs
    forces = floats(mj.actuator_force, first + own)
    for output in range(first, first + own):
        power -= forces[output] * moment_dot(s, output, mj.qvel)
    count = ints(mj.nefmA, 1)[0]
    if count > 0:
        ids = ints(pointer_at(mj.efm_aid), count)
        scales = floats(pointer_at(mj.efm_as), count)
        stiffnesses = floats(pointer_at(mj.efm_ak), count)
        for k in range(count):
            actuator = ids[k]
            if mj.coupling_actuator_id <= actuator < mj.coupling_actuator_id + own:
                continue
            adr = ints(mj.outadr, actuator + 1)[actuator]
            num = ints(mj.outnum, actuator + 1)[actuator]
            for output in range(adr, adr + num):
                end = moment_dot(s, output, mj.qvel)
                change = moment_dot(s, output, mj.qacc)
                power -= (stiffnesses[k] * (end - h * change) + scales[k] * change) * end
    return float(h * power)


@compiled
def has_loaded_body(s: State) -> bool:
    """Returns True if a wrench is applied to a body."""
    is_loaded = 0
    for value in floats(s.mj.xfrc_applied, 6 * s.mj.nbody):
        is_loaded |= value != 0.0  # without a branch, so that several are compared at once
    return is_loaded != 0


@compiled
def add_body_wrenches(s: State, result: int, clears: bool = False) -> bool:
    """Adds ``xfrc_applied`` as generalised forces, at the present positions, to an array.

    Args:
        s: The bound state.
        result: Address of ``nv`` numbers.
        clears: True to set these to zero first if a body is loaded.

    Returns:
        True if a body is loaded; otherwise nothing was written.
    """
    if not has_loaded_body(s):
        return False
    mj = s.mj
    wrenches = floats(mj.xfrc_applied, 6 * mj.nbody)
    any_loaded = False
    for body in range(1, mj.nbody):
        is_loaded = False
        for i in range(6 * body, 6 * body + 6):
            is_loaded = is_loaded or wrenches[i] != 0.0
        if is_loaded:
            if clears and not any_loaded:
                floats(result, mj.nv)[:] = 0.0
            any_loaded = True
            force = mj.xfrc_applied + 48 * body
            mj_apply_ft(
                mj.model, mj.data, force, force + 24, mj.xipos + 24 * body, np.int32(body), result
            )
    return any_loaded


@compiled
def _applied_work(s: State) -> float:
    """Returns the work of applied forces and body wrenches in J."""
    mj = s.mj
    nv = mj.nv
    qvel, applied = floats(mj.qvel, nv), floats(mj.qfrc_applied, nv)
    power = 0.0
    for i in range(nv):
        power += applied[i] * qvel[i]
    # positions are still those of the step's start, where MuJoCo applied the wrenches
    if add_body_wrenches(s, mj.scratch, clears=True):
        generalised = floats(mj.scratch, nv)
        for i in range(nv):
            power += generalised[i] * qvel[i]
    return float(s.run.timestep * power)


@compiled
def _belt_work(s: State) -> float:
    """Returns the work of surfaces that move by themselves (``surfacevel``) through friction, in J.

        W = −h Σ f_i s_i

    f_i is the friction of a contact along its tangents and about its normal, s_i the velocity of
    the second geom's surface relative to the first one's, which MuJoCo adds to J v. What the
    friction loses against the moving surface is dissipated by the contact.
    """
    mj, power = s.mj, 0.0
    count = ints(mj.nefc, 1)[0]
    force, kinds = floats(pointer_at(mj.efc_force), count), ints(pointer_at(mj.efc_type), count)
    for c in range(ints(mj.ncon, 1)[0]):
        contact = pointer_at(mj.contact) + c * mj.contact_size
        row, dim = ints(contact + mj.contact_row, 1)[0], ints(contact + mj.contact_dim, 1)[0]
        if row < 0:
            continue
        velocity = floats(contact + mj.contact_surface_velocity, 3)
        friction = floats(contact + mj.contact_friction, 5)
        for i in range(min(dim - 1, 3)):
            if kinds[row] == CONTACT_PYRAMIDAL:  # two edges, n + µ t and n − µ t
                first = row + 2 * i
                power -= friction[i] * (force[first] - force[first + 1]) * velocity[i]
            else:
                power -= force[row + 1 + i] * velocity[i]
    return float(s.run.timestep * power)


@compiled
def meter_ports(s: State) -> None:
    """Adds the work of the step that just ended to the actuator port and the external port.

    Must run before the kinematics are refreshed: the step used moments, Jacobians and points of
    attack of its start.
    """
    s.energy.step_actuator_work = s.energy.step_external_work = 0.0
    meter_ports_again(s)


@compiled
def meter_ports_again(s: State) -> None:
    """Replaces the work of the newest step, which was repeated."""
    energy = s.energy
    if not s.contact.is_rigid and _is_constrained(s):
        energy.is_constrained = 1
    if s.mj.has_actuators:
        work = _actuator_work(s)
        energy.actuator_work += work - energy.step_actuator_work
        energy.step_actuator_work = work
    work = _applied_work(s)
    if s.mj.has_belts:
        work += _belt_work(s)
    if energy.mocap_has_moved:
        work += mocap_work(s)
    energy.external_work += work - energy.step_external_work
    energy.step_external_work = work


@compiled
def _is_constrained(s: State) -> bool:
    """Returns True if a constraint other than dry friction acted in the step that just ended."""
    kinds = ints(pointer_at(s.mj.efc_type), ints(s.mj.nefc, 1)[0])
    for row, force in enumerate(floats(pointer_at(s.mj.efc_force), kinds.size)):
        is_friction = EQUALITY < kinds[row] < LIMIT_JOINT
        if force != 0.0 and not is_friction:
            return True
    return False


@compiled
def end_mocap_moves(s: State) -> None:
    """Clears the flag set by a move of mocap bodies, once the step that follows is metered."""
    s.energy.mocap_has_moved = 0


# Storage, the ports of coupling and device, and the verdict

SLACK_SHARE = 0.5
"""Share of ½ (K + nB'/T) ‖δx_i‖² that counts as slack with n > 1 evaluations of the law per tick;
no unit. With substeps only half of the slack may be used, because the whole would require infinite
device damping at B' = 0. With a smaller share an environment counts as active sooner."""

ENERGY_TOLERANCE = 1e-9
"""Energy in J, and share of Σ|f·δx|, that an environment may create and still count as strict. It
covers the rounding of a sum of many small works. A larger value hides energy that was created, a
smaller one reports rounding."""


@compiled
def refresh_inertia(s: State) -> None:
    """Computes the inertia matrix for the state after the step."""
    mj = s.mj
    if mj.has_tendons_or_flexes:
        mj_fwd_kinematics(mj.model, mj.data)
    else:
        mj_com_pos(mj.model, mj.data)
    mj_make_m(mj.model, mj.data)


@compiled
def potential_energy(s: State) -> float:
    """Returns the energy in J that the scene stores at the present positions.

        V = V_0 + V_U + Σ c_i m_i g·x_i

    V_0 is MuJoCo's energy of gravity and springs, V_U that of flexes (``elastic``). Gravity
    compensation depends on positions alone, so it stores energy, and a weight that it carries
    stores none. c_i is the ``gravcomp`` of body i, m_i its mass in kg, x_i its centre of mass in m,
    g gravity in m/s².
    """
    mj = s.mj
    mj_energy_pos(mj.model, mj.data)
    potential = floats(mj.energy, 2)[0]
    if mj.has_gravity_compensation:
        masses, centres = floats(mj.compensated_mass, mj.nbody), floats(mj.xipos, 3 * mj.nbody)
        gravity = vector_of(floats(mj.gravity, 3))
        for body in range(mj.nbody):
            potential += masses[body] * dot(gravity, vector_of(centres[3 * body :]))
    return float(potential + elastic_energy(s))


@compiled
def refresh_energies(s: State) -> None:
    """Computes kinetic and potential energy for the state after the step.

    Kinetic energy needs the inertia matrix, potential energy the positions and the tendon lengths.
    MuJoCo's position stage has computed them if it ran since the step. All that another program's
    scene may still give is the tank of its shown tool.
    """
    mj = s.mj
    if s.shown.is_posted:
        s.energy.potential = s.shown.tank
        return
    if not s.loop.has_positions:
        refresh_inertia(s)
    follow_elastic(s)
    s.energy.potential = potential_energy(s)
    mj_energy_vel(mj.model, mj.data)
    s.energy.kinetic = floats(mj.energy, 2)[1]


@compiled
def take_scene_energies(energy: Part, scene: Part) -> None:
    """Takes storage and the works of the scene's own ports from another account of the scene."""
    energy.kinetic, energy.potential = scene.kinetic, scene.potential
    energy.actuator_work, energy.external_work = scene.actuator_work, scene.external_work


@compiled
def add_up_hands(states: NDArray[np.void]) -> None:
    """Gives every hand's account the scene's storage and ports, and what the other hands did.

        E_k = S_k − S_{k−1} − Σ_i (f_i·δx_i + τ_i·δφ_i) − W_actuators − W_external

    The first state meters the scene; i runs over all hands.
    """
    for i in range(states.size):
        energy = states[i].energy
        if i > 0:
            take_scene_energies(energy, states[0].energy)
        work = slack = throughput = 0.0
        for j in range(states.size):
            if j != i:
                other = states[j].energy
                work += other.coupling_work
                slack += other.slack
                throughput += other.throughput
        energy.others_work, energy.others_slack = work, slack
        energy.others_throughput = throughput


@compiled
def set_kinetic_energy(energy: Part, kinetic: float) -> None:
    """Replaces the kinetic energy by that of the velocity which a method balances."""
    energy.kinetic = kinetic


@compiled
def note_excess(energy: Part, has_excess: bool) -> None:
    """Notes whether the tick has created energy that is to be taken back."""
    energy.has_excess = has_excess


@compiled
def set_contact_springs_energy(energy: Part, potential: float) -> None:
    """Sets the storage of a tool without mass: its contact springs alone."""
    energy.kinetic, energy.potential = 0.0, potential


@compiled
def add_coupling_work(energy: Part, work: float) -> None:
    """Adds the work f·δx + τ·δφ on the tool, in J."""
    energy.coupling_work += work
    energy.throughput += abs(work)


def add_reset_work(energy: Part, work: float) -> None:
    """Adds the storage that a reset of the scene put in, in J, to the external port."""
    energy["external_work"] += work


def take_scene_works(energy: Part, scene: Part) -> None:
    """Takes the works of a slower scene's ports, of a step that a reset ended."""
    for name in ("actuator_work", "external_work"):
        energy[name] = scene[name]


@compiled
def meter_device(s: State, moved: Vector, turned: Vector, interval: float) -> None:
    """Adds the work on the device, and the least dissipation of its damper, b ‖δp‖²/t.

    Over a time t the damper dissipates ∫ b v² dt >= b ‖δp‖²/t, for every motion that ends δp away.
    Before the first tick and in a pause, the time that the device took to move is unknown; its
    dissipation then counts as zero.

    Args:
        s: The bound state with the previous wrench on the device.
        moved: δp in m since the previous tick.
        turned: Its rotation vector in rad.
        interval: t in s since the device's last new sample.
    """
    w, energy = s.loop.wrench_on_device, s.energy
    energy.device_energy += dot(vector_of(w), moved) + dot(vector_of(w[3:6]), turned)
    if s.loop.tick > s.guard.start_tick:
        energy.device_dissipation += s.run.device_damping / interval * dot(moved, moved)
        energy.device_dissipation += (
            s.run.device_rotational_damping / interval * dot(turned, turned)
        )


@compiled
def add_slack(energy: Part, slack: tuple[float, float]) -> None:
    """Adds the slack in J of the tick, of the two springs of a coupling (``law.slack_of_step``)."""
    energy.slack += slack[0]
    energy.slack += slack[1]


@compiled
def created_energy(energy: Part) -> float:
    """Returns Σ E_k in J, by the storage and the works so far."""
    stored = (energy.kinetic + energy.potential) - energy.start_energy
    created = stored - energy.coupling_work - energy.actuator_work - energy.external_work
    return float(created - energy.others_work)


@compiled
def allowed_energy(energy: Part) -> float:
    """Returns the Σ E_k in J up to which an environment is strict."""
    return float(ENERGY_TOLERANCE * (1.0 + energy.throughput + energy.others_throughput))


@compiled
def judge_balance(s: State) -> bool:
    """Compares the created energy with zero, with the slack, and at the device.

    The slack of the tick is added before.

    The works and the slack are those of all hands, so every hand's account judges one environment.
    """
    energy = s.energy
    stored = (energy.kinetic + energy.potential) - energy.start_energy
    created = created_energy(energy)
    # work that the hand still owes is not created; another program's is in its tank
    if s.run.scheme == Scheme.SHOWN and not s.shown.is_posted:
        created -= max(s.shown.scene_work - energy.coupling_work, 0.0)
    energy.environment_energy = created
    energy.is_constrained = 0
    allowed = allowed_energy(energy)
    if s.run.watches_device:
        _judge_device(s, stored, allowed)
    _judge_environment(s, created + s.impact.taken, allowed)
    return math.isfinite(created)


@compiled
def _judge_environment(s: State, created: float, allowed: float) -> None:
    """Notes the first energy created, the first beyond the slack, and the largest share of it."""
    energy = s.energy
    if created > allowed:
        if energy.first_unstrict < 0:
            energy.first_unstrict = s.loop.tick
        slack = energy.slack + energy.others_slack
        energy.slack_share = max(energy.slack_share, created / (slack + allowed))
        if created > slack + allowed and energy.first_active < 0:
            energy.first_active = s.loop.tick


@compiled
def _judge_device(s: State, stored: float, allowed: float) -> None:
    """Notes the first energy sent to the device beyond its dissipation and the scene's release.

    Without a coupling law (a weld, a tool without mass) the device can receive too much energy even
    if (14) holds.
    """
    energy = s.energy
    ratio = s.run.force_scale / s.run.scale
    gained = ratio * (stored - energy.actuator_work - energy.external_work)
    excess = energy.device_energy - energy.device_dissipation + gained
    excess -= s.observer.hidden_energy
    if energy.first_device_excess < 0 and excess > allowed:
        energy.first_device_excess = s.loop.tick
