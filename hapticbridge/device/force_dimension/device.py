"""Force Dimension's omega, delta, sigma and lambda, through the maker's library.

The library is not part of this project; users obtain it from the maker. A call
communicates with the device before it returns. A sample is therefore as old as its call, and a
force acts when its call ends. The sheet's delay is the duration of both calls.

The device's frame is the library's: the origin in the middle of the workspace, x towards the user,
y to the right, z up. A wrist with motors (sigma.7, lambda.7) adds three axes. Its orientation is
read as a matrix (``dhdGetPositionAndOrientationFrame``), because the library's angles are joint
angles. A wrist without motors (omega.6 and omega.7) is ignored: its rotation would put energy into
the scene without a motor to balance it. A gripper with a motor (omega.7, sigma.7, lambda.7) is the
grip axis: x = −gap, so that it rises as the fingers close, and the force on it is that against the
gap. The maker's gravity compensation is on unless ``gravity=0``
is set. It depends on the position only, so it creates no energy.

The driver has not been verified on hardware, nor has the sign of the gripper's force: if it is
reversed, the watch takes the force away (``kernel.swing_watch``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from ctypes import byref, c_double, c_ushort
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import (
    AXES,
    DeviceInfo,
    calling_on_error,
    checked_number,
    checked_period,
    checked_rotation,
    stated_numbers,
    stated_switch,
)
from hapticbridge.device.driver import (
    Driver,
    FoundDevice,
    Notify,
    UsbId,
    ignore_message,
    select_device,
)
from hapticbridge.device.force_dimension.dhd import (
    FILES,
    GRIP_FORCE,
    MAX_WATCHDOG,
    MODELS,
    SATURATED,
    TIMEGUARD,
    WATCHDOG_STEP,
    Dhd,
    Model,
    limits_of,
)
from hapticbridge.device.transport import usb as usb_search
from hapticbridge.device.watchdog import SHORTEST_WATCHDOG, SILENCE, SilenceDetector, watchdog_time
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.record import SAMPLE_DTYPE, TickFlag

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
        saturated: Number of writes that saturated a motor.

    Raises:
        DeviceError: The device cannot be opened, or a required limit is unknown.
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
        self.saturated = 0
        with calling_on_error(self.close):
            kind = dhd.require("dhdGetSystemType", self._id, what=what)
            model = MODELS.get(kind, Model(f"Force Dimension device of type {kind}"))
            self._name, self._turns = model.name, model.turns
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
        self.saturated = 0
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
        self.saturated += self._send(values) == SATURATED

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
        return [replace(device, problem=str(error)) for device in usb_search.find(DRIVER)]


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
    on_stall=f"its watchdog ends the force after {1e3 * SHORTEST_WATCHDOG:g} ms; a device without "
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
