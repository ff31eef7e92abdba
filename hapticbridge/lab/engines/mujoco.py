"""MuJoCo as a peer engine: the coupling is a held force, as in every other engine here.

References:
    MuJoCo documentation, https://mujoco.readthedocs.io
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco

from hapticbridge.kernel.pose import Vector, add, conjugate, cross, rotated, subtract
from hapticbridge.lab.engines import base

_MODELING = "MuJoCo documentation, Modeling: Solver parameters"
_OVERVIEW = "MuJoCo documentation, Computation: Numerical integration"
_REFERENCE = "MuJoCo documentation, XML Reference: option"

_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}

STIFFNESS_TIME = 2.0
"""Time constant of a contact in timesteps: the smallest that MuJoCo documents as stable.
Penetration grows with its square."""

IMPEDANCE = (0.95, 0.99, 0.001, 0.5, 2.0)
"""Impedance ``solimp`` of a contact. A settled peg is wrong by 3 to 10 µm, with MuJoCo's own 0.9
and 0.95 by 5 to 20 µm, with 0.99 and 0.999 by 0.5 to 2 µm. With the last pair it then chatters in
two of six poses by 10 to 40 µm."""


TOOL = 1
"""Number of the tool in MuJoCo, whose body 0 is the world."""


SETTINGS: Mapping[str, base.Advised] = {
    "coupling": base.Advised(
        "held force, xfrc_applied", "MuJoCo documentation, Computation: State"
    ),
    "integrator": base.Advised("implicitfast", _OVERVIEW),
    "cone": base.Advised("elliptic", _REFERENCE),
    "solver": base.Advised("Newton, tolerance 1e-10", _REFERENCE),
    "diagexact": base.Advised("enable", _REFERENCE),
    "solref": base.Advised("2 timesteps, damping ratio 1", _MODELING),
    "solimp": base.Advised("0.95 0.99 0.001 0.5 2", _MODELING),
}
"""Settings: ``implicitfast``, the elliptic cone, and contacts as stiff as MuJoCo advises."""


class MujocoSimulation(base.Simulation):
    """A task in MuJoCo."""

    def __init__(self, task: base.Task, timestep: float) -> None:
        super().__init__(task, timestep)
        self._spec = spec = mujoco.MjSpec()
        option = spec.option
        option.timestep = self._timestep
        option.gravity = task.gravity
        option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        option.tolerance = 1e-10
        option.enableflags |= mujoco.mjtEnableBit.mjENBL_DIAGEXACT
        for free in task.bodies:
            frame = free.body.inertia_frame
            body = spec.worldbody.add_body(
                mass=free.body.mass,
                inertia=free.body.inertia,
                ipos=frame.position,
                iquat=frame.quaternion,
                explicitinertial=True,
            )
            body.add_freejoint()
            for shape in free.body.shapes:
                self._add(body, shape, task.body.friction)
        for shape in task.fixed:
            self._add(spec.worldbody, shape, task.body.friction)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        # views, read and written every step, with a row for each body
        self._applied = self._data.xfrc_applied[TOOL]
        self._position = self._data.qpos.reshape(-1, 7)
        self._velocity = self._data.qvel.reshape(-1, 6)
        for row, free in zip(self._position, task.bodies, strict=True):
            row[:3], row[3:] = free.start.position, free.start.quaternion
        spin = task.start_velocity.angular
        lever = rotated(task.start.quaternion, self._centre)
        self._velocity[0, :3] = subtract(task.start_velocity.linear, cross(spin, lever))
        self._velocity[0, 3:] = rotated(conjugate(task.start.quaternion), spin)
        self._begin(task)

    def _add(self, body: mujoco.MjsBody, shape: base.Shape, friction: float) -> None:
        """Adds a geom; MuJoCo lets geoms of one body, and fixed ones, never touch each other."""
        geom = body.add_geom(
            type=_TYPES[shape.kind], pos=shape.position, quat=shape.quaternion, mass=0
        )
        geom.condim = 3 if friction > 0 else 1
        geom.friction = (friction, 0, 0)
        geom.solref = (STIFFNESS_TIME * self._timestep, 1)
        geom.solimp = IMPEDANCE
        if shape.vertices is None:
            geom.size = (*shape.size, *(0,) * (3 - len(shape.size)))
        else:
            mesh = self._spec.add_mesh(uservert=shape.vertices.ravel())
            mesh.name = geom.meshname = f"mesh_{len(self._spec.meshes)}"

    def advance(self, force: Vector, torque: Vector) -> None:
        """Sets a force in N and a torque in N m at the centre of mass, and steps."""
        self._applied[:] = (*force, *torque)
        mujoco.mj_step(self._model, self._data)

    def pose(self, body: int = 0) -> base.Pose:
        """Returns the pose of a body's frame."""
        x, y, z, w, i, j, k = self._position[body].tolist()
        return base.Pose((x, y, z), (w, i, j, k))

    def principal_pose(self, body: int = 0) -> base.Pose:
        """Returns the pose of the principal axes of inertia at a body's centre of mass."""
        return base.composed(self.pose(body), self._frames[body])

    def velocity(self, body: int = 0) -> base.Velocity:
        """Returns the velocity of a body's centre of mass and its angular velocity."""
        quaternion = self.pose(body).quaternion
        vx, vy, vz, wx, wy, wz = self._velocity[body].tolist()
        spin = rotated(quaternion, (wx, wy, wz))
        lever = rotated(quaternion, self._frames[body].position)
        return base.Velocity(add((vx, vy, vz), cross(spin, lever)), spin)

    def contacts(self) -> base.Contacts:
        """Returns the contacts of the last step."""
        distances = self._data.contact.dist
        return base.Contacts.from_depths(-float(distance) for distance in distances)

    def close(self) -> None:
        """Does nothing: MuJoCo holds no resources."""


def engines() -> tuple[base.Engine, ...]:
    """Returns the engines of this module."""
    return (base.Engine("mujoco", mujoco.__version__, SETTINGS, MujocoSimulation),)
