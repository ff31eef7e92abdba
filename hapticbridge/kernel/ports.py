"""Work that enters the environment in one MuJoCo step through ports other than the coupling.

MuJoCo's ``discrete`` step solves M (v⁺ − v)/h = f(q, v) − … in the positions and Jacobians of its
start, and moves by h v⁺. The work of a generalised force Q in that step is therefore h Q · v⁺, with
the Q that the step really used: for a stiff servo that is its force at the end of the step, not
``actuator_force``, which is the one at the start.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.native import (
    floats,
    ints,
    mj_apply_ft,
    mj_com_pos,
    mj_energy_pos,
    mj_fwd_kinematics,
    mj_make_constraint,
    pointer_at,
)
from hapticbridge.kernel.weld import EQUALITY
from hapticbridge.pose import add, cross, dot, rotation_between

# kinds of constraint rows (mjtConstraint) as plain integers: the compiler reads no enumeration
LIMIT_TENDON, CONTACT_PYRAMIDAL = 4, 6


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
            turn = rotation_between(
                (previous[p], previous[p + 1], previous[p + 2], previous[p + 3]),
                (quaternions[q], quaternions[q + 1], quaternions[q + 2], quaternions[q + 3]),
            )
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
def _mocap_work(state: NDArray[np.void]) -> float:
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
        turned = cross(
            (shift[d + 3], shift[d + 4], shift[d + 5]),
            (point[0] - positions[p], point[1] - positions[p + 1], point[2] - positions[p + 2]),
        )
        moved = add((shift[d], shift[d + 1], shift[d + 2]), turned)
        # the normal points from the first geom to the second
        change += (2.0 * side - 1.0) * dot((frame[0], frame[1], frame[2]), moved)
    if change == 0.0:
        return 0.0
    rows = 1
    if ints(pointer_at(s.efc_type), force.size)[row] == CONTACT_PYRAMIDAL:
        rows = 2 * (ints(contact + s.contact_dim, 1)[0] - 1)  # every edge carries the normal
    normal = 0.0
    for i in range(row, row + rows):
        normal += force[i]
    return normal * change


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
        s.external_work += _mocap_work(state)
        s.mocap_has_moved = 0
