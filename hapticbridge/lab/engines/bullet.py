"""Bullet through PyBullet, with each of its two kinds of contact solver.

References:
    PyBullet Quickstart Guide, https://pybullet.org
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.metadata import version
from typing import Any

import pybullet

from hapticbridge.errors import StudyError
from hapticbridge.kernel.pose import Quaternion, Vector
from hapticbridge.lab.engines import base

SLOP = 1e-7
"""Depth in m that a contact keeps under sequential impulses. A settled tool is wrong by Bullet's
own 1e-5 m. At 0 its contacts come and go, and some poses chatter by 5 to 16 µm."""

ERP = 0.2
"""Share of a penetration that a step corrects, without unit: Bullet's own for joints. At 0.8 a
settled tool chatters."""

ITERATIONS = 200
"""Largest number of iterations of sequential impulses. Bullet's own 50 are too few for the twelve
contacts of a peg that lies flat in its hole."""

RESIDUAL = 1e-7
"""Change of velocity in m/s below which the iterations end: Bullet's own, and the least in its
guide. A settled peg is wrong by 0.2 to 0.6 µm, worst where it lies on the bottom. At 1e-10 the
error is 0.07 to 0.3 µm, at 1.4 times the cost."""

CFM = 1e-8
"""Constraint force mixing of the direct solver. At 0 redundant contacts make its matrix singular
and a settled tool chatters by 40 µm. At 1e-6 the tool sinks by 0.03 µm."""

_GUIDE = "PyBullet Quickstart Guide"
_PARAMETERS = f"{_GUIDE}: setPhysicsEngineParameter"
_DYNAMICS = f"{_GUIDE}: changeDynamics"
_SHARED = {
    "coupling": base.Advised("held force", f"{_GUIDE}: applyExternalForce/Torque"),
    "body": base.Advised("multibody of one link", f"{_GUIDE}: createMultiBody"),
    "linearDamping, angularDamping": base.Advised("0 (default 0.04)", _DYNAMICS),
    "collisionMargin": base.Advised("0 for meshes", _DYNAMICS),
    "activationState": base.Advised("disable sleeping", _DYNAMICS),
    "deterministicOverlappingPairs": base.Advised("1", _PARAMETERS),
    "numSubSteps": base.Advised("0 (default)", _PARAMETERS),
}

_TYPES = {
    "box": pybullet.GEOM_BOX,
    "sphere": pybullet.GEOM_SPHERE,
    "capsule": pybullet.GEOM_CAPSULE,
}


class PybulletSimulation(base.Simulation):
    """A task in its own Bullet world."""

    def __init__(self, task: base.Task, timestep: float, parameters: Mapping[str, float]) -> None:
        super().__init__(task, timestep)
        for free in task.bodies:
            kinds = [shape.kind for shape in free.body.shapes]
            if "mesh" in kinds and len(kinds) > 1:
                raise StudyError(
                    f"task '{task.name}' has a body of a mesh and more, which is not given to "
                    "PyBullet"
                )
        self._client = client = pybullet.connect(pybullet.DIRECT)
        pybullet.setGravity(*task.gravity, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self._timestep,
            numSubSteps=0,
            deterministicOverlappingPairs=1,
            **parameters,
            physicsClientId=client,
        )
        self._bodies = [self._free(free, task) for free in task.bodies]
        self._body = self._bodies[0]
        for shape in task.fixed:
            fixed = pybullet.createMultiBody(
                baseMass=0,
                baseCollisionShapeIndex=self._collision([(shape, shape.pose)]),
                physicsClientId=client,
            )
            self._set_dynamics(fixed, task)
        pybullet.resetBaseVelocity(
            self._body,
            task.start_velocity.linear,
            task.start_velocity.angular,
            physicsClientId=client,
        )
        self._begin(task)

    def _free(self, free: base.FreeBody, task: base.Task) -> int:
        """Adds a free body and returns its number."""
        start = free.principal
        body: int = pybullet.createMultiBody(
            baseMass=free.body.mass,
            baseCollisionShapeIndex=self._collision(free.shapes),
            basePosition=start.position,
            baseOrientation=_xyzw(start.quaternion),
            physicsClientId=self._client,
        )
        self._set_dynamics(body, task, localInertiaDiagonal=free.body.inertia)
        return body

    def _set_dynamics(self, body: int, task: base.Task, **more: Any) -> None:
        """Removes Bullet's default damping of a body, and sets its friction."""
        shapes = [*task.fixed, *(shape for free in task.bodies for shape in free.body.shapes)]
        if any(shape.kind == "mesh" for shape in shapes):
            more["collisionMargin"] = 0.0
        pybullet.changeDynamics(
            body,
            -1,
            # Bullet multiplies the two bodies' coefficients
            lateralFriction=math.sqrt(task.body.friction),
            spinningFriction=0,
            rollingFriction=0,
            restitution=0,
            linearDamping=0,
            angularDamping=0,
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            **more,
            physicsClientId=self._client,
        )

    def _collision(self, placed: Sequence[tuple[base.Shape, base.Pose]]) -> int:
        """Makes one shape of several, and returns its number; −1 for an empty list."""
        if not placed:
            return -1
        shapes = [shape for shape, _ in placed]
        positions = [pose.position for _, pose in placed]
        orientations = [_xyzw(pose.quaternion) for _, pose in placed]
        made: int
        if shapes[0].vertices is not None:
            made = pybullet.createCollisionShape(
                pybullet.GEOM_MESH,
                vertices=shapes[0].vertices.tolist(),
                collisionFramePosition=positions[0],
                collisionFrameOrientation=orientations[0],
                physicsClientId=self._client,
            )
            return made
        made = pybullet.createCollisionShapeArray(
            shapeTypes=[_TYPES[shape.kind] for shape in shapes],
            halfExtents=[shape.size if shape.kind == "box" else (0, 0, 0) for shape in shapes],
            radii=[0 if shape.kind == "box" else shape.size[0] for shape in shapes],
            lengths=[2 * shape.size[1] if shape.kind == "capsule" else 0 for shape in shapes],
            collisionFramePositions=positions,
            collisionFrameOrientations=orientations,
            physicsClientId=self._client,
        )
        return made

    def advance(self, force: Vector, torque: Vector) -> None:
        """Sets a force in N and a torque in N m at the centre of mass, and steps."""
        client, body, world = self._client, self._body, pybullet.WORLD_FRAME
        at = pybullet.getBasePositionAndOrientation(body, client)[0]
        pybullet.applyExternalForce(body, -1, force, at, world, client)
        pybullet.applyExternalTorque(body, -1, torque, world, client)
        pybullet.stepSimulation(client)

    def principal_pose(self, body: int = 0) -> base.Pose:
        """Returns the pose of the principal axes of inertia at a body's centre of mass."""
        pose = pybullet.getBasePositionAndOrientation(self._bodies[body], self._client)
        position, (x, y, z, w) = pose
        return base.Pose(position, (w, x, y, z))

    def velocity(self, body: int = 0) -> base.Velocity:
        """Returns the velocity of a body's centre of mass and its angular velocity."""
        return base.Velocity(*pybullet.getBaseVelocity(self._bodies[body], self._client))

    def contacts(self) -> base.Contacts:
        """Returns the contacts of the last step, as they were at its start."""
        points = pybullet.getContactPoints(physicsClientId=self._client)
        # its distance, negative where deep
        return base.Contacts.from_depths(-point[8] for point in points)

    def close(self) -> None:
        """Ends the Bullet world."""
        if self._client >= 0:
            pybullet.disconnect(self._client)
            self._client = -1


def _xyzw(quaternion: Quaternion) -> Quaternion:
    w, x, y, z = quaternion
    return x, y, z, w


def engines() -> tuple[base.Engine, ...]:
    """Returns the engines of this module."""
    impulses = {
        "numSolverIterations": ITERATIONS,
        "solverResidualThreshold": RESIDUAL,
        "contactSlop": SLOP,
        "contactERP": ERP,
        "constraintSolverType": pybullet.CONSTRAINT_SOLVER_LCP_SI,
    }
    direct = {
        "contactSlop": 0.0,
        "contactERP": ERP,
        "globalCFM": CFM,
        "constraintSolverType": pybullet.CONSTRAINT_SOLVER_LCP_DANTZIG,
    }
    return tuple(
        base.Engine(
            name,
            version("pybullet"),
            {
                **_SHARED,
                **{key: base.Advised(f"{value:g}", _PARAMETERS) for key, value in chosen.items()},
                "constraintSolverType": base.Advised(solver, _PARAMETERS),
            },
            partial(PybulletSimulation, parameters=chosen),
        )
        for name, chosen, solver in (
            ("pybullet", impulses, "sequential impulses (default)"),
            ("pybullet_dantzig", direct, "Dantzig, direct (marked experimental)"),
        )
    )
