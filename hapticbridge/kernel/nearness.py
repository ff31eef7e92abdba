"""Whether the tool touches something, is about to, or is at a joint's limit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.native import floats, ints, mj_com_vel, pointer_at
from hapticbridge.kernel.ports import LIMIT_TENDON
from hapticbridge.pose import add, cross, dot

LIMIT_JOINT = 3  # mjtConstraint as a plain integer: the compiler reads no enumeration

REACH = 5e-4
"""Distance in m from which contacts are looked at: how far a tool at 0.5 m/s comes in a tick of
1 ms. Less lets a fast tool touch before the change, more has MuJoCo list more contacts."""

CLOSE = 2e-5
"""Distance in m, at the next step's start, below which something is near. The next step has a
contact's force if that distance is below zero; 20 µm is for what a straight line misses of a turn
(½ ω² r T² at 20 rad/s and 0.1 m). More makes the tool implicit sooner and longer: calling all
within ``REACH`` near errs by 30 µm instead of 24 µm in tapping on a wall at 4 Hz. It also burns
more energy before a contact that creates some: a peg led into its hole then uses 0.9 % of the
slack, not 1.4 % (the implicit form alone 0.6 %)."""


@compiled
def _distance_ahead(state: NDArray[np.void], contact: int) -> float:
    """Returns how far a contact is from having a force when the next step starts, in m.

        d_k = d_{k−1} + h n·(v_2 − v_1)

    with d, the point and the normal n (from the first body to the second) as the step that just
    ended saw them, and the bodies' velocities there at u_k, with which it moved. Needs
    ``mj_com_vel``.
    """
    s = state[0]
    point, frame = floats(contact + s.contact_point, 3), floats(contact + s.contact_frame, 3)
    geoms = ints(contact + s.contact_geoms, 2)
    body_of, root_of = ints(s.geom_bodyid, s.ngeom), ints(s.body_rootid, s.nbody)
    away = 0.0
    for side in range(2):
        body = body_of[geoms[side]]
        spin, centre = floats(s.cvel + 48 * body, 6), floats(s.subtree_com + 24 * root_of[body], 3)
        arm = (point[0] - centre[0], point[1] - centre[1], point[2] - centre[2])
        velocity = add((spin[3], spin[4], spin[5]), cross((spin[0], spin[1], spin[2]), arm))
        away += (2.0 * side - 1.0) * dot((frame[0], frame[1], frame[2]), velocity)
    distance = floats(contact + s.contact_distance, 1)[0]
    return float(distance - floats(contact + s.contact_margin, 1)[0] + s.timestep * away)


@compiled
def is_near(state: NDArray[np.void]) -> bool:
    """Tells whether the tool touches something, will in the next step, or is at a joint's limit.

    Notes in ``is_held`` whether a constraint force acted on its tree. Must run before kinematics
    are refreshed: distances are those of the step's start.

    Contacts within ``REACH`` are there without a force, because the geoms' gap says so.
    """
    s = state[0]
    found = held = bool(s.is_never_free)
    s.active_contacts = 0
    contacts = pointer_at(s.contact)
    count = ints(s.ncon, 1)[0]
    if count > 0 and not found:
        mj_com_vel(s.model, s.data)
    for c in range(count):
        contact = contacts + s.contact_size * c
        is_active = ints(contact + s.contact_row, 1)[0] >= 0
        s.active_contacts += is_active
        geoms = ints(contact + s.contact_geoms, 2)
        is_flex = geoms[0] < 0 or geoms[1] < 0  # a flex is no geom
        in_tree = ints(s.geom_in_tree, s.ngeom)
        if is_flex or in_tree[geoms[0]] != 0 or in_tree[geoms[1]] != 0:
            held = held or is_active
            if not found:
                found = is_flex or is_active or _distance_ahead(state, contact) < CLOSE
    count = ints(s.nefc, 1)[0]
    kinds, ids = ints(pointer_at(s.efc_type), count), ints(pointer_at(s.efc_id), count)
    for row in range(count):
        is_joint = kinds[row] == LIMIT_JOINT and ints(s.joint_in_tree, s.njnt)[ids[row]] != 0
        if is_joint or kinds[row] == LIMIT_TENDON:
            found = held = True
    s.is_held = held
    return found
