"""The coupling's port: storage after a step, the work of the coupling, and what is allowed.

What the environment may have created until tick k is held against BC97 (14) and against the slack
that the coupling leaves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import CONTACT_PYRAMIDAL, EQUALITY, LIMIT_TENDON
from hapticbridge.kernel.mujoco_c import (
    floats,
    ints,
    mj_apply_ft,
    mj_com_pos,
    mj_energy_pos,
    mj_energy_vel,
    mj_fwd_kinematics,
    mj_kinematics,
    mj_make_constraint,
    mj_make_m,
    pointer_at,
)
from hapticbridge.pose import add, cross, dot, quaternion_of, rotation_between, subtract, vector_of

# Work of the scene's own mocap bodies, which somebody moves between two steps.


@compiled
def note_moved_mocap_bodies(state: NDArray[np.void]) -> None:
    """Before the step: finds the scene's mocap bodies that were moved, and their direct work.

    Moving one changes at once the potential energy of what hangs on it (springs, weights): that
    difference is work done by whoever moved it. What it does through contacts, limits and equality
    constraints is only known after the step (``meter_ports``).
    """
    s = state[0]
    s.mocap_has_moved = 0
    positions, quaternions = floats(s.mocap_pos, 3 * s.nmocap), floats(s.mocap_quat, 4 * s.nmocap)
    previous = floats(s.mocap_previous, 7 * s.nmocap)
    shift = floats(s.mocap_shift, 6 * s.nmocap)
    for m in range(s.nmocap):
        if m == s.handle_mocap_id:
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
            s.mocap_has_moved = 1
        else:
            for i in range(3, 6):
                shift[6 * m + i] = 0.0
    if s.mocap_has_moved:
        _keep_residuals(state)
        mj_fwd_kinematics(s.model, s.data)
        mj_com_pos(s.model, s.data)
        mj_energy_pos(s.model, s.data)
        s.external_work += floats(s.energy, 2)[0] - s.potential


@compiled
def _keep_residuals(state: NDArray[np.void]) -> None:
    """Keeps the residuals of equality constraints and tendon lengths as before the move."""
    s = state[0]
    s.equality_rows = 0
    if s.equality_capacity > 0:
        mj_make_constraint(s.model, s.data)  # positions are still those before the move
        s.equality_rows = min(ints(s.ne, 1)[0], s.equality_capacity)
        residuals = floats(pointer_at(s.efc_pos), s.equality_rows)
        floats(s.equality_before, s.equality_rows)[:] = residuals
    if s.ntendon > 0:
        floats(s.tendon_before, s.ntendon)[:] = floats(s.ten_length, s.ntendon)


@compiled
def mocap_work(state: NDArray[np.void]) -> float:
    """Work of moved mocap bodies through constraints: −Σ λ_i δr_i.

    λ_i is the force of a constraint row at the step that follows the move, as f_k goes with
    x_k − x_{k−1} in the coupling's port; δr_i is by how much the move changed its residual: an
    equality's error, a tendon's length, a contact's distance. Rows without a residual (friction,
    also that of contacts) take no work from the move: to MuJoCo a mocap body has no velocity, so it
    drags nothing along.

    For the same reason the damper of such a row acts against rest, not against the mocap body. A
    slow move is exact (a lift costs m g h), but a fast one through a weld or a contact lags, and
    what the row then gives to the scene beyond λ δr is counted as created: the environment may be
    called active, and rightly, because MuJoCo's constraint is.
    """
    s = state[0]
    force = floats(pointer_at(s.efc_force), ints(s.nefc, 1)[0])
    residual = floats(pointer_at(s.efc_pos), force.size)
    kinds, ids = ints(pointer_at(s.efc_type), force.size), ints(pointer_at(s.efc_id), force.size)
    work = 0.0
    if ints(s.ne, 1)[0] == s.equality_rows:
        before = floats(s.equality_before, s.equality_rows)
        for i in range(s.equality_rows):
            # the handle's weld is the coupling's port: its residual changes with the handle
            if not (kinds[i] == EQUALITY and ids[i] == s.weld_id):
                work -= force[i] * (residual[i] - before[i])
    if s.ntendon > 0:
        lengths, tendon_before = floats(s.ten_length, s.ntendon), floats(s.tendon_before, s.ntendon)
        ranges = floats(s.tendon_range, 2 * s.ntendon)
        for i in range(force.size):
            if kinds[i] == LIMIT_TENDON:
                t = ids[i]
                to_lower = abs(residual[i] - (lengths[t] - ranges[2 * t]))
                to_upper = abs(residual[i] - (ranges[2 * t + 1] - lengths[t]))
                sign = 1.0 if to_lower <= to_upper else -1.0
                work -= sign * force[i] * (lengths[t] - tendon_before[t])
    for c in range(ints(s.ncon, 1)[0]):
        work -= _contact_work(state, pointer_at(s.contact) + c * s.contact_size, force)
    return work


@compiled
def _contact_work(state: NDArray[np.void], contact: int, force: NDArray[np.float64]) -> float:
    """λ δr of one contact: its normal force times the change of distance by the move."""
    s = state[0]
    row = ints(contact + s.contact_row, 1)[0]
    geoms = ints(contact + s.contact_geoms, 2)
    if row < 0 or geoms[0] < 0 or geoms[1] < 0:
        return 0.0
    point, frame = floats(contact + s.contact_point, 3), floats(contact + s.contact_frame, 3)
    body_of, mocap_of = ints(s.geom_bodyid, s.ngeom), ints(s.body_mocap, s.nbody)
    positions, shift = floats(s.mocap_pos, 3 * s.nmocap), floats(s.mocap_shift, 6 * s.nmocap)
    change = 0.0
    for side in range(2):
        m = mocap_of[body_of[geoms[side]]]
        if m < 0 or m == s.handle_mocap_id:
            continue
        p, d = 3 * m, 6 * m
        arm = subtract(vector_of(point), vector_of(positions[p:]))
        moved = add(vector_of(shift[d:]), cross(vector_of(shift[d + 3 :]), arm))
        # the normal points from the first geom to the second
        change += (2.0 * side - 1.0) * dot(vector_of(frame), moved)
    if change == 0.0:
        return 0.0
    rows = 1
    if ints(pointer_at(s.efc_type), force.size)[row] == CONTACT_PYRAMIDAL:
        rows = 2 * (ints(contact + s.contact_dim, 1)[0] - 1)  # every edge carries the normal
    normal = 0.0
    for i in range(row, row + rows):
        normal += force[i]
    return normal * change


# Work that enters the environment in one MuJoCo step through ports other than the coupling.
#
# MuJoCo's ``discrete`` step solves M (v⁺ − v)/h = f(q, v) − … in the positions and Jacobians of
# its start, and moves by h v⁺. The work of a generalised force Q in that step is therefore h Q ·
# v⁺, with the Q that the step really used: for a stiff servo that is its force at the end of the
# step, not ``actuator_force``, which is the one at the start.


@compiled
def moment_dot(state: NDArray[np.void], output: int, vector_address: int) -> float:
    """Returns one row of the actuator moment times a vector over the degrees of freedom."""
    s = state[0]
    nnz = ints(s.moment_rownnz, output + 1)[output]
    adr = ints(s.moment_rowadr, output + 1)[output]
    columns = ints(s.moment_colind, adr + nnz)
    moment = floats(s.actuator_moment, adr + nnz)
    vector = floats(vector_address, s.nv)
    total = 0.0
    for i in range(adr, adr + nnz):
        total += moment[i] * vector[columns[i]]
    return total


@compiled
def _actuator_work(state: NDArray[np.void]) -> float:
    """Work of the scene's own actuators: h Σ (F − k h m·v − (h²k_p + h k_v) m·a) m·v⁺.

    F is the force at the start, m the moment, a = (v⁺ − v)/h. The two corrections take F to the
    end of the step; MuJoCo keeps them in ``efm_ak`` = h k_p and ``efm_as`` = h² k_p + h k_v for the
    actuators in its effective metric. ``qfrc_actuator`` is used for the sum because it has the
    limits of joints applied; the coupling's share is taken out again.
    """
    s = state[0]
    h = s.timestep
    qvel, force = floats(s.qvel, s.nv), floats(s.qfrc_actuator, s.nv)
    power = 0.0
    for i in range(s.nv):
        power += force[i] * qvel[i]
    first = s.coupling_output_adr
    forces = floats(s.actuator_force, first + 6)
    for output in range(first, first + 6):
        power -= forces[output] * moment_dot(state, output, s.qvel)
    count = ints(s.nefmA, 1)[0]
    if count > 0:
        ids = ints(pointer_at(s.efm_aid), count)
        scales = floats(pointer_at(s.efm_as), count)
        stiffnesses = floats(pointer_at(s.efm_ak), count)
        for k in range(count):
            actuator = ids[k]
            if s.coupling_actuator_id <= actuator < s.coupling_actuator_id + 6:
                continue
            adr = ints(s.outadr, actuator + 1)[actuator]
            num = ints(s.outnum, actuator + 1)[actuator]
            for output in range(adr, adr + num):
                end = moment_dot(state, output, s.qvel)
                change = moment_dot(state, output, s.qacc)
                power -= (stiffnesses[k] * (end - h * change) + scales[k] * change) * end
    return float(h * power)


@compiled
def add_body_wrenches(state: NDArray[np.void], result: int, clears: bool = False) -> bool:
    """Adds ``xfrc_applied``, as generalised forces at the positions as they are, to an address.

    Args:
        state: The bound state.
        result: Address of a number per degree of freedom.
        clears: Whether to clear these first, where a body is loaded.

    Returns:
        Whether a body is loaded; else nothing was written.
    """
    s = state[0]
    wrenches = floats(s.xfrc_applied, 6 * s.nbody)
    found = False
    for body in range(1, s.nbody):
        is_loaded = False
        for i in range(6 * body, 6 * body + 6):
            is_loaded = is_loaded or wrenches[i] != 0.0
        if is_loaded:
            if clears and not found:
                floats(result, s.nv)[:] = 0.0
            found = True
            force = s.xfrc_applied + 48 * body
            mj_apply_ft(
                s.model, s.data, force, force + 24, s.xipos + 24 * body, np.int32(body), result
            )
    return found


@compiled
def _applied_work(state: NDArray[np.void]) -> float:
    """Work of ``qfrc_applied``, ``xfrc_applied`` and passive gravity compensation."""
    s = state[0]
    nv = s.nv
    qvel, applied = floats(s.qvel, nv), floats(s.qfrc_applied, nv)
    power = 0.0
    for i in range(nv):
        power += applied[i] * qvel[i]
    if s.has_gravity_compensation:
        compensation, is_passive = (
            floats(s.qfrc_gravcomp, nv),
            floats(s.passive_gravcomp_dofs, nv),
        )
        for i in range(nv):
            power += compensation[i] * is_passive[i] * qvel[i]
    # positions are still those of the step's start, where MuJoCo applied the wrenches
    if add_body_wrenches(state, s.scratch, clears=True):
        generalised = floats(s.scratch, nv)
        for i in range(nv):
            power += generalised[i] * qvel[i]
    return float(s.timestep * power)


@compiled
def meter_ports(state: NDArray[np.void]) -> None:
    """Adds the work of the step that just ended to the actuator and the external port.

    Must run before kinematics are refreshed: moments, Jacobians and points of attack are those of
    the step's start, as the step used them.
    """
    s = state[0]
    if s.has_actuators:
        s.actuator_work += _actuator_work(state)
    s.external_work += _applied_work(state)
    if s.mocap_has_moved:
        s.external_work += mocap_work(state)
        s.mocap_has_moved = 0


ENERGY_TOLERANCE = 1e-9
"""An environment is strict while Σ E_k <= 1e-9 J + 1e-9 Σ|f·δx|: rounding of a sum of many small
works, not physics. Larger hides real creation, smaller reports rounding."""


@compiled
def refresh_poses(state: NDArray[np.void]) -> None:
    """Brings the bodies' poses to the state after the step (``mj_step`` leaves those before)."""
    s = state[0]
    mj_kinematics(s.model, s.data)


