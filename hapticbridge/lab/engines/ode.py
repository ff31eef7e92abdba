"""ODE, the Open Dynamics Engine, through its C library.

References:
    ODE Manual, http://ode.org/wiki/index.php/Manual
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from ctypes import POINTER, Structure, c_char_p, c_double, c_int, c_uint, c_void_p
from functools import cache
from itertools import combinations
from typing import Any, ClassVar

import llvmlite.binding
import numpy as np
from numba import types
from numpy.typing import NDArray

from hapticbridge.arguments import Array
from hapticbridge.errors import StudyError
from hapticbridge.kernel.jit import compiled, direct
from hapticbridge.kernel.mujoco_c import floats
from hapticbridge.kernel.pose import (
    ZERO_VECTOR,
    Quaternion,
    Vector,
    add,
    rotation_between,
    scaled,
    subtract,
)
from hapticbridge.lab.engines import base

_NAMES = ("libode.so.8", "libode.so.6", "libode.so", "libode.dylib")

MISSING = (
    "ODE is not installed: it comes as a system library, not from PyPI "
    "(Debian and Ubuntu: apt install libode8)"
)

MAX_CONTACTS = 8
"""Largest number of contacts of one pair of geoms: as many as two boxes can have in ODE."""

APPROXIMATE_FRICTION = 0x7000
"""``dContactApprox1``: friction in proportion to the normal force, not a constant box."""


class Mass(Structure):
    """``dMass`` in double precision."""

    _fields_: ClassVar = [("mass", c_double), ("c", c_double * 4), ("inertia", c_double * 12)]


class Surface(Structure):
    """``dSurfaceParameters``."""

    _fields_: ClassVar = [
        ("mode", c_int),
        *((name, c_double) for name in ("mu", "mu2", "rho", "rho2", "rhoN", "bounce")),
        *((name, c_double) for name in ("bounce_vel", "soft_erp", "soft_cfm", "motion1")),
        *((name, c_double) for name in ("motion2", "motionN", "slip1", "slip2")),
    ]


class ContactGeom(Structure):
    """``dContactGeom``."""

    _fields_: ClassVar = [
        ("position", c_double * 4),
        ("normal", c_double * 4),
        ("depth", c_double),
        ("geom_1", c_void_p),
        ("geom_2", c_void_p),
        ("side_1", c_int),
        ("side_2", c_int),
    ]


class Contact(Structure):
    """``dContact``."""

    _fields_: ClassVar = [("surface", Surface), ("geom", ContactGeom), ("direction", c_double * 4)]


_REAL, _ID, _INT = c_double, c_void_p, c_int
_THREE = (_ID, _REAL, _REAL, _REAL)
_QUATERNION = (_ID, POINTER(_REAL))
_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "dInitODE2": (_INT, c_uint),
    "dGetConfiguration": (c_char_p,),
    "dSetMessageHandler": (None, _ID),
    "dWorldCreate": (_ID,),
    "dWorldDestroy": (None, _ID),
    "dWorldSetGravity": (None, *_THREE),
    "dWorldSetERP": (None, _ID, _REAL),
    "dWorldSetCFM": (None, _ID, _REAL),
    "dWorldSetContactSurfaceLayer": (None, _ID, _REAL),
    "dBodyCreate": (_ID, _ID),
    "dBodySetMass": (None, _ID, POINTER(Mass)),
    "dMassSetParameters": (None, POINTER(Mass), *(_REAL,) * 10),
    "dBodySetPosition": (None, *_THREE),
    "dBodySetQuaternion": (None, *_QUATERNION),
    "dBodySetLinearVel": (None, *_THREE),
    "dBodySetAngularVel": (None, *_THREE),
    "dBodyGetPosition": (POINTER(_REAL), _ID),
    "dBodyGetQuaternion": (POINTER(_REAL), _ID),
    "dBodyGetLinearVel": (POINTER(_REAL), _ID),
    "dBodyGetAngularVel": (POINTER(_REAL), _ID),
    "dBodySetFiniteRotationMode": (None, _ID, _INT),
    "dBodySetGyroscopicMode": (None, _ID, _INT),
    "dBodySetAutoDisableFlag": (None, _ID, _INT),
    "dCreateBox": (_ID, *_THREE),
    "dCreateSphere": (_ID, _ID, _REAL),
    "dCreateCapsule": (_ID, _ID, _REAL, _REAL),
    "dGeomDestroy": (None, _ID),
    "dGeomSetBody": (None, _ID, _ID),
    "dGeomSetPosition": (None, *_THREE),
    "dGeomSetQuaternion": (None, *_QUATERNION),
    "dGeomSetOffsetPosition": (None, *_THREE),
    "dGeomSetOffsetQuaternion": (None, *_QUATERNION),
    "dJointGroupCreate": (_ID, _INT),
    "dJointGroupDestroy": (None, _ID),
    "dJointAttach": (None, _ID, _ID, _ID),
    "dJointCreateBall": (_ID, _ID, _ID),
    "dJointSetBallAnchor": (None, *_THREE),
    "dJointSetBallAnchor2": (None, *_THREE),
    "dJointSetBallParam": (None, _ID, _INT, _REAL),
    "dJointCreateAMotor": (_ID, _ID, _ID),
    "dJointSetAMotorNumAxes": (None, _ID, _INT),
    "dJointSetAMotorAxis": (None, _ID, _INT, _INT, _REAL, _REAL, _REAL),
    "dJointSetAMotorAngle": (None, _ID, _INT, _REAL),
    "dJointSetAMotorParam": (None, _ID, _INT, _REAL),
}
"""Types of the result and of the arguments."""


@cache
def library() -> Any:
    """Loads ODE's library, initialises it and declares the types of its functions.

    Raises:
        StudyError: It is not installed, or was built in single precision.
    """
    for name in _NAMES:
        try:
            library = ctypes.CDLL(name)
        except OSError:
            continue
        llvmlite.binding.load_library_permanently(name)
        break
    else:
        raise StudyError(MISSING)
    for name, (result, *arguments) in _SIGNATURES.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    if b"ODE_double_precision" not in library.dGetConfiguration().split():
        raise StudyError("the installed ODE was built in single precision; double is needed")
    library.dInitODE2(0)
    # ODE reports a degenerate step, which it then performs anyway
    library.dSetMessageHandler(ctypes.cast(_SILENT, c_void_p))
    return library


def _silence(_number: int, _text: bytes, _arguments: int) -> None:
    """Discards a message of ODE."""


_SILENT = ctypes.CFUNCTYPE(None, c_int, c_char_p, c_void_p)(_silence)
"""Reference that keeps the callback alive for as long as ODE may call it."""

_POINTER, _WHOLE, _DOUBLE, _NOTHING = types.intp, types.int32, types.float64, types.void
_collide: Any = types.ExternalFunction(
    "dCollide", _WHOLE(_POINTER, _POINTER, _WHOLE, _POINTER, _WHOLE)
)
_create: Any = types.ExternalFunction("dJointCreateContact", _POINTER(*(_POINTER,) * 3))
_attach: Any = types.ExternalFunction("dJointAttach", _NOTHING(*(_POINTER,) * 3))
_empty: Any = types.ExternalFunction("dJointGroupEmpty", _NOTHING(_POINTER))
_step: Any = types.ExternalFunction("dWorldStep", _WHOLE(_POINTER, _DOUBLE))
_force: Any = types.ExternalFunction("dBodySetForce", _NOTHING(_POINTER, *(_DOUBLE,) * 3))
_torque: Any = types.ExternalFunction("dBodySetTorque", _NOTHING(_POINTER, *(_DOUBLE,) * 3))


@compiled
def step(
    ids: tuple[int, int, int],
    pairs: NDArray[Any],
    contacts: tuple[int, int, int, int],
    timestep: float,
    force: Vector,
    torque: Vector,
    depths: Array,
) -> int:
    """Sets force and torque, makes the contacts, steps, and removes them.

    Args:
        ids: World, body and group of joints.
        pairs: Geoms that may touch and their bodies, 0 for a fixed one; shape (n, 4).
        contacts: Address of an array of ``MAX_CONTACTS`` contacts with their surfaces filled in,
            size of one, offset of the geometry in it, and offset of the depth in that, in bytes.
        timestep: Timestep in s.
        force: Force at the centre of mass in N.
        torque: Torque in N m.
        depths: Output, filled with the contacts' depths in m.

    Returns:
        The number of contacts.
    """
    world, body, group = ids
    address, size, geometry, depth = contacts
    _force(body, force[0], force[1], force[2])
    _torque(body, torque[0], torque[1], torque[2])
    total = 0
    for i in range(pairs.shape[0]):
        count = _collide(pairs[i, 0], pairs[i, 1], MAX_CONTACTS, address + geometry, size)
        for j in range(count):
            contact = address + j * size
            depths[total] = floats(contact + geometry + depth, 1)[0]
            total += 1
            _attach(_create(world, group, contact), pairs[i, 2], pairs[i, 3])
    _step(world, timestep)
    _empty(group)
    return total


LAYER = 1e-7
"""Depth in m that a contact keeps; the pose is wrong by about this depth. At 0 and the default CFM
a settled peg is right to 1e-6 µm, but contacts come and go: of 8 pegs that a hand jams, at 1 ms,
one is thrown by 1.2 mm instead of 51 µm."""

CFM = 1e-7
"""Constraint force mixing of the contacts in 1/kg times s. At the default of 1e-10 the equations of
redundant contacts are so near to singular that the solver stops early. At 1e-5 the peg sinks by 0.1
µm."""

_MANUAL = "ODE Manual"


SETTINGS: Mapping[str, base.Advised] = {
    "coupling": base.Advised("held force", f"{_MANUAL}: Rigid Body Functions, Mass and force"),
    "step": base.Advised("dWorldStep (direct solver)", f"{_MANUAL}: World, Stepping Functions"),
    "ERP": base.Advised("0.2 (default)", f"{_MANUAL}: Concepts, How To Use ERP and CFM"),
    "CFM": base.Advised(f"{CFM:g}", f"{_MANUAL}: Concepts, How To Use ERP and CFM"),
    "contact surface layer": base.Advised(f"{LAYER:g} m", f"{_MANUAL}: World, Contact Parameters"),
    "friction": base.Advised("dContactApprox1", f"{_MANUAL}: Joint Types, Contact"),
    "rotation": base.Advised("finite", f"{_MANUAL}: Rigid Body Functions, Miscellaneous"),
    "gyroscopic mode": base.Advised("on (default)", f"{_MANUAL}: Rigid Body Functions"),
}
"""Settings of ODE with its direct solver."""


class OdeSimulation(base.Simulation):
    """A task in ODE."""

    def __init__(self, task: base.Task, timestep: float) -> None:
        super().__init__(task, timestep)
        self._ode = ode = library()
        shapes = [*task.fixed, *(shape for free in task.bodies for shape in free.body.shapes)]
        if any(shape.kind == "mesh" for shape in shapes):
            raise StudyError(f"task '{task.name}' has a mesh, which is not given to ODE")
        self._world = world = ode.dWorldCreate()
        ode.dWorldSetGravity(world, *task.gravity)
        ode.dWorldSetERP(world, 0.2)
        ode.dWorldSetCFM(world, CFM)
        ode.dWorldSetContactSurfaceLayer(world, LAYER)
        self._bodies = [self._body_in(world, free) for free in task.bodies]
        self._body = body = self._bodies[0]
        ode.dBodySetLinearVel(body, *task.start_velocity.linear)
        ode.dBodySetAngularVel(body, *task.start_velocity.angular)
        owned = [
            (self._geom(shape, pose, body), body)
            for body, free in zip(self._bodies, task.bodies, strict=True)
            for shape, pose in free.shapes
        ]
        owned += [(self._geom(shape, shape.pose, 0), 0) for shape in task.fixed]
        self._geoms = [geom for geom, _ in owned]
        self._group = ode.dJointGroupCreate(0)
        # the fixed are last, so that the first of a pair is a free body's
        rows = [
            (a, b, first, second)
            for (a, first), (b, second) in combinations(owned, 2)
            if first != second
        ]
        pairs = np.array(rows, dtype=np.intp).reshape(-1, 4)
        self._buffer = (Contact * MAX_CONTACTS)()
        for contact in self._buffer:
            contact.surface.mode = APPROXIMATE_FRICTION
            contact.surface.mu = task.body.friction
        self._depths = np.empty(MAX_CONTACTS * len(pairs))
        self._touching = 0
        self._fixed_arguments = (
            (world, self._body, self._group),
            pairs,
            (
                ctypes.addressof(self._buffer),
                ctypes.sizeof(Contact),
                Contact.geom.offset,
                ContactGeom.depth.offset,
            ),
            self._timestep,
        )
        nothing = (0.0, 0.0, 0.0)
        self._step = direct(step, *self._fixed_arguments, nothing, nothing, self._depths)
        self._begin(task)

    def _body_in(self, world: int, free: base.FreeBody) -> int:
        """Adds a body and returns its address."""
        ode, mass = self._ode, Mass()
        body: int = ode.dBodyCreate(world)
        ode.dMassSetParameters(mass, free.body.mass, 0, 0, 0, *free.body.inertia, 0, 0, 0)
        ode.dBodySetMass(body, mass)
        start = free.principal
        ode.dBodySetPosition(body, *start.position)
        ode.dBodySetQuaternion(body, _array(start.quaternion))
        ode.dBodySetFiniteRotationMode(body, 1)
        ode.dBodySetGyroscopicMode(body, 1)
        ode.dBodySetAutoDisableFlag(body, 0)
        return body

    def _geom(self, shape: base.Shape, pose: base.Pose, body: int) -> int:
        """Adds a shape to a body, or fixes it for body 0."""
        ode = self._ode
        geom: int
        if shape.kind == "box":
            geom = ode.dCreateBox(None, *(2 * half for half in shape.size))
        elif shape.kind == "sphere":
            geom = ode.dCreateSphere(None, *shape.size)
        else:
            geom = ode.dCreateCapsule(None, shape.size[0], 2 * shape.size[1])
        if not body:
            ode.dGeomSetPosition(geom, *pose.position)
            ode.dGeomSetQuaternion(geom, _array(pose.quaternion))
        else:
            ode.dGeomSetBody(geom, body)
            ode.dGeomSetOffsetPosition(geom, *pose.position)
            ode.dGeomSetOffsetQuaternion(geom, _array(pose.quaternion))
        return geom

    def advance(self, force: Vector, torque: Vector) -> None:
        """Sets a force in N and a torque in N m at the centre of mass, and steps."""
        self._touching = self._step(*self._fixed_arguments, force, torque, self._depths)

    def principal_pose(self, body: int = 0) -> base.Pose:
        """Returns the pose of the principal axes of inertia at a body's centre of mass."""
        ode, address = self._ode, self._bodies[body]
        p, q = ode.dBodyGetPosition(address), ode.dBodyGetQuaternion(address)
        return base.Pose((p[0], p[1], p[2]), (q[0], q[1], q[2], q[3]))

    def velocity(self, body: int = 0) -> base.Velocity:
        """Returns the velocity of a body's centre of mass and its angular velocity."""
        ode, address = self._ode, self._bodies[body]
        v, w = ode.dBodyGetLinearVel(address), ode.dBodyGetAngularVel(address)
        return base.Velocity((v[0], v[1], v[2]), (w[0], w[1], w[2]))

    def contacts(self) -> base.Contacts:
        """Returns the contacts of the last step, as they were at its start."""
        return base.Contacts.from_depths(self._depths[: self._touching].tolist())

    def close(self) -> None:
        """Releases ODE's world."""
        if self._world:
            for geom in self._geoms:
                self._ode.dGeomDestroy(geom)
            self._ode.dJointGroupDestroy(self._group)
            self._ode.dWorldDestroy(self._world)
            self._world = 0


