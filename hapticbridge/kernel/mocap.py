"""Work of the scene's own mocap bodies, which somebody moves between two steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import CONTACT_PYRAMIDAL, EQUALITY, LIMIT_TENDON
from hapticbridge.kernel.native import (
    floats,
    ints,
    mj_com_pos,
    mj_energy_pos,
    mj_fwd_kinematics,
    mj_make_constraint,
    pointer_at,
)
from hapticbridge.pose import (
    add,
    cross,
    dot,
    quaternion_of,
    rotation_between,
    subtract,
    vector_of,
)


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
