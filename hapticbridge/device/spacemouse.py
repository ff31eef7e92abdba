"""3Dconnexion SpaceMouse: six axes of input as a rate of motion, without motors."""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import (
    AXES,
    USUAL_FORCE_LIMIT,
    USUAL_TORQUE_LIMIT,
    DeviceInfo,
    checked_number,
    checked_period,
)
from hapticbridge.device.driver import Driver, Notify, UsbId
from hapticbridge.device.transport.hid import HidApi, HidLink, opened
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.pose import Quaternion, canonical, product, quaternion_exp
from hapticbridge.kernel.record import SAMPLE_DTYPE

# Products of the SpaceMouse family

_LOGITECH = {
    0xC603: "SpaceMouse Plus XT",
    0xC605: "CadMan",
    0xC606: "SpaceMouse Classic",
    0xC621: "Spaceball 5000",
    0xC623: "SpaceTraveler",
    0xC625: "SpacePilot",
    0xC626: "SpaceNavigator",
    0xC627: "SpaceExplorer",
    0xC628: "SpaceNavigator for Notebooks",
    0xC629: "SpacePilot Pro",
    0xC62B: "SpaceMouse Pro",
}

_3DCONNEXION = {
    0xC62E: "SpaceMouse Wireless (cable)",
    0xC62F: "SpaceMouse Wireless (receiver)",
    0xC631: "SpaceMouse Pro Wireless (cable)",
    0xC632: "SpaceMouse Pro Wireless (receiver)",
    0xC633: "SpaceMouse Enterprise",
    0xC635: "SpaceMouse Compact",
    0xC636: "SpaceMouse Module",
    0xC638: "SpaceMouse Pro Wireless (Bluetooth)",
    0xC63A: "SpaceMouse Wireless (Bluetooth)",
    0xC641: "SpaceMouse Module (USB)",
    0xC652: "Universal Receiver",
}

IDS = (
    *(UsbId(0x046D, product, model) for product, model in _LOGITECH.items()),
    *(UsbId(0x256F, product, model) for product, model in _3DCONNEXION.items()),
)
"""All products: Logitech's ids first, then 3Dconnexion's. The CadMouse models (256f: c650, c651,
c654 to c658, c664, c665, c668) are two-dimensional mice and are left out. Source: spacenavd of
December 2025 and pyspacemouse of June 2026."""


# Input reports of a SpaceMouse

FULL_SCALE = 350
"""Counts at full deflection of the puck (spacenavd, 2025). Slightly larger counts can come and are
clamped."""

MAX_BUTTON_BYTES = 6
"""Bytes of buttons that are read. A SpaceMouse Enterprise has 31 buttons; 48 bits fit into a
record's integer."""

LED_ON, LED_OFF = bytes([4, 1]), bytes([4, 0])
"""Output report 4: the light in the base."""

_TRANSLATION, _ROTATION, _BUTTONS = 1, 2, 3
"""Numbers of the input reports."""
_THREE, _SIX = struct.Struct("<3h"), struct.Struct("<6h")


class Deflection(NamedTuple):
    """Deflection of the puck along or about some of its axes.

    The maker's axes: x to the right, y towards the user, z down; rotations about them.

    Attributes:
        first: Index of the first axis in (x, y, z, rx, ry, rz): 0, or 3 for rotations alone.
        counts: 3 or 6 signed numbers.
    """

    first: int
    counts: tuple[int, ...]


class Buttons(NamedTuple):
    """Pressed buttons.

    Attributes:
        bits: One bit per button; the assignment differs between models.
    """

    bits: int


