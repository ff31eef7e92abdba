"""Margins from which geoms and limits take part in a step, which follow their speed.

A rigid contact only has to be known before it closes (``kernel.rigid_contact``).
"""

from __future__ import annotations

import mujoco

from hapticbridge.kernel.codes import State
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.mujoco_c import floats, ints
from hapticbridge.kernel.pose import Vector, add, cross, norm, subtract, vector_of
from hapticbridge.kernel.rigid_contact import MARGIN, RESULTS_AHEAD

_BALL = int(mujoco.mjtJoint.mjJNT_BALL)


@compiled
def follow_speed(s: State) -> None:
    """Widens each geom's margin for the next collisions by the way that it goes in a step.

    The way is t (|v| + |ω| r), with the velocity v of the geom's centre and the radius r of its
    bounding sphere, at most ``largest_margin``. t is the time step, or ``RESULTS_AHEAD`` periods of
    a scene beside the loop. There the speed of the handle is added to that of the tool, which may
    reach it within a step. Positions are those at the start of the last step. Limits of joints and
    tendons follow their speeds.
    """
    contact, mj, ahead = s.contact, s.mj, s.contact.ahead
    widest = contact.largest_margin
    _move_bodies(s)
    velocities, centres = floats(contact.body_velocity, 6 * mj.nbody), contact.geom_xpos
    bodies, roots = ints(mj.geom_bodyid, mj.ngeom), ints(contact.body_rootid, mj.nbody)
    margins, at_rest = (
        floats(contact.geom_margin, mj.ngeom),
        floats(contact.own_geom_margin, mj.ngeom),
    )
    radii = floats(contact.geom_rbound, mj.ngeom)
    for geom in ints(contact.moving_geoms, contact.moving_count):
        body = bodies[geom]
        centre = vector_of(floats(centres + 24 * geom, 3))
        origin = vector_of(floats(contact.subtree_com + 24 * roots[body], 3))
        turn = vector_of(velocities[6 * body : 6 * body + 3])
        velocity = vector_of(velocities[6 * body + 3 : 6 * body + 6])
        velocity = add(velocity, cross(turn, subtract(centre, origin)))
        way = ahead * (norm(velocity) + radii[geom] * norm(turn)) + contact.flight
        if contact.leads and ints(mj.geom_is_tool, mj.ngeom)[geom]:
            way += RESULTS_AHEAD * _handle_way(s, centre, radii[geom])
        margins[geom] = at_rest[geom] + (way if way < widest else widest)
    for pair in range(contact.pair_count):
        way = 0.0
        for geoms in (contact.pair_geom1, contact.pair_geom2):
            geom = ints(geoms + 4 * pair, 1)[0]
            way += margins[geom] - at_rest[geom]
        at_rest_here = floats(contact.own_pair_margin + 8 * pair, 1)[0]
        floats(contact.pair_margin + 8 * pair, 1)[0] = at_rest_here + way
    if contact.row_capacity > 0:
        _follow_limits(s)


@compiled
def _handle_way(s: State, centre: Vector, radius: float) -> float:
    """Returns the way in m by which the handle's motion of this tick would move a geom."""
    turn = vector_of(s.pose.handle_turn)
    arm = subtract(centre, vector_of(s.pose.tool_position))
    return norm(add(vector_of(s.pose.handle_step), cross(turn, arm))) + radius * norm(turn)


@compiled
def _follow_limits(s: State) -> None:
    """Widens the margins of limits by ``MARGIN``, in m or rad, and the way of two steps.

    In the first of these steps a lossless tool learns that it is near. A leash, a spatial tendon of
    no least length, may pass through zero: its lower limit stays out of the step.
    """
    contact, mj, ahead = s.contact, s.mj, 2.0 * s.run.timestep
    kinds, first = ints(contact.jnt_type, mj.njnt), ints(contact.jnt_dofadr, mj.njnt)
    speeds = floats(mj.qvel, mj.nv)
    margins, own = floats(contact.jnt_margin, mj.njnt), floats(contact.own_jnt_margin, mj.njnt)
    for joint in range(mj.njnt):
        dof = first[joint]
        speed = abs(speeds[dof])
        if kinds[joint] == _BALL:
            speed = norm(vector_of(speeds[dof : dof + 3]))
        margins[joint] = own[joint] + MARGIN + (ahead * speed + contact.flight)
    margins = floats(contact.tendon_margin, mj.ntendon)
    own = floats(contact.own_tendon_margin, mj.ntendon)
    speeds = floats(contact.ten_velocity, mj.ntendon)
    lengths, leashes = floats(mj.ten_length, mj.ntendon), ints(contact.leashes, mj.ntendon)
    for tendon in range(mj.ntendon):
        way = ahead * abs(speeds[tendon]) + contact.flight
        wide = MARGIN + way
        if leashes[tendon]:
            wide = min(wide, max(lengths[tendon] - way, 0.0))
        margins[tendon] = own[tendon] + wide


@compiled
def _move_bodies(s: State) -> None:
    """Computes the bodies' velocities from those of the joints, as MuJoCo's ``cvel``."""
    contact, mj = s.contact, s.mj
    parents = ints(contact.body_parentid, mj.nbody)
    first, number = ints(contact.body_dofadr, mj.nbody), ints(contact.body_dofnum, mj.nbody)
    axes, speeds = floats(contact.cdof, 6 * mj.nv), floats(mj.qvel, mj.nv)
    velocities = floats(contact.body_velocity, 6 * mj.nbody)
    for body in range(1, mj.nbody):
        for i in range(6):
            velocities[6 * body + i] = velocities[6 * parents[body] + i]
        for dof in range(first[body], first[body] + number[body]):
            for i in range(6):
                velocities[6 * body + i] += axes[6 * dof + i] * speeds[dof]
