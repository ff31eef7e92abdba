"""Force Dimension's omega, delta, sigma and lambda, through the maker's library.

The library (DHD) is not part of this project; users obtain it from the maker. It is loaded at run
time. Signatures, types and codes follow the SDK's header ``dhdc.h`` and its public Python bindings.
The last argument of every call is the device's number. Getters and setters return a negative number
on failure, 0, or a positive number as a warning.

A call communicates with the device before it returns. Its duration is up to the library and cannot
be bounded here. A sample is therefore as old as its call, and a force acts when its call ends. The
sheet's delay is the duration of both calls.

The device's frame is the library's: the origin in the middle of the workspace, x towards the user,
y to the right, z up. A wrist with motors (sigma.7, lambda.7) adds three axes. Its orientation is
read as a matrix (``dhdGetPositionAndOrientationFrame``), because the library's angles are joint
angles. A wrist without motors (omega.6 and omega.7) is ignored: its rotation would put energy into
the scene without a motor to balance it. A gripper with a motor (omega.7, sigma.7, lambda.7) is the
grip axis: x = −gap, so that it rises as the fingers close, and the force on it is that against the
gap. The maker's gravity compensation is on unless ``gravity=0`` is set. It depends on the position
only, so it creates no energy.

The driver has not been verified on hardware, nor has the sign of the gripper's force: if it is
reversed, the probe before a run refuses it (``demand.probe``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from ctypes import POINTER, byref, c_byte, c_char_p, c_double, c_int, c_ubyte, c_uint, c_ushort
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import (
    AXES,
    TIMING,
    USUAL_TORQUE_LIMIT,
    DeviceInfo,
    calling_on_error,
    checked_number,
    checked_period,
    checked_rotation,
    stated_numbers,
    stated_switch,
    usual_delay,
)
from hapticbridge.device.driver import (
    Driver,
    FoundDevice,
    Notify,
    UsbId,
    ignore_message,
    select_device,
)
from hapticbridge.device.transport import usb as usb_search
from hapticbridge.device.transport.maker_library import LibraryFiles, MakerLibrary
from hapticbridge.device.watchdog import MIN_WATCHDOG, SILENCE, SilenceDetector, watchdog_time
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

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

RESET = 3
"""Index of the flag of mode RESET among those of ``dhdGetStatus``. In this mode a device is not
calibrated, and waits until its end effector is put to its rest position (SDK, "Device modes")."""

MAX_STATUS = 32
"""Number of flags that have room; the library's newest version writes 17."""

MAX_WATCHDOG = 255
"""Largest watchdog in steps of ``WATCHDOG_STEP``: the argument is a byte."""

WATCHDOG_STEP = 125e-6
"""Step of the watchdog in s."""

_DOUBLES = POINTER(c_double)

FUNCTIONS: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "dhdGetDeviceCount": (c_int, ()),
    "dhdOpenID": (c_int, (c_byte,)),
    "dhdClose": (c_int, (c_byte,)),
    "dhdGetSystemType": (c_int, (c_byte,)),
    "dhdGetStatus": (c_int, (POINTER(c_int), c_byte)),
    "dhdGetSerialNumber": (c_int, (POINTER(c_ushort), c_byte)),
    "dhdGetMaxForce": (c_double, (c_byte,)),
    "dhdGetMaxTorque": (c_double, (c_byte,)),
    "dhdGetEffectorMass": (c_int, (_DOUBLES, c_byte)),
    "dhdSetGravityCompensation": (c_int, (c_int, c_byte)),
    "dhdEnableExpertMode": (c_int, ()),
    "dhdDisableExpertMode": (c_int, ()),
    "dhdSetWatchdog": (c_int, (c_ubyte, c_byte)),
    "dhdEnableForce": (c_int, (c_ubyte, c_byte)),
    "dhdGetPosition": (c_int, (_DOUBLES,) * 3 + (c_byte,)),
    "dhdGetPositionAndOrientationFrame": (c_int, (_DOUBLES,) * 4 + (c_byte,)),
    "dhdGetButtonMask": (c_uint, (c_byte,)),
    "dhdSetForce": (c_int, (c_double,) * 3 + (c_byte,)),
    "dhdSetForceAndTorque": (c_int, (c_double,) * 6 + (c_byte,)),
    "dhdGetTime": (c_double, ()),
    "dhdErrorGetLastStr": (c_char_p, ()),
}
"""Functions that are called, with the types of result and arguments."""