def _array(quaternion: Quaternion) -> ctypes.Array[ctypes.c_double]:
    return (ctypes.c_double * 4)(*quaternion)


# dParamLoStop, dParamHiStop, dParamCFM, dParamStopERP, dParamStopCFM and dParamERP
_LOW, _HIGH, _CFM, _STOP_ERP, _STOP_CFM, _ERP = 0, 1, 8, 9, 10, 13
_GROUP = 0x100
"""Offset between the parameters of an angular motor's axes."""


SPRING_SETTINGS: Mapping[str, base.Advised] = {
    **SETTINGS,
    "coupling": base.Advised(
        "implicit spring: ball joint and angular motor, CFM 1/(T K + B)",
        "ODE Manual: Concepts, How To Use ERP and CFM",
    ),
}
"""Settings with an implicit coupling: a soft ball joint and a soft angular motor."""


class OdeSpringSimulation(OdeSimulation):
    """A task in ODE whose coupling is implicit in position and velocity.

    A joint with CFM 1/(T K + B) and ERP 1 whose target is y away pulls with

        λ = (T K + B)(y/T − v),    y = T (K (h_k − x_{k−1}) + B δh/T) / (T K + B)

    which is the coupling's f_k with x_k = x_{k−1} + T v: ODE's own spring, ERP = T K/(T K + B),
    whose damper acts against the moving handle.
    """

    def __init__(self, task: base.Task, timestep: float) -> None:
        super().__init__(task, timestep)
        self._ball = self._motor = 0
        coupling = task.coupling
        if coupling is None:
            return
        ode, body = self._ode, self._body
        self._ball = ode.dJointCreateBall(self._world, None)
        ode.dJointAttach(self._ball, body, None)
        ode.dJointSetBallAnchor(self._ball, *self._tool[0])
        softness = 1.0 / (timestep * coupling.stiffness + coupling.damping)
        ode.dJointSetBallParam(self._ball, _ERP, 1.0)
        ode.dJointSetBallParam(self._ball, _CFM, softness)
        hardness = timestep * coupling.rotational_stiffness + coupling.rotational_damping
        if hardness == 0:
            return
        self._motor = ode.dJointCreateAMotor(self._world, None)
        ode.dJointAttach(self._motor, body, None)
        ode.dJointSetAMotorNumAxes(self._motor, 3)
        for axis in range(3):
            ode.dJointSetAMotorAxis(self._motor, axis, 0, *(float(i == axis) for i in range(3)))
            for parameter, value in (
                (_HIGH, 0.0),
                (_LOW, 0.0),
                (_STOP_ERP, 1.0),
                (_STOP_CFM, 1.0 / hardness),
            ):
                ode.dJointSetAMotorParam(self._motor, axis * _GROUP + parameter, value)

    def applied(self) -> base.Wrench:
        """Returns the wrench of the joints in the last step: the law's at its end."""
        return self.wrench()

    def _couple(self, handle: base.Frame) -> None:
        """Aims the joints at the handle, and steps."""
        if self._gains is not None:
            stiffness, damping, rotational_stiffness, rotational_damping = self._gains
            stretch = subtract(handle[0], self._tool[0])
            moved = subtract(handle[0], self._handle[0])
            offset = _offset(stiffness, damping, stretch, moved)
            self._ode.dJointSetBallAnchor2(self._ball, *add(self._tool[0], offset))
            if self._motor:
                twist = rotation_between(self._tool[1], handle[1])
                turned = rotation_between(self._handle[1], handle[1])
                angles = _offset(rotational_stiffness, rotational_damping, twist, turned)
                for axis, angle in enumerate(angles):
                    self._ode.dJointSetAMotorAngle(self._motor, axis, -angle)
        self.advance(ZERO_VECTOR, ZERO_VECTOR)


def _offset(stiffness: float, damping: float, stretch: Vector, moved: Vector) -> Vector:
    """Returns y for K, B/T, h_k − x_{k−1} and δh."""
    pull = add(scaled(stiffness, stretch), scaled(damping, moved))
    return scaled(1.0 / (stiffness + damping), pull)


def engines() -> tuple[base.Engine, ...]:
    """Returns the engines of this module.

    Raises:
        StudyError: ODE is not installed.
    """
    # ODE does not report its version
    configuration = str(library().dGetConfiguration().decode())
    return (
        base.Engine("ode", configuration, SETTINGS, OdeSimulation),
        base.Engine("ode_spring", configuration, SPRING_SETTINGS, OdeSpringSimulation),
    )
