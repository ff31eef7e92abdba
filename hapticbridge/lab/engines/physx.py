"""PhysX 5 on the processor, through SAPIEN, in single precision: held force, or its own spring.

References:
    PhysX 5 User's Guide and API, https://nvidia-omniverse.github.io/PhysX/physx/5.4.1
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from typing import Any

import numpy as np

from hapticbridge.kernel.pose import (
    ZERO_VECTOR,
    Quaternion,
    Vector,
    product,
    rotation_between,
    scaled,
    subtract,
)
from hapticbridge.lab.engines import base

with warnings.catch_warnings():
    # that no graphics card was found, which nothing here draws on
    warnings.simplefilter("ignore")
    import sapien
    from sapien import physx


POSITION_ITERATIONS = 20
"""Iterations of the solver. At PhysX's own 4 a settled tool is wrong by 0.1 µm more; 50 change
nothing."""

CONTACT_OFFSET = 1e-3
"""Distance in m at which contacts are made. It covers the motion of some steps and is small against
the parts."""

LENGTH, SPEED = 1e-4, 1.0
"""``PxTolerancesScale``: a length in m and a speed in m/s, for the whole process. The manifold of
two shapes keeps its normal until they have moved by a share of their size or of this length. At the
default of 1 m a peg that leans on its hole's edge by 19 mrad still has the normal of its upright
pose, and rests 31 µm away. At 1 mm the error is 0.7 µm. At 0.1 mm, half the peg's clearance, it is
0.5 µm, as with manifolds that are made in place. The time per step is equal. The manual advises the
size of the objects; 10 mm changes nothing here. The speed enters only bouncing and sleep, which are
off."""

_GUIDE = "PhysX 5 User's Guide"
_DYNAMICS = f"{_GUIDE}: Rigid Body Dynamics"
_COLLISION = f"{_GUIDE}: Advanced Collision Detection"
SLERP = 4.0
"""Ratio of the nominal to the actual stiffness of a slerp drive, without unit. The drive acts on
half the angle (measured under a torque: 4.00)."""

_X_TO_Z: Quaternion = (math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0)
"""Rotation for capsules, which lie along x in PhysX and along z in a ``Shape``."""


SETTINGS: Mapping[str, base.Advised] = {
    "coupling": base.Advised("held force", f"{_DYNAMICS}, Applying Forces"),
    "solver": base.Advised("TGS", f"{_DYNAMICS}, Temporal Gauss-Seidel"),
    "position iterations": base.Advised(
        f"{POSITION_ITERATIONS}", f"{_DYNAMICS}, Solver Iterations"
    ),
    "velocity iterations": base.Advised("1", f"{_DYNAMICS}, Solver Iterations"),
    "contact offset": base.Advised(
        f"{CONTACT_OFFSET:g} m", f"{_COLLISION}, Tuning Shape Collision"
    ),
    "rest offset": base.Advised("0", f"{_COLLISION}, Tuning Shape Collision"),
    "contact generation": base.Advised("PCM", f"{_COLLISION}, PCM"),
    "tolerances": base.Advised(
        f"length {LENGTH:g} m (default 1), speed {SPEED:g} m/s",
        "PhysX 5 API: PxTolerancesScale, which advises the size of the objects; "
        "chosen shorter, or PCM keeps normals of a pose that was left",
    ),
    "friction": base.Advised("every iteration", f"{_DYNAMICS}, Friction"),
    "sleep threshold": base.Advised("0", f"{_DYNAMICS}, Sleeping"),
    "damping": base.Advised("0", f"{_DYNAMICS}, Damping"),
}
"""Settings of PhysX 5 with its temporal Gauss-Seidel solver."""


class SapienSimulation(base.Simulation):
    """A task in its own PhysX scene."""

    def __init__(self, task: base.Task, timestep: float) -> None:
        super().__init__(task, timestep)
        _physx()
        # SAPIEN keeps these for the whole process, and reads them when an object is made
        scene_config = physx.PhysxSceneConfig()
        scene_config.gravity = np.array(task.gravity)
        scene_config.enable_tgs = scene_config.enable_pcm = True
        scene_config.enable_friction_every_iteration = True
        physx.set_scene_config(scene_config)
        physx.set_shape_config(contact_offset=CONTACT_OFFSET, rest_offset=0.0)
        physx.set_body_config(
            solver_position_iterations=POSITION_ITERATIONS,
            solver_velocity_iterations=1,
            sleep_threshold=0.0,
        )
        self._system = physx.PhysxCpuSystem()
        self._system.timestep = self._timestep
        self._scene = sapien.Scene([self._system])
        material = physx.PhysxMaterial(task.body.friction, task.body.friction, 0.0)
        if task.fixed:
            fixed = physx.PhysxRigidStaticComponent()
            for shape in task.fixed:
                fixed.attach(_collision(shape, shape.pose, material))
            self._add(fixed, base.Pose())
        self._bodies = [self._free(free, material) for free in task.bodies]
        self._body = body = self._bodies[0]
        body.linear_velocity = np.array(task.start_velocity.linear)
        body.angular_velocity = np.array(task.start_velocity.angular)
        self._begin(task)

    def _free(self, free: base.FreeBody, material: Any) -> Any:
        """Adds a free body and returns it."""
        body = physx.PhysxRigidDynamicComponent()
        for shape, pose in free.shapes:
            body.attach(_collision(shape, pose, material))
        body.mass, body.inertia = free.body.mass, np.array(free.body.inertia)
        body.cmass_local_pose = sapien.Pose()
        body.linear_damping = body.angular_damping = 0.0
        self._add(body, free.principal)
        return body

    def _add(self, component: Any, pose: base.Pose) -> None:
        entity = sapien.Entity()
        entity.add_component(component)
        entity.set_pose(sapien.Pose(pose.position, pose.quaternion))
        self._scene.add_entity(entity)

    def advance(self, force: Vector, torque: Vector) -> None:
        """Sets a force in N and a torque in N m at the centre of mass, and steps."""
        self._body.add_force_torque(force, torque)
        self._system.step()

    def principal_pose(self, body: int = 0) -> base.Pose:
        """Returns the pose of the principal axes of inertia at a body's centre of mass."""
        pose = self._bodies[body].entity_pose
        (x, y, z), (w, i, j, k) = pose.p.tolist(), pose.q.tolist()
        return base.Pose((x, y, z), (w, i, j, k))

    def velocity(self, body: int = 0) -> base.Velocity:
        """Returns the velocity of a body's centre of mass and its angular velocity."""
        linear, angular = self._bodies[body].linear_velocity, self._bodies[body].angular_velocity
        return base.Velocity(tuple(linear.tolist()), tuple(angular.tolist()))

    def contacts(self) -> base.Contacts:
        """Returns the contacts of the last step, as they were at its start.

        PhysX stops shapes that would touch within the step, and leaves gaps of less than a
        nanometre. A point that carries a force therefore counts as touching.
        """
        points = [point for contact in self._system.get_contacts() for point in contact.points]
        return base.Contacts.from_depths(
            max(-point.separation, 0.0) if np.any(point.impulse) else -point.separation
            for point in points
        )

    def close(self) -> None:
        """Releases the scene; PhysX frees it with its last reference."""
        self._bodies = []
        self._body = self._system = self._scene = None