GRIPPER: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "dhdHasActiveGripper": (c_int, (c_byte,)),
    "dhdGetGripperGap": (c_int, (_DOUBLES, c_byte)),
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

    def is_uncalibrated(self, device: int) -> bool:
        """Returns True if a device waits for its calibration; False also if it reports nothing."""
        flags = (c_int * MAX_STATUS)()
        return int(self["dhdGetStatus"](flags, device)) >= 0 and flags[RESET] == 1

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


# Driver

MEASURED = (
    "mass", "damping", "rotational_inertia", "rotational_damping", "friction", "resolution",
)  # fmt: skip
"""Numbers of the data sheet that are known only from a measurement."""

FARTHEST = 10.0
"""Largest plausible coordinate in m."""


class ForceDimensionDevice:
    """An open Force Dimension device.

    The sheet's ``rate`` is the rate of exchanges of a sample and a force; its ``delay`` is the time
    that 95 % of the exchanges met (``Dhd.timing``). Each limit is the lower of the library's limit
    and the user's or the model's value. The library's mass is the one carried by gravity
    compensation. It is reported to the user and is not the inertia at the handle.

    Args:
        dhd: The library.
        index: Number of the device in the library, from 0.
        gravity: True to enable the maker's gravity compensation.
        numbers: Numbers of the data sheet, by name.
        notify: Receives a description of the device and its settings.

    Attributes:
        effector_mass: Mass carried by gravity compensation in kg; None if unknown.

    Raises:
        DeviceError: The device cannot be opened or waits for its calibration, or a required limit
            is unknown.
        DeviceLost: The device is gone.
    """

    def __init__(
        self,
        dhd: Dhd,
        index: int = 0,
        *,
        gravity: bool = True,
        numbers: Mapping[str, float] | None = None,
        notify: Notify = ignore_message,
    ) -> None:
        self._dhd = dhd
        what = f"Force Dimension device {index} cannot be opened"
        self._id = dhd.require("dhdOpenID", index, what=what)
        self._is_open, self._is_started, self._has_grip = True, False, False
        self._place, self._gap = [c_double() for _ in range(3)], c_double()
        self._frame = (c_double * 9)()
        self._references = [byref(number) for number in self._place]
        self._limited = 0
        with calling_on_error(self.close):
            kind = dhd.require("dhdGetSystemType", self._id, what=what)
            model = MODELS.get(kind, Model(f"Force Dimension device of type {kind}"))
            self._name, self._turns = model.name, model.turns
            if dhd.is_uncalibrated(self._id):
                raise DeviceError(
                    f"{self._name} is not calibrated since its power-on: put its end effector to "
                    "the rest position until its light stops blinking, or run the maker's "
                    "'autoinit', then start again"
                )
            number = c_ushort()
            is_known = dhd["dhdGetSerialNumber"](byref(number), self._id) >= 0
            serial = str(number.value) if is_known else ""
            mass = c_double()
            is_known = dhd["dhdGetEffectorMass"](byref(mass), self._id) >= 0
            self.effector_mass = mass.value if is_known and mass.value > 0.0 else None
            what = f"{self._name}: gravity compensation cannot be set"
            dhd.require("dhdSetGravityCompensation", int(gravity), self._id, what=what)
            known: dict[str, Any] = dict(numbers or {})
            library_limits = [
                float(dhd[call](self._id)) for call in ("dhdGetMaxForce", "dhdGetMaxTorque")
            ]
            limits = limits_of(model, library_limits, known)
            self._has_grip = dhd.has_gripper(self._id, model)
            rate, delay = dhd.timing(lambda: (self._get(), self._send((0.0,) * 7)))
            grip_axis = None
            if self._has_grip:
                grip_axis = DeviceInfo(
                    name=f"grip of {self._name}",
                    axes=AXES[:1],
                    mass=known.get("grip_mass"),
                    damping=known.get("grip_damping"),
                    force_limit=min(known.get("grip_force_limit", GRIP_FORCE), GRIP_FORCE),
                    reach=known.get("grip_travel"),
                    rate=rate,
                    delay=delay,
                )
            self.info = DeviceInfo(
                name=self._name,
                axes=AXES if self._turns else AXES[:3],
                **{name: known[name] for name in MEASURED if name in known},
                force_limit=limits[0],
                torque_limit=limits[1],
                rate=rate,
                delay=delay,
                serial=serial,
                grip_axis=grip_axis,
            )
        carried = "unknown" if self.effector_mass is None else f"{self.effector_mass:g} kg"
        notify(
            f"{self._name}: limits {limits[0]:g} N"
            + (f" and {limits[1]:g} N m" if self._turns else "")
            + f"; gravity compensation {'on' if gravity else 'off'}, end effector {carried}"
        )
        self._notify = notify
        self._sample = np.zeros(1 + self._has_grip, SAMPLE_DTYPE)
        self._sample["quaternion"] = (1.0, 0.0, 0.0, 0.0)
        self._watch = SilenceDetector(dhd.now())

    def start(self, period: float) -> NDArray[np.void]:
        """Sets the watchdog, switches the motors on without force, and reads the pose.

        Raises:
            DeviceError: The period exceeds half of the longest watchdog, or the device reports no
                pose.
            DeviceLost: The device is gone.
        """
        longest = MAX_WATCHDOG * WATCHDOG_STEP
        if checked_period(period) > 0.5 * longest:
            raise DeviceError(
                f"{self._name}: its watchdog ends {1e3 * longest:.3g} ms after a force, so the "
                f"rate must be at least {2.0 / longest:.0f} Hz, not {1 / period:g} Hz"
            )
        steps = min(math.ceil(watchdog_time(period) / WATCHDOG_STEP), MAX_WATCHDOG)
        if not self._dhd.has_watchdog(self._id, steps):
            self._notify(
                f"{self._name} has no watchdog ({self._dhd.last_error()}): its last force would "
                "remain if the program hangs"
            )
        self._send((0.0,) * 7)
        self._require("dhdEnableForce", 1)
        self._limited = 0
        begin = self._dhd.now()
        while self._get() == TIMEGUARD:
            if self._dhd.now() - begin > SILENCE:
                raise DeviceLost(
                    f"{self._name} gives no fresh sample within {1e3 * SILENCE:g} ms of its "
                    "start; check its cable and its power"
                )
        self._fill()
        self._watch = SilenceDetector(self._dhd.now())
        self._is_started = True
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Reads the pose, and the grip into a second sample; blocks as long as the library does.

        Raises:
            DeviceError: The device was not started, or reports an invalid pose.
            DeviceLost: The library reports an error, or no fresh sample for ``SILENCE``.
        """
        if not self._is_started:
            raise DeviceError(f"{self._name} is read before it was started; call start() first")
        is_fresh = self._get() != TIMEGUARD
        now = self._dhd.now()
        if is_fresh:
            self._fill()
        if self._watch.is_silent(now, is_new=is_fresh):
            raise DeviceLost(f"{self._name} has given no fresh sample for {1e3 * SILENCE:g} ms")
        sample[:] = self._sample[: sample.size]
        return 0 if is_fresh else int(TickFlag.STALE_SAMPLE)

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a wrench on the axes that have motors, or with that of the grip; finite."""
        values = [*wrench.ravel()[:7].tolist(), 0.0]
        if not all(map(math.isfinite, values)):
            raise DeviceError(f"{self._name}: a wrench that is not finite was not sent")
        self._limited += self._send(values) == SATURATED

    @property
    def remark(self) -> str:
        """Number of forces that the SDK made smaller, as a clause; empty if there were none."""
        return f"the SDK has limited {self._limited} forces" if self._limited else ""

    def close(self) -> None:
        """Commands zero force, switches the motors off and releases the device."""
        if not self._is_open:
            return
        self._is_open = self._is_started = False
        calls: list[tuple[str, tuple[float, ...]]] = [("dhdSetForce", (0.0, 0.0, 0.0))]
        if self._has_grip:
            calls = [("dhdSetForceAndGripperForce", (0.0, 0.0, 0.0, 0.0))]
        for name, arguments in (*calls, ("dhdEnableForce", (0,)), ("dhdClose", ())):
            self._dhd[name](*arguments, self._id)  # if a call fails, the watchdog ends the force

    def _get(self) -> int:
        """Reads pose and gap; returns the warning of the pose."""
        if self._has_grip:
            self._require("dhdGetGripperGap", byref(self._gap))
        if self._turns:
            name = "dhdGetPositionAndOrientationFrame"
            return self._require(name, *self._references, self._frame)
        return self._require("dhdGetPosition", *self._references)

    def _send(self, values: tuple[float, ...] | list[float]) -> int:
        """Sends force, torque, and the force that closes the grip."""
        if self._has_grip and self._turns:
            wrench = *values[:6], -values[6]
            return self._require("dhdSetForceAndTorqueAndGripperForce", *wrench)
        if self._has_grip:
            return self._require("dhdSetForceAndGripperForce", *values[:3], -values[6])
        if self._turns:
            return self._require("dhdSetForceAndTorque", *values[:6])
        return self._require("dhdSetForce", *values[:3])

    def _require(self, name: str, *arguments: object) -> int:
        if (code := int(self._dhd[name](*arguments, self._id))) < 0:
            raise DeviceLost(f"{self._name} is gone or failed: {self._dhd.last_error()}")
        return code

    def _fill(self) -> None:
        x, y, z = (number.value for number in self._place)
        if not all(abs(value) < FARTHEST for value in (x, y, z)):
            raise DeviceError(
                f"{self._name} reports an impossible position: {x}, {y}, {z} m; each must be "
                f"within {FARTHEST:g} m"
            )
        self._sample["position"][0] = (x, y, z)
        if self._has_grip:
            if not 0.0 <= self._gap.value < FARTHEST:
                raise DeviceError(
                    f"{self._name} reports an impossible gap of its gripper: {self._gap.value} m"
                )
            self._sample["position"][1] = (-self._gap.value, 0.0, 0.0)
        self._sample["buttons"] = self._dhd["dhdGetButtonMask"](self._id) & 0xFFFF
        if self._turns:
            self._sample["quaternion"][0] = checked_rotation(self._frame[:], self._name)