def decoded(report: bytes) -> Deflection | Buttons | None:
    """Decodes one report, its number first; None for an unknown report.

    Report 1 is the translation; with 13 bytes (wireless models, the receiver, newer firmware) it
    holds translation and rotation. Report 2 is the rotation of older wired models, which send both
    in pairs. The layouts are distinguished by length, because one product was sold with both.
    """
    if len(report) < 2:
        return None
    number = report[0]
    if number == _BUTTONS:
        return Buttons(int.from_bytes(report[1 : 1 + MAX_BUTTON_BYTES], "little"))
    if number == _TRANSLATION and len(report) >= 1 + _SIX.size:
        return Deflection(0, _SIX.unpack_from(report, 1))
    if number in (_TRANSLATION, _ROTATION) and len(report) >= 1 + _THREE.size:
        return Deflection(3 * (number - 1), _THREE.unpack_from(report, 1))
    return None


def deflection(count: int, dead_band: float) -> float:
    """Returns the deflection of a reported count, −1 to 1 of full scale, 0 within the dead band d.

        sign(c) · max(0, |c| − d)/(1 − d),    c = count/350 clamped to ±1,    0 <= d < 1

    It is continuous at the edge of the dead band.
    """
    size = min(abs(count) / FULL_SCALE, 1.0)
    if size <= dead_band:
        return 0.0
    return (size - dead_band) / (1.0 - dead_band) * (1.0 if count > 0 else -1.0)


SPEED, TURN = 0.05, 0.8
"""Default speed in m/s and turn rate in rad/s at full deflection. They cover 10 cm, the reach of a
desktop device, and a quarter of a turn in two seconds."""

DEAD_BAND = 0.05
"""Share of full deflection that counts as rest, without unit: 17 counts. A push along one axis
moves the others by some per cent, and a worn puck does not return to zero."""

HELD = 0.5
"""Time without a report after which a deflection counts as zero, in s. A deflected puck repeats its
report some hundred times a second; a silent one is out of radio range and must not move the tool.
Not verified on hardware."""

# The maker's y points to the user and z down, the bridge's y away and z up. This is half a turn
# about x, which maps rotations and translations alike.
_TO_BRIDGE = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])


@dataclass(frozen=True, slots=True)
class RateControl:
    """Motion that a deflection sets.

    Attributes:
        speed: Speed in m/s at full deflection of one axis, > 0.
        turn: Turn rate in rad/s at full deflection of one axis, > 0.
        dead_band: Share of full deflection that counts as rest, 0 <= dead_band < 1.

    Raises:
        DeviceError: A number is out of range.
    """

    speed: float = SPEED
    turn: float = TURN
    dead_band: float = DEAD_BAND

    def __post_init__(self) -> None:
        checked_number("speed", self.speed, "m/s", is_positive=True)
        checked_number("turn", self.turn, "rad/s", is_positive=True)
        if checked_number("dead_band", self.dead_band, "of full deflection") >= 1.0:
            raise DeviceError(
                f"dead_band is {self.dead_band!r}; it must be below 1, which is full scale"
            )


DEFAULT_CONTROL = RateControl()
"""Usual speeds."""