SPRING_SETTINGS: Mapping[str, base.Advised] = {
    **SETTINGS,
    "coupling": base.Advised(
        "implicit spring: D6 joint, linear and slerp drives", f"{_GUIDE}: Joints, D6 Joint"
    ),
}
"""Settings with an implicit coupling: the drives of a D6 joint."""


class SapienSpringSimulation(SapienSimulation):
    """A task in PhysX whose coupling is a drive from the world to the grip.

    Its target is h_k; its target velocity is the handle's over the step. The solver's iterations
    are parts of the step here. The coupling is therefore less damped than the implicit scheme of
    one step.
    """

    def __init__(self, task: base.Task, timestep: float) -> None:
        super().__init__(task, timestep)
        coupling = task.coupling
        if coupling is None:
            return
        self._drive = drive = physx.PhysxDriveComponent(self._body)
        grip = base.composed(self._body_in_principal[0], task.grip)
        drive.set_pose_in_child(sapien.Pose(*grip))
        for set_gains in (
            drive.set_drive_property_x,
            drive.set_drive_property_y,
            drive.set_drive_property_z,
        ):
            set_gains(coupling.stiffness, coupling.damping)
        drive.set_drive_property_slerp(
            SLERP * coupling.rotational_stiffness, SLERP * coupling.rotational_damping
        )
        self._body.entity.add_component(drive)

    def applied(self) -> base.Wrench:
        """Returns nan: the drive's force changes with the solver's iterations."""
        return base.Wrench((math.nan,) * 3, (math.nan,) * 3)

    def _couple(self, handle: base.Frame) -> None:
        """Aims the drive at the handle, and steps."""
        if self._gains is not None:
            rate = 1.0 / self._timestep
            moved = scaled(rate, subtract(handle[0], self._handle[0]))
            turned = scaled(rate, rotation_between(self._handle[1], handle[1]))
            self._drive.set_drive_target(sapien.Pose(*handle))
            self._drive.set_drive_velocity_target(moved, turned)
        self.advance(ZERO_VECTOR, ZERO_VECTOR)


@cache
def _physx() -> Any:
    """Starts PhysX with these tolerances; otherwise SAPIEN would start its own."""
    return physx.PhysxEngine(LENGTH, SPEED)


def _collision(shape: base.Shape, pose: base.Pose, material: Any) -> Any:
    quaternion = pose.quaternion
    if shape.kind == "box":
        made = physx.PhysxCollisionShapeBox(np.array(shape.size), material)
    elif shape.kind == "sphere":
        made = physx.PhysxCollisionShapeSphere(shape.size[0], material)
    elif shape.kind == "capsule":
        made = physx.PhysxCollisionShapeCapsule(*shape.size, material)
        quaternion = product(quaternion, _X_TO_Z)
    else:
        made = physx.PhysxCollisionShapeConvexMesh(shape.vertices, np.ones(3), material)
    made.local_pose = sapien.Pose(pose.position, quaternion)
    return made


def engines() -> tuple[base.Engine, ...]:
    """Returns the engines of this module."""
    physx = f"PhysX 5 in SAPIEN {version('sapien')}"
    return (
        base.Engine("physx", physx, SETTINGS, SapienSimulation),
        base.Engine("physx_spring", physx, SPRING_SETTINGS, SapienSpringSimulation),
    )