# Discovery of Force Dimension's devices

_GRIP = ("grip_mass", "grip_damping", "grip_force_limit", "grip_travel")
_NUMBERS = (*MEASURED, "force_limit", "torque_limit")


def open_forcedimension(options: Mapping[str, object], notify: Notify) -> ForceDimensionDevice:
    """Loads the library and opens one of its devices.

    The options are ``library`` (its file), ``serial``, ``gravity`` (1 or 0), and numbers of the
    data sheet, with those of the grip: ``grip_mass``, ``grip_damping``, ``grip_force_limit`` and
    ``grip_travel`` in kg, N s/m, N and m. ``serial`` is the device's number in the library's list,
    from 0.

    Raises:
        DeviceError: No library or no device is found, or an option is not valid.
        DeviceLost: The device is gone.
    """
    numbers = stated_numbers(options, _NUMBERS) | {
        name: checked_number(name, options[name], unit, is_positive=True)
        for name, unit in zip(_GRIP, ("kg", "N s/m", "N", "m"), strict=True)
        if options.get(name) is not None
    }
    gravity = stated_switch(options, "gravity")
    dhd = Dhd(FILES.located(options.get("library")))
    device = select_device(DRIVER, _listed(dhd), options.get("serial"))
    return ForceDimensionDevice(
        dhd, int(device.path), gravity=gravity, numbers=numbers, notify=notify
    )


