"""Bindings of Force Dimension's library (DHD), loaded at run time.

The library is not part of this project. Signatures, types and codes follow the SDK's header
``dhdc.h`` and its public Python bindings. The last argument of every call is the device's number.
Getters and setters return a negative number on failure, 0, or a positive number as a warning. Each
communicates with the device before it returns. The duration is up to the library and cannot be
bounded here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from ctypes import POINTER, c_byte, c_char_p, c_double, c_int, c_ubyte, c_uint, c_ushort
from dataclasses import dataclass
from typing import Any

from hapticbridge.device.base import TIMING, USUAL_TORQUE_LIMIT, usual_delay
from hapticbridge.device.transport.maker_library import LibraryFiles, MakerLibrary
from hapticbridge.errors import DeviceError

# Device types of Force Dimension's library


@dataclass(frozen=True, slots=True)
class Model:
    """Properties of a device type.

    Attributes:
        name: The maker's name.
        turns: True if its wrist has motors.
        force: Largest force in N if the library sets no limit; None if unknown.
        torque: Largest torque in N m if the library sets no limit; None if unknown.
        grips: True if it may have a gripper with a motor.
    """

    name: str
    turns: bool = False
    force: float | None = None
    torque: float | None = None
    grips: bool = False


MODELS = {
    33: Model("omega.3", force=12.0),
    34: Model("omega.6", force=12.0),
    36: Model("omega.6 left", force=12.0),
    35: Model("omega.7", force=12.0, grips=True),
    37: Model("omega.7 left", force=12.0, grips=True),
    60: Model("Novint Falcon", force=8.0),
    63: Model("delta.3", force=20.0),
    104: Model("sigma.7", turns=True, force=12.0, torque=0.4, grips=True),
    105: Model("sigma.7 left", turns=True, force=12.0, torque=0.4, grips=True),
    108: Model("lambda.7", turns=True, force=12.0, grips=True),
    109: Model("lambda.7 left", turns=True, force=12.0, grips=True),
    203: Model("lambda.3"),
    206: Model("sigma.3"),
}
"""Device types by ``dhdGetSystemType``, numbered as in the SDK's header. Forces and torques are
those that CHAI3D allows; the maker's own figures are equal or larger."""

GRIP_FORCE = 8.0
"""Largest force of a gripper in N, that of omega.7 and sigma.7 in CHAI3D."""


def limits_of(
    model: Model, library_limits: Sequence[float], requested: Mapping[str, float]
) -> tuple[float, float]:
    """Returns the largest force in N and torque in N m that may be commanded.

    Each is the lower of the library's limit and the user's or the model's value.

    Args:
        model: Type of the device.
        library_limits: The library's limits of force and torque; negative if it sets no limit.
        requested: Numbers of the data sheet set by the user.

    Raises:
        DeviceError: No source states a limit.
    """
    limits = {"force": 0.0, "torque": USUAL_TORQUE_LIMIT}
    usual = {"force": model.force, "torque": model.torque}
    for name, library_limit in zip(limits, library_limits, strict=True):
        if name == "torque" and not model.turns:
            continue
        candidates = [
            requested.get(f"{name}_limit", usual[name]),
            library_limit if library_limit > 0.0 else None,
        ]
        known = [end for end in candidates if end is not None]
        if not known:
            raise DeviceError(
                f"the largest {name} of {model.name} is unknown; set it with {name}_limit="
            )
        limits[name] = min(known)
    return limits["force"], limits["torque"]


TIMEGUARD, SATURATED = 1, 2
"""Return codes: no newer sample; a motor is saturated. Success is 0."""

MAX_WATCHDOG = 255
"""Largest watchdog in steps of ``WATCHDOG_STEP``: the argument is a byte."""

WATCHDOG_STEP = 125e-6
"""Step of the watchdog in s."""

_NUMBERS = POINTER(c_double)

