"""ODE's C library: its structs and functions, and one compiled step.

ODE does not step by itself: whoever uses it asks it for the contacts of every pair of geoms, makes
a joint of each, steps, and throws the joints away. Through ctypes this loop costs more than ODE.
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, Structure, c_char_p, c_double, c_int, c_uint, c_void_p
from functools import cache
from typing import Any, ClassVar

import llvmlite.binding
from numba import types
from numpy.typing import NDArray

from hapticbridge.arguments import Array
from hapticbridge.errors import StudyError
from hapticbridge.jit import compiled
from hapticbridge.kernel.mujoco_c import floats
from hapticbridge.pose import Vector

_NAMES = ("libode.so.8", "libode.so.6", "libode.so", "libode.dylib")

MISSING = (
    "ODE is not installed: it comes as a system library, not from PyPI "
    "(Debian and Ubuntu: apt install libode8)"
)

MOST_CONTACTS = 8
"""Contacts of one pair of geoms: as many as two boxes can have in ODE."""

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

    _fields_: ClassVar = [
        ("surface", Surface),
        ("geom", ContactGeom),
        ("direction", c_double * 4),
    ]


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
"""Type of the result, and of the arguments."""


@cache
def library() -> Any:
    """Returns ODE's library, initialised, its functions' types declared.

    Raises:
        StudyError: It is not installed, or was built in single precision.
    """
    for name in _NAMES:
        try:
            found = ctypes.CDLL(name)
        except OSError:
            continue
        llvmlite.binding.load_library_permanently(name)
        break
    else:
        raise StudyError(MISSING)
    for name, (result, *arguments) in _SIGNATURES.items():
        function = getattr(found, name)
        function.restype, function.argtypes = result, arguments
    if b"ODE_double_precision" not in found.dGetConfiguration().split():
        raise StudyError("the installed ODE was built in single precision; double is needed")
    found.dInitODE2(0)
    # it reports on a degenerate step, which is then done anyway
    found.dSetMessageHandler(ctypes.cast(_SILENT, c_void_p))
    return found


def _silence(_number: int, _text: bytes, _arguments: int) -> None:
    """Takes what ODE would print."""


_SILENT = ctypes.CFUNCTYPE(None, c_int, c_char_p, c_void_p)(_silence)
"""Kept here for as long as ODE may call it."""

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
        pairs: Geoms that may touch, the tool's first, shape (n, 2).
        contacts: Address of an array of ``MOST_CONTACTS`` contacts with their surfaces filled in,
            size of one, where in it the geometry is, and where in that the depth is, in bytes.
        timestep: In s.
        force: At the centre of mass in N.
        torque: In N m.
        depths: Is filled with the contacts' depths in m.

    Returns:
        How many contacts there were.
    """
    world, body, group = ids
    address, size, geometry, depth = contacts
    _force(body, force[0], force[1], force[2])
    _torque(body, torque[0], torque[1], torque[2])
    total = 0
    for i in range(pairs.shape[0]):
        count = _collide(pairs[i, 0], pairs[i, 1], MOST_CONTACTS, address + geometry, size)
        for j in range(count):
            contact = address + j * size
            depths[total] = floats(contact + geometry + depth, 1)[0]
            total += 1
            _attach(_create(world, group, contact), body, 0)
    _step(world, timestep)
    _empty(group)
    return total
