"""Rapier through its own Python bindings, in single precision; the coupling is a held force.

References:
    Rapier User Guide, https://rapier.rs/docs/user_guides/rust
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import rapier3d

from hapticbridge.kernel.pose import Vector
from hapticbridge.lab.engines import base

LENGTH = 1e-3
"""``length_unit`` in m, of which the allowed depth and the distance of prediction are shares. The
guide advises the size of most parts. At 10 mm a settled peg is wrong by 12 to 20 µm, at 1 mm by 4
µm, at 0.1 mm its contacts come too late and it is wrong by 85 µm."""

ALLOWED = 1e-5
"""Allowed depth as a share of ``LENGTH``, without unit. Rapier's own is 0.005."""

STIFFNESS = 0.5
"""Natural frequency of a contact times the timestep, without unit; 0 leaves Rapier's own 30 Hz,
under which a pushed tool sinks in by its force over m (2π 30 Hz)². A quarter makes a settled peg's
error four times as large."""

ITERATIONS = 8
"""Iterations of the solver; Rapier's own are 4. Twenty give the same settled peg at 1.7 times the
cost."""

FASTEST = 400.0
"""Largest speed of a body in m/s, Rapier's own at its own length unit. As a share of a smaller unit
it would be 0.4 m/s."""

_GUIDE = "Rapier User Guide"
_PARAMETERS = f"{_GUIDE}: Integration parameters"


SETTINGS: Mapping[str, base.Advised] = {
    "coupling": base.Advised("held force", f"{_GUIDE}: Rigid-bodies, Forces and impulses"),
    "length unit": base.Advised(
        f"{LENGTH:g} m (default 1)", f"{_PARAMETERS}, which advises the size of most parts"
    ),
    "allowed linear error": base.Advised(f"{ALLOWED:g} of the unit", _PARAMETERS),
    "contact softness": base.Advised(
        f"{STIFFNESS:g} of the step's rate, damping ratio 10 (default 30 Hz)", _PARAMETERS
    ),
    "solver iterations": base.Advised(f"{ITERATIONS} (default 4)", _PARAMETERS),
    "friction model": base.Advised("simplified (default)", _PARAMETERS),
    "sleep": base.Advised("off", f"{_GUIDE}: Rigid-bodies, Sleeping"),
}
"""Settings of Rapier's default pipeline. Its solver divides a step into as many parts as it has
iterations, under one held force. Of its models of friction the default is exact for a sliding box,
"Coulomb" lets it slide with 0.85 of the friction."""


class RapierSimulation(base.Simulation):
    """A task in its own Rapier world."""

    def __init__(self, task: base.Task, timestep: float) -> None:
        super().__init__(task, timestep)
        world: Any = rapier3d.PhysicsWorld(gravity=task.gravity)
        self._world = world
        options = world.integration_parameters
        options.dt = self._timestep
        options.length_unit = LENGTH
        options.normalized_max_linear_velocity = FASTEST / LENGTH
        options.num_solver_iterations = ITERATIONS
        options.normalized_allowed_linear_error = ALLOWED
        if STIFFNESS:
            softness = rapier3d.SpringCoefficients(STIFFNESS / self._timestep, 10.0)
            options.contact_softness = options.static_contact_softness = softness
        self._bodies = [self._free(free) for free in task.bodies]
        self._body = tool = self._bodies[0]
        for shape in task.fixed:
            world.add_collider(_collider(shape, shape.pose, task.body.friction))
        tool.linvel = rapier3d.Vec3(*task.start_velocity.linear)
        tool.angvel = rapier3d.Vec3(*task.start_velocity.angular)
        self._begin(task)

    def _free(self, free: base.FreeBody) -> Any:
        """Adds a free body and returns it."""
        world, body = self._world, free.body
        made = rapier3d.RigidBody.dynamic().can_sleep(False).position(_isometry(free.principal))
        shapes = [_collider(shape, pose, body.friction) for shape, pose in free.shapes]
        added = world.rigid_bodies[world.add_body(made, shapes)]
        added.set_additional_mass_properties(
            rapier3d.MassProperties(
                rapier3d.Vec3(0.0, 0.0, 0.0),
                body.mass,
                rapier3d.Vec3(*body.inertia),
                rapier3d.Rotation3.identity(),
            )
        )
        added.recompute_mass_properties_from_colliders(world.colliders)
        return added

    def advance(self, force: Vector, torque: Vector) -> None:
        """Sets a force in N and a torque in N m at the centre of mass, and steps."""
        body = self._body
        body.reset_forces()
        body.reset_torques()
        body.add_force(force)
        body.add_torque(torque)
        self._world.step()

    def principal_pose(self, body: int = 0) -> base.Pose:
        """Returns the pose of the principal axes of inertia at a body's centre of mass."""
        place, turn = self._bodies[body].translation, self._bodies[body].rotation
        return base.Pose((place.x, place.y, place.z), (turn.w, turn.i, turn.j, turn.k))

    def velocity(self, body: int = 0) -> base.Velocity:
        """Returns the velocity of a body's centre of mass and its angular velocity."""
        linear, angular = self._bodies[body].linvel, self._bodies[body].angvel
        return base.Velocity((linear.x, linear.y, linear.z), (angular.x, angular.y, angular.z))

    def contacts(self) -> base.Contacts:
        """Returns the contacts of the last step, as they were at its start.

        A point that carries an impulse counts as touching.
        """
        return base.Contacts.from_depths(
            max(-point.dist, 0.0) if point.impulse else -point.dist
            for pair in self._world.narrow_phase.contact_pairs()
            for manifold in pair.manifolds
            for point in manifold.points
        )

    def close(self) -> None:
        """Releases the world with its last reference."""
        self._bodies = []
        self._body = self._world = None


def _isometry(pose: base.Pose) -> Any:
    return rapier3d.Isometry3(rapier3d.Vec3(*pose.position), rapier3d.Rotation3(*pose.quaternion))


def _collider(shape: base.Shape, pose: base.Pose, friction: float) -> Any:
    kinds = rapier3d.Collider
    if shape.vertices is not None:
        made = kinds.convex_hull([rapier3d.Vec3(*row) for row in shape.vertices.tolist()])
    elif shape.kind == "box":
        made = kinds.cuboid(*shape.size)
    elif shape.kind == "sphere":
        made = kinds.ball(shape.size[0])
    else:
        made = kinds.capsule_z(shape.size[1], shape.size[0])
    rule = rapier3d.CoefficientCombineRule.MAX
    made = made.density(0.0).friction(friction).friction_combine_rule(rule).restitution(0.0)
    return made.position(_isometry(pose))


def engines() -> tuple[base.Engine, ...]:
    """Returns the engines of this module."""
    return (base.Engine("rapier", version("rapier3d"), SETTINGS, RapierSimulation),)