FUNCTIONS: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "dhdGetDeviceCount": (c_int, ()),
    "dhdOpenID": (c_int, (c_byte,)),
    "dhdClose": (c_int, (c_byte,)),
    "dhdGetSystemType": (c_int, (c_byte,)),
    "dhdGetSerialNumber": (c_int, (POINTER(c_ushort), c_byte)),
    "dhdGetMaxForce": (c_double, (c_byte,)),
    "dhdGetMaxTorque": (c_double, (c_byte,)),
    "dhdGetEffectorMass": (c_int, (_NUMBERS, c_byte)),
    "dhdSetGravityCompensation": (c_int, (c_int, c_byte)),
    "dhdEnableExpertMode": (c_int, ()),
    "dhdDisableExpertMode": (c_int, ()),
    "dhdSetWatchdog": (c_int, (c_ubyte, c_byte)),
    "dhdEnableForce": (c_int, (c_ubyte, c_byte)),
    "dhdGetPosition": (c_int, (_NUMBERS,) * 3 + (c_byte,)),
    "dhdGetPositionAndOrientationFrame": (c_int, (_NUMBERS,) * 4 + (c_byte,)),
    "dhdGetButtonMask": (c_uint, (c_byte,)),
    "dhdSetForce": (c_int, (c_double,) * 3 + (c_byte,)),
    "dhdSetForceAndTorque": (c_int, (c_double,) * 6 + (c_byte,)),
    "dhdGetTime": (c_double, ()),
    "dhdErrorGetLastStr": (c_char_p, ()),
}
"""Functions that are called, with the types of result and arguments."""

GRIPPER: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "dhdHasActiveGripper": (c_int, (c_byte,)),
    "dhdGetGripperGap": (c_int, (_NUMBERS, c_byte)),
    "dhdSetForceAndGripperForce": (c_int, (c_double,) * 4 + (c_byte,)),
    "dhdSetForceAndTorqueAndGripperForce": (c_int, (c_double,) * 7 + (c_byte,)),
}
"""Functions of a gripper, which an older library may lack."""

FILES = LibraryFiles(
    variable="HAPTICBRIDGE_DHD",
    stems=("drd", "dhd"),
    names={
        "linux": ("libdrd.so.3", "libdrd.so", "libdhd.so.3", "libdhd.so"),
        "darwin": ("libdrd.dylib", "libdhd.dylib"),
        "win32": ("drd64.dll", "dhd64.dll"),
    },
    missing="Force Dimension's library (DHD) was not found: install the SDK of forcedimension.com",
)
"""Files of the library. DRD contains all of DHD."""


class Dhd(MakerLibrary):
    """The loaded library.

    Raises:
        DeviceError: It cannot be loaded, or lacks a function.
    """

    def __init__(self, path: str) -> None:
        about = "Force Dimension's library, or is older than 3.3"
        super().__init__(path, FUNCTIONS, about, GRIPPER)

    def now(self) -> float:
        """Returns the time of the library's own clock in s."""
        return float(self["dhdGetTime"]())

    def last_error(self) -> str:
        """Returns the library's description of its last error."""
        text = self["dhdErrorGetLastStr"]()
        return text.decode(errors="replace") if text else "no reason reported"

    def has_gripper(self, device: int, model: Model) -> bool:
        """Returns True if a device has a gripper with a motor, and the library drives it."""
        is_driven = model.grips and all(name in self for name in GRIPPER)
        return is_driven and int(self["dhdHasActiveGripper"](device)) == 1

    def require(self, name: str, *arguments: Any, what: str) -> int:
        """Calls a function of ``FUNCTIONS`` and returns its code, 0 or a warning.

        Raises:
            DeviceError: The function failed; the message is ``what`` and the library's description.
        """
        code = int(self[name](*arguments))
        if code < 0:
            raise DeviceError(f"{what}: {self.last_error()}")
        return code

    def has_watchdog(self, device: int, steps: int) -> bool:
        """Sets the watchdog, 1 to ``MAX_WATCHDOG`` steps; returns False if the device has none."""
        self["dhdEnableExpertMode"]()
        code = int(self["dhdSetWatchdog"](steps, device))
        self["dhdDisableExpertMode"]()
        return code >= 0

    def timing(self, exchange: Callable[[], object]) -> tuple[float, float]:
        """Measures the rate of exchanges in Hz and the time in s that the share ``ON_TIME`` meets.

        ``exchange`` reads a sample and writes a force; it is repeated for ``TIMING``.
        """
        times = []
        begin = last = self.now()
        while last - begin < TIMING:
            exchange()
            now = self.now()
            times.append(now - last)
            last = now
        return len(times) / (last - begin), usual_delay(times)