def find() -> list[FoundDevice]:
    """Lists the library's devices, or the kernel's list without the library."""
    try:
        return _listed(Dhd(FILES.located()))
    except DeviceError as error:
        return [
            replace(device, problem=str(error), lacks_permission=False)
            for device in usb_search.find(DRIVER)
        ]


def medium() -> str:
    """Returns a sentence on whether the library was found."""
    try:
        return f"Force Dimension's library was found: {Dhd(FILES.located()).path}"
    except DeviceError as error:
        return str(error)


def _listed(dhd: Dhd) -> list[FoundDevice]:
    return [
        FoundDevice(
            driver="forcedimension",
            name="Force Dimension device",
            serial="",
            path=str(index),
            transport="library",
        )
        for index in range(max(int(dhd["dhdGetDeviceCount"]()), 0))
    ]


DRIVER = Driver(
    name="forcedimension",
    about="Force Dimension omega, delta, sigma and lambda through the maker's library (DHD)",
    ids=(UsbId(0x1451, 0x0402, "Force Dimension omega"),),
    vendor=0x1451,
    transport="library",
    axes="x, y, z; with rx, ry, rz where the wrist has motors, and a grip axis where a gripper has",
    force="the library's limit, else 12 N (omega, sigma, lambda) or 20 N (delta)",
    rate="4 kHz, as stated by the maker",
    on_stall=f"its watchdog ends the force after {1e3 * MIN_WATCHDOG:g} ms; a device without "
    "one is reported at its start",
    options={
        "library": str,
        "serial": str,
        **dict.fromkeys(("gravity", *_NUMBERS, *_GRIP), float),
    },
    open=open_forcedimension,
    find=find,
    medium=medium,
    products="a device of Force Dimension's library",
)
"""Driver of Force Dimension's devices. Not all of their USB products are known, so the library
finds them, and the udev rule is for the vendor as a whole."""
