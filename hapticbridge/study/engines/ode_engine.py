"""ODE, the Open Dynamics Engine, through its C library.

References:
    ODE Manual, http://ode.org/wiki/index.php/Manual
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping

import numpy as np

from hapticbridge.errors import StudyError
from hapticbridge.jit import direct
from hapticbridge.pose import Quaternion, Vector
from hapticbridge.study.engines import ode_native as native
from hapticbridge.study.engines.base import Contacts, Engine, Setting
from hapticbridge.study.engines.held import HeldSimulation
from hapticbridge.study.engines.task import Pose, Shape, Task, Velocity

LAYER = 1e-7
"""Depth in m that a contact keeps. At 0 a settled tool's contacts come and go, and in two of six
poses of the peg in its hole it chattered by 9 to 50 µm; the pose is wrong by about this depth."""

CFM = 1e-7
"""Constraint force mixing of the contacts in 1/kg times s: 1e-10, the default, leaves the equations
of redundant contacts so near to singular that the solver stops early; at 1e-5 the peg sinks by
0.1 µm."""

_MANUAL = "ODE Manual"


class OdeEngine:
    """ODE with its direct solver."""

    name = "ode"
    settings: Mapping[str, Setting] = {
        "coupling": Setting("held force", f"{_MANUAL}: Rigid Body Functions, Mass and force"),
        "step": Setting("dWorldStep (direct solver)", f"{_MANUAL}: World, Stepping Functions"),
        "ERP": Setting("0.2 (default)", f"{_MANUAL}: Concepts, How To Use ERP and CFM"),
        "CFM": Setting(f"{CFM:g}", f"{_MANUAL}: Concepts, How To Use ERP and CFM"),
        "contact surface layer": Setting(f"{LAYER:g} m", f"{_MANUAL}: World, Contact Parameters"),
        "friction": Setting("dContactApprox1", f"{_MANUAL}: Joint Types, Contact"),
        "rotation": Setting("finite", f"{_MANUAL}: Rigid Body Functions, Miscellaneous"),
        "gyroscopic mode": Setting("on (default)", f"{_MANUAL}: Rigid Body Functions"),
    }

    @property
    def version(self) -> str:
        """ODE does not tell its own version, only how it was built."""
        return str(native.library().dGetConfiguration().decode())

    def open(self, task: Task, timestep: float) -> OdeSimulation:
        """Sets a task up; see ``Engine.open``. It knows no convex meshes."""
        return OdeSimulation(task, timestep)


class OdeSimulation(HeldSimulation):
    """A task in ODE."""

    def __init__(self, task: Task, timestep: float) -> None:
        super().__init__(task, timestep)
        self._ode = ode = native.library()
        for shape in (*task.body.shapes, *task.fixed):
            if shape.kind == "mesh":
                raise StudyError(f"task '{task.name}' has a mesh, which is not given to ODE")
        self._world = world = ode.dWorldCreate()
        ode.dWorldSetGravity(world, *task.gravity)
        ode.dWorldSetERP(world, 0.2)
        ode.dWorldSetCFM(world, CFM)
        ode.dWorldSetContactSurfaceLayer(world, LAYER)
        self._body = self._tool_in(world, task)
        tools = [self._geom(shape, self._shape_pose(shape)) for shape in task.body.shapes]
        fixed = [self._geom(shape, shape.pose, is_fixed=True) for shape in task.fixed]
        self._geoms = [*tools, *fixed]
        self._group = ode.dJointGroupCreate(0)
        pairs = np.array([(a, b) for a in tools for b in fixed], dtype=np.intp).reshape(-1, 2)
        self._buffer = (native.Contact * native.MOST_CONTACTS)()
        for contact in self._buffer:
            contact.surface.mode = native.APPROXIMATE_FRICTION
            contact.surface.mu = task.body.friction
        self._depths = np.empty(native.MOST_CONTACTS * len(pairs))
        self._touching = 0
        self._fixed_arguments = (
            (world, self._body, self._group),
            pairs,
            (
                ctypes.addressof(self._buffer),
                ctypes.sizeof(native.Contact),
                native.Contact.geom.offset,
                native.ContactGeom.depth.offset,
            ),
            self._timestep,
        )
        nothing = (0.0, 0.0, 0.0)
        self._step = direct(native.step, *self._fixed_arguments, nothing, nothing, self._depths)
        self._begin(task)

    def _tool_in(self, world: int, task: Task) -> int:
        """Adds the tool's body and returns its address."""
        ode, mass = self._ode, native.Mass()
        body: int = ode.dBodyCreate(world)
        ode.dMassSetParameters(mass, task.body.mass, 0, 0, 0, *task.body.inertia, 0, 0, 0)
        ode.dBodySetMass(body, mass)
        start = self._principal(task.start)
        ode.dBodySetPosition(body, *start.position)
        ode.dBodySetQuaternion(body, _array(start.quaternion))
        ode.dBodySetLinearVel(body, *task.start_velocity.linear)
        ode.dBodySetAngularVel(body, *task.start_velocity.angular)
        ode.dBodySetFiniteRotationMode(body, 1)
        ode.dBodySetGyroscopicMode(body, 1)
        ode.dBodySetAutoDisableFlag(body, 0)
        return body

    def _geom(self, shape: Shape, pose: Pose, *, is_fixed: bool = False) -> int:
        ode = self._ode
        geom: int
        if shape.kind == "box":
            geom = ode.dCreateBox(None, *(2 * half for half in shape.size))
        elif shape.kind == "sphere":
            geom = ode.dCreateSphere(None, *shape.size)
        else:
            geom = ode.dCreateCapsule(None, shape.size[0], 2 * shape.size[1])
        if is_fixed:
            ode.dGeomSetPosition(geom, *pose.position)
            ode.dGeomSetQuaternion(geom, _array(pose.quaternion))
        else:
            ode.dGeomSetBody(geom, self._body)
            ode.dGeomSetOffsetPosition(geom, *pose.position)
            ode.dGeomSetOffsetQuaternion(geom, _array(pose.quaternion))
        return geom

    def advance(self, force: Vector, torque: Vector) -> None:
        """Sets a force in N and a torque in N m at the centre of mass, and steps."""
        self._touching = self._step(*self._fixed_arguments, force, torque, self._depths)

    def principal_pose(self) -> Pose:
        """Returns the pose of the principal axes of inertia at the centre of mass."""
        p, q = self._ode.dBodyGetPosition(self._body), self._ode.dBodyGetQuaternion(self._body)
        return Pose((p[0], p[1], p[2]), (q[0], q[1], q[2], q[3]))

    def velocity(self) -> Velocity:
        """Returns the velocity of the centre of mass and the angular velocity."""
        v, w = self._ode.dBodyGetLinearVel(self._body), self._ode.dBodyGetAngularVel(self._body)
        return Velocity((v[0], v[1], v[2]), (w[0], w[1], w[2]))

    def contacts(self) -> Contacts:
        """Returns the contacts of the last step, as they were at its start."""
        return Contacts.of(self._depths[: self._touching].tolist())

    def close(self) -> None:
        """Gives back what ODE holds."""
        if self._world:
            for geom in self._geoms:
                self._ode.dGeomDestroy(geom)
            self._ode.dJointGroupDestroy(self._group)
            self._ode.dWorldDestroy(self._world)
            self._world = 0


def _array(quaternion: Quaternion) -> ctypes.Array[ctypes.c_double]:
    return (ctypes.c_double * 4)(*quaternion)


def engines() -> tuple[Engine, ...]:
    """Returns the engines of this module.

    Raises:
        StudyError: ODE is not installed.
    """
    native.library()
    return (OdeEngine(),)