class SpaceMouseDevice:
    """A handle that moves while the puck is deflected, at a proportional speed.

        p ← p + v T,   R ← exp(ω T) R

    v and ω follow from the deflection beyond the dead band, both in the frame of the base: x to the
    right, y away from the user, z up. R is composed exactly. The motion is prescribed and does not
    react to force; the wrench on the tool is shown and recorded. A puck at rest sends nothing, so
    silence does not mean that it is unplugged.

    Args:
        link: Open link for its reports.
        name: Name of the device.
        control: Motion that a deflection sets.
        force_limit: Force limit of the data sheet in N, > 0; it limits the recorded wrench.
        torque_limit: Torque limit of the data sheet in N m, > 0; it limits the recorded wrench.

    Raises:
        DeviceError: A number is out of range.
    """

    def __init__(
        self,
        link: HidLink,
        name: str = "spacemouse",
        control: RateControl = DEFAULT_CONTROL,
        *,
        force_limit: float = USUAL_FORCE_LIMIT,
        torque_limit: float = USUAL_TORQUE_LIMIT,
    ) -> None:
        self._link, self._name, self._control = link, name, control
        self._full = _TO_BRIDGE * np.repeat([control.speed, control.turn], 3)
        self.info = DeviceInfo(
            name=name,
            axes=AXES,
            force_limit=force_limit,
            torque_limit=torque_limit,
            speed_limit=math.sqrt(3.0) * control.speed,  # all three axes at full deflection
            is_prescribed=True,
            is_real=False,
        )
        self._period = 0.0
        self._is_open, self._has_begun = True, False
        self._to_origin()

    def start(self, period: float) -> NDArray[np.void]:
        """Places the handle at the origin and switches the light on."""
        self._period = checked_period(period)
        self._link.take()
        self._to_origin()
        self._turn((0.0, 0.0, 0.0))  # compiles before the loop
        self._light(LED_ON)
        sample = np.zeros(1, SAMPLE_DTYPE)
        self._fill(sample)
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        """Moves the handle by one period (not at the first call) and returns its pose.

        The result is always 0, because the pose is that of this tick, with or without a report.
        """
        if self._period == 0.0:
            raise DeviceError(f"{self._name} is read before it was started; call start() first")
        if self._has_begun:
            self._silence += self._period
            if self._silence > HELD:
                self._rate[:] = 0.0
            self._position += self._period * self._rate[:3]
            x, y, z = (self._period * self._rate[3:]).tolist()
            self._turn((x, y, z))
        self._has_begun = True
        for report in self._link.take():
            self._take(report)
        self._fill(sample)
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Ignores the wrench, because there is no motor."""

    def close(self) -> None:
        """Switches the light off and releases the device."""
        if self._is_open:
            self._is_open = False
            self._light(LED_OFF)
            self._link.close()

    def _to_origin(self) -> None:
        self._position, self._rate = np.zeros(3), np.zeros(6)
        self._quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._buttons, self._silence = 0, 0.0
        self._has_begun = False

    def _take(self, report: bytes) -> None:
        news = decoded(report)
        if isinstance(news, Deflection):
            last = news.first + len(news.counts)
            deflections = [deflection(count, self._control.dead_band) for count in news.counts]
            self._rate[news.first : last] = self._full[news.first : last] * deflections
            self._silence = 0.0
        elif isinstance(news, Buttons):
            self._buttons = news.bits

    def _turn(self, angle: tuple[float, float, float]) -> None:
        self._quaternion = canonical(product(quaternion_exp(angle), self._quaternion))

    def _fill(self, sample: NDArray[np.void]) -> None:
        sample[0] = (self._position, self._quaternion, self._buttons)

    def _light(self, report: bytes) -> None:
        """Switches the light; models without one are ignored."""
        with contextlib.suppress(DeviceError):
            self._link.write(report)


def open_spacemouse(
    options: Mapping[str, object], _notify: Notify, api: HidApi | None = None
) -> SpaceMouseDevice:
    """Finds and opens a SpaceMouse; options are ``serial``, ``log`` and numbers of the device."""
    numbers: dict[str, Any] = dict(options)  # checked by the device
    control = RateControl(**{name: numbers[name] for name in _CONTROL if name in numbers})
    limits = {name: numbers[name] for name in _LIMITS if name in numbers}
    # not overlapped: reports are written only before and after the loop
    with opened(DRIVER, options, api, is_overlapped=False) as (plugged, link):
        device = SpaceMouseDevice(link, plugged.name, control, **limits)
    device.info = replace(device.info, serial=plugged.serial)
    return device


_CONTROL, _LIMITS = ("speed", "turn", "dead_band"), ("force_limit", "torque_limit")

DRIVER = Driver(
    name="spacemouse",
    about="3Dconnexion SpaceMouse and earlier models: input only, its rate moves the handle",
    ids=IDS,
    transport="hid",
    axes="6; deflection sets velocity",
    force="none (input only)",
    rate="about 125 Hz",
    options={"serial": str, "log": str, **dict.fromkeys((*_CONTROL, *_LIMITS), float)},
    open=open_spacemouse,
)
