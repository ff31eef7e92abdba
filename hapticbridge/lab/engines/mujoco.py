"""MuJoCo as a peer engine: the coupling is a held force, as in every other engine here.

References:
    MuJoCo documentation, https://mujoco.readthedocs.io
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco

from hapticbridge.lab.engines import base
from hapticbridge.lab.engines.from_scene import HeldSimulation
from hapticbridge.pose import Vector, add, conjugate, cross, rotated, subtract

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


class MujocoEngine:
    """MuJoCo with ``implicitfast``, its elliptic cone and contacts as stiff as it advises."""

    name = "mujoco"
    version = mujoco.__version__
    settings: Mapping[str, base.Setting] = {
        "coupling": base.Setting(
            "held force, xfrc_applied", "MuJoCo documentation, Computation: State"
        ),
        "integrator": base.Setting("implicitfast", _OVERVIEW),
        "cone": base.Setting("elliptic", _REFERENCE),
        "solver": base.Setting("Newton, tolerance 1e-10", _REFERENCE),
        "diagexact": base.Setting("enable", _REFERENCE),
        "solref": base.Setting("2 timesteps, damping ratio 1", _MODELING),
        "solimp": base.Setting("0.95 0.99 0.001 0.5 2", _MODELING),
    }

    def open(self, task: base.Task, timestep: float) -> MujocoSimulation:
        """Opens a task; see ``Engine.open``."""
        return MujocoSimulation(task, timestep)


class MujocoSimulation(HeldSimulation):
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
        frame = self._principal_in_body
        tool = spec.worldbody.add_body(
            name="tool",
            mass=task.body.mass,
            inertia=task.body.inertia,
            ipos=frame.position,
            iquat=frame.quaternion,
            explicitinertial=True,
        )
        tool.add_freejoint()
        for shape in task.body.shapes:
            self._add(tool, shape, task.body.friction, 1, 2)
        for shape in task.fixed:
            self._add(spec.worldbody, shape, task.body.friction, 2, 1)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        # views, read and written every step
        self._body = self._model.body("tool").id
        self._applied = self._data.xfrc_applied[self._body]
        self._position, self._velocity = self._data.qpos, self._data.qvel
        self._position[:3], self._position[3:] = task.start.position, task.start.quaternion
        spin = task.start_velocity.angular
        lever = rotated(task.start.quaternion, self._centre)
        self._velocity[:3] = subtract(task.start_velocity.linear, cross(spin, lever))
        self._velocity[3:] = rotated(conjugate(task.start.quaternion), spin)
        self._begin(task)

    def _add(
        self, body: mujoco.MjsBody, shape: base.Shape, friction: float, own: int, other: int
    ) -> None:
        """Adds a geom that touches only geoms of the other side."""
        geom = body.add_geom(
            type=_TYPES[shape.kind], pos=shape.position, quat=shape.quaternion, mass=0
        )
        geom.contype, geom.conaffinity = own, other
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

    def pose(self) -> base.Pose:
        """Returns the pose of the body's frame."""
        x, y, z, w, i, j, k = self._position.tolist()
        return base.Pose((x, y, z), (w, i, j, k))

    def principal_pose(self) -> base.Pose:
        """Returns the pose of the principal axes of inertia at the centre of mass."""
        return self._principal(self.pose())

    def velocity(self) -> base.Velocity:
        """Returns the velocity of the centre of mass and the angular velocity."""
        quaternion = self.pose().quaternion
        vx, vy, vz, wx, wy, wz = self._velocity.tolist()
        spin = rotated(quaternion, (wx, wy, wz))
        return base.Velocity(
            add((vx, vy, vz), cross(spin, rotated(quaternion, self._centre))), spin
        )

    def contacts(self) -> base.Contacts:
        """Returns the contacts of the last step."""
        distances = self._data.contact.dist
        return base.Contacts.from_depths(-float(distance) for distance in distances)

    def close(self) -> None:
        """Does nothing: MuJoCo holds no resources."""


def engines() -> tuple[base.Engine, ...]:
    """Returns the engines of this module."""
    return (MujocoEngine(),)
