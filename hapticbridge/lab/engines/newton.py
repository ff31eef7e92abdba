"""Newton on the processor, with two solvers of its own, in single precision.

Newton's third solver for rigid bodies is MuJoCo Warp, which is an engine by itself here. Like it,
Newton is written for thousands of scenes at once on a graphics card.

References:
    Newton documentation, https://newton-physics.github.io/newton
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from typing import Any

import newton
import numpy as np
import warp
from scipy.spatial import ConvexHull

from hapticbridge.kernel.pose import Vector
from hapticbridge.lab.engines import base

GAP = 1e-3
"""Distance in m at which contacts are made. It covers the motion of some steps and is small against
the parts; Newton's own is 0.1 m."""

XPBD_ITERATIONS, STEEL_ITERATIONS = 50, 200
"""Iterations of the two solvers; Newton's own are 2 and 12. In a step of 4 ms a stack that a hand
leans on gives way by 6.7, 3.9 and 2.1 mm at 2, 20 and 50 iterations of XPBD, and by 2.0, 0.26 and
0.03 mm at 12, 50 and 200 of Steel."""

_GUIDE = "Newton documentation, Solvers"
_COLLISIONS = "Newton documentation, Collisions"
_SHARED = {
    "coupling": base.Advised("held force, State.body_f", "Newton documentation, State"),
    "device": base.Advised("cpu", "Newton documentation, Installation"),
    "precision": base.Advised("single (the only one)", "Newton documentation, State"),
    "gap": base.Advised(f"{GAP:g} m", f"{_COLLISIONS}: Margin and gap"),
}

Solver = Callable[[Any], Any]
"""Function that makes a solver for a model."""


class NewtonSimulation(base.Simulation):
    """A task in Newton."""

    def __init__(self, task: base.Task, timestep: float, solver: Solver) -> None:
        super().__init__(task, timestep)
        warp.config.quiet = True
        builder = newton.ModelBuilder(gravity=task.gravity)
        builder.rigid_gap = GAP
        newton.solvers.SolverSteel.register_custom_attributes(builder)
        config = newton.ModelBuilder.ShapeConfig(
            density=0.0, mu=task.body.friction, mu_torsional=0.0, mu_rolling=0.0
        )
        for free in task.bodies:
            body = builder.add_body(
                xform=_transform(free.principal),
                mass=free.body.mass,
                inertia=warp.mat33(np.diag(free.body.inertia)),
                lock_inertia=True,
                custom_attributes={"steel:rigid_body_angular_damping": 0.0},
            )
            for shape, pose in free.shapes:
                _add(builder, body, shape, pose, config)
        for shape in task.fixed:
            _add(builder, -1, shape, shape.pose, config)
        with warp.ScopedDevice("cpu"):
            self._model = model = builder.finalize()
            self._solver = solver(model)
            self._pipeline = newton.CollisionPipeline(model)
            self._contacts = self._pipeline.contacts()
            self._apart = warp.zeros(self._contacts.rigid_contact_max, dtype=float)
            self._now, self._next = model.state(), model.state()
            # a free joint's velocity is that of the centre of mass, in the world frame
            speed = (*task.start_velocity.linear, *task.start_velocity.angular)
            self._now.joint_qd.numpy()[:6] = speed
            newton.eval_fk(model, self._now.joint_q, self._now.joint_qd, self._now)
        self._begin(task)

    def advance(self, force: Vector, torque: Vector) -> None:
        """Sets a force in N and a torque in N m at the centre of mass, and steps."""
        now = self._now
        # on the processor this is a view
        now.body_f.numpy()[0] = (*force, *torque)
        with warp.ScopedDevice("cpu"):
            self._pipeline.collide(now, self._contacts)
            self._solver.step(now, self._next, None, self._contacts, self._timestep)
        self._now, self._next = self._next, now

    def principal_pose(self, body: int = 0) -> base.Pose:
        """Returns the pose of the principal axes of inertia at a body's centre of mass."""
        x, y, z, i, j, k, w = self._now.body_q.numpy()[body].tolist()
        return base.Pose((x, y, z), (w, i, j, k))

    def velocity(self, body: int = 0) -> base.Velocity:
        """Returns the velocity of a body's centre of mass and its angular velocity."""
        x, y, z, a, b, c = self._now.body_qd.numpy()[body].tolist()
        return base.Velocity((x, y, z), (a, b, c))

    def contacts(self) -> base.Contacts:
        """Returns the contacts of the last step, as they were at its start."""
        with warp.ScopedDevice("cpu"):
            newton.eval_rigid_contact_kinematics(
                self._model, self._next, self._contacts, out_distance=self._apart
            )
        count = int(self._contacts.rigid_contact_count.numpy()[0])
        return base.Contacts.from_depths((-self._apart.numpy()[:count]).tolist())

    def close(self) -> None:
        """Does nothing: Newton frees its arrays with their last reference."""


def _transform(pose: base.Pose) -> Any:
    w, i, j, k = pose.quaternion
    return warp.transform(pose.position, (i, j, k, w))


def _add(builder: Any, body: int, shape: base.Shape, pose: base.Pose, config: Any) -> None:
    place = {"xform": _transform(pose), "cfg": config}
    if shape.kind == "box":
        x, y, z = shape.size
        builder.add_shape_box(body, hx=x, hy=y, hz=z, **place)
    elif shape.kind == "sphere":
        builder.add_shape_sphere(body, radius=shape.size[0], **place)
    elif shape.kind == "capsule":
        radius, half = shape.size
        builder.add_shape_capsule(body, radius=radius, half_height=half, **place)
    else:
        mesh = newton.Mesh(shape.vertices, ConvexHull(shape.vertices).simplices.ravel())
        builder.add_shape_convex_hull(body, mesh=mesh, **place)


def engines() -> tuple[base.Engine, ...]:
    """Returns the engines of this module."""

    def positions(model: Any) -> Any:
        return newton.solvers.SolverXPBD(model, iterations=XPBD_ITERATIONS)

    def impulses(model: Any) -> Any:
        return newton.solvers.SolverSteel(model, iterations=STEEL_ITERATIONS)

    xpbd = {
        "solver": base.Advised("XPBD", _GUIDE),
        "iterations": base.Advised(f"{XPBD_ITERATIONS} (default 2)", _GUIDE),
    }
    steel = {
        "solver": base.Advised("Steel (marked experimental)", _GUIDE),
        "iterations": base.Advised(f"{STEEL_ITERATIONS} (default 12)", _GUIDE),
        "angular damping": base.Advised("0 (default 0.05)", _GUIDE),
    }
    return tuple(
        base.Engine(
            name,
            version("newton"),
            {**_SHARED, **settings},
            partial(NewtonSimulation, solver=solver),
        )
        for name, solver, settings in (
            ("newton_xpbd", positions, xpbd),
            ("newton_steel", impulses, steel),
        )
    )