@compiled
def refresh_energies(state: NDArray[np.void]) -> None:
    """Brings the energies to the state after the step.

    Kinetic energy needs the inertia matrix, potential energy the positions and, where there are
    any, tendon lengths. Where MuJoCo's position stage has run since the step, all that is there.
    """
    s = state[0]
    if not s.has_positions:
        if s.has_tendons_or_flexes:
            mj_fwd_kinematics(s.model, s.data)
        else:
            mj_com_pos(s.model, s.data)
        mj_make_m(s.model, s.data)
    mj_energy_pos(s.model, s.data)
    mj_energy_vel(s.model, s.data)
    energy = floats(s.energy, 2)
    s.potential, s.kinetic = energy[0], energy[1]


@compiled
def add_coupling_work(state: NDArray[np.void], work: float) -> None:
    """Adds f·δx + τ·δφ to the coupling's port, for as long as that wrench acted."""
    s = state[0]
    s.coupling_work += work
    s.throughput += abs(work)


@compiled
def judge_environment(state: NDArray[np.void]) -> None:
    """Closes the tick's balance and holds the environment against (14) and the slack.

    E_k = S_k − S_{k−1} − (f_k·δx_k + τ_k·δφ_k) − actuators − external
    slack_k = Σ ½ g ‖δx_k‖² + ½ g_r ‖δφ_k‖²

    with the gains of ``RunParameters.slack_gains``: K + B/T and K_r + B_r/T with one law a tick.

    Where there is no coupling law (a weld, a tool without mass), the environment may satisfy (14)
    and the device still be kicked: there, what it was given is held against what its damping burns,
    b ‖δp_k‖² over the time between two samples at least, and against what the scene gave up.
    """
    s = state[0]
    moved, turned = vector_of(s.motion), vector_of(s.motion[3:6])
    s.slack += 0.5 * s.slack_stiffness * dot(moved, moved)
    s.slack += 0.5 * s.slack_rotational_stiffness * dot(turned, turned)
    stored = (s.kinetic + s.potential) - s.start_energy
    s.environment_energy = stored - s.coupling_work - s.actuator_work - s.external_work
    allowed = ENERGY_TOLERANCE * (1.0 + s.throughput)
    if s.watches_device:
        # what left the scene towards the device must come from the scene, or be burnt there
        gained = (s.force_scale / s.scale) * (stored - s.actuator_work - s.external_work)
        if s.first_kick < 0 and s.device_energy - s.device_burnt + gained > allowed:
            s.first_kick = s.tick
    if s.environment_energy > allowed:
        if s.first_unstrict < 0:
            s.first_unstrict = s.tick
        s.slack_share = max(s.slack_share, s.environment_energy / (s.slack + allowed))
        if s.environment_energy > s.slack + allowed and s.first_active < 0:
            s.first_active = s.tick
