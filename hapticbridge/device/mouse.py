"""A handle in the view that is dragged with the pointer: a prescribed hand, without force."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import is_number
from hapticbridge.device.base import (
    AXES,
    USUAL_FORCE_LIMIT,
    USUAL_TORQUE_LIMIT,
    DeviceInfo,
    checked_number,
    checked_period,
)
from hapticbridge.device.driver import Driver, Notify
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.pose import (
    Quaternion,
    Vector,
    canonical,
    product,
    quaternion_exp,
    rotation_between,
    scaled,
)
from hapticbridge.kernel.record import SAMPLE_DTYPE

Pose = tuple[float, float, float, float, float, float, float]
"""Position x, y, z in m and orientation as a unit quaternion qw, qx, qy, qz, in the device's
frame."""

FARTHEST = 10.0
"""Largest coordinate in m that a page may send."""

BUTTONS = 4
"""Number of states of the two buttons on the page."""

# Wire format between the page's process and the bridge


class Drag(NamedTuple):
    """A drag of the hand on the page.

    Attributes:
        pose: Pose to go to.
        buttons: Bits of the buttons that are held.
    """

    pose: Pose
    buttons: int = 0


def line_of_drag(drag: Drag) -> bytes:
    """Returns it as a line of JSON."""
    pose = [float(f"{value:.9g}") for value in drag.pose]
    return json.dumps({"hand": pose, "buttons": drag.buttons}).encode() + b"\n"


def drag_of_line(line: bytes) -> Drag | None:
    """Returns what a line says, its quaternion normalized; None if the line holds no pose."""
    try:
        told = json.loads(line)
        values, buttons = told["hand"], told["buttons"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    if not isinstance(values, list) or len(values) != 7 or not all(map(is_number, values)):
        return None
    if not all(abs(value) <= FARTHEST for value in values):
        return None
    size = math.hypot(*values[3:])
    if not 0.5 <= size <= 2.0:
        return None
    if buttons not in range(BUTTONS):
        return None
    x, y, z = (float(value) for value in values[:3])
    qw, qx, qy, qz = (value / size for value in values[3:])
    return Drag((x, y, z, qw, qx, qy, qz), int(buttons))


# The device

SPEED, TURN = 0.5, 6.0
"""Largest speed of the hand in m/s, and turn rate in rad/s: those of a brisk hand. A pointer jumps
across the window at once; a hand that followed it would tear the coupling."""

SMOOTHING = 0.04
"""Time constant in s of each of two low passes. A page sends 30 poses a second; without smoothing
each would be a step."""

REST: Pose = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


class MouseDevice:
    """A hand that follows the pose to which a handle on the page is dragged.

    The target passes two low passes of first order, x' = (u − x)/τ, and the hand moves no faster
    than ``speed`` and ``TURN``. The motion is prescribed and does not react to force; the force on
    the tool is shown and recorded. Any program may set the target by ``aim``.

    Args:
        speed: Largest speed in m/s, > 0.

    Attributes:
        info: Its data sheet.

    Raises:
        DeviceError: The speed is out of range.
    """

    def __init__(self, speed: float = SPEED) -> None:
        self._speed = checked_number("speed", speed, "m/s", is_positive=True)
        self.info = DeviceInfo(
            name="mouse",
            axes=AXES,
            force_limit=USUAL_FORCE_LIMIT,
            torque_limit=USUAL_TORQUE_LIMIT,
            speed_limit=self._speed,
            is_prescribed=True,
            is_real=False,
        )
        self._period, self._has_begun = 0.0, False
        self._position, self._between = np.zeros(3), np.zeros(3)
        self._to_origin()

    def aim(self, pose: Pose, buttons: int = 0) -> None:
        """Sets the pose to go to and the bits of held buttons, from any thread."""
        self._target, self._buttons = pose, buttons

    def start(self, period: float) -> NDArray[np.void]:
        """Places the hand at the origin.

        Raises:
            DeviceError: The period is not valid.
        """
        self._period = checked_period(period)
        self._to_origin()
        self._turn(REST[3:])  # compiles before the loop
        sample = np.zeros(1, SAMPLE_DTYPE)
        self._fill(sample)
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        """Moves the hand by one period (not at the first call) and returns its pose.

        The result is always 0, because the pose is that of this tick.
        """
        if self._period == 0.0:
            raise DeviceError("mouse is read before it was started; call start() first")
        if self._has_begun:
            target = self._target
            share = -math.expm1(-self._period / SMOOTHING)
            self._between += share * (np.array(target[:3]) - self._between)
            step = share * (self._between - self._position)
            self._position += step * _limited(
                float(np.linalg.norm(step)), self._speed, self._period
            )
            self._turn(target[3:])
        self._has_begun = True
        self._fill(sample)
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Ignores the wrench, because there is no motor."""

    def close(self) -> None:
        """Does nothing: the view belongs to the run."""

    def _to_origin(self) -> None:
        self._target, self._buttons, self._has_begun = REST, 0, False
        self._position[:] = self._between[:] = 0.0
        self._quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._half_turned = self._quaternion

    def _turn(self, target: Quaternion) -> None:
        share = -math.expm1(-self._period / SMOOTHING)
        way: Vector = scaled(share, rotation_between(self._half_turned, target))
        self._half_turned = canonical(product(quaternion_exp(way), self._half_turned))
        step: Vector = scaled(share, rotation_between(self._quaternion, self._half_turned))
        slower = _limited(math.hypot(*step), TURN, self._period)
        turn = quaternion_exp(scaled(slower, step))
        self._quaternion = canonical(product(turn, self._quaternion))

    def _fill(self, sample: NDArray[np.void]) -> None:
        sample[0] = (self._position, self._quaternion, self._buttons)


def _limited(step: float, rate: float, period: float) -> float:
    """Returns the factor by which a step must be shortened to keep a rate."""
    return min(1.0, rate * period / step) if step > 0.0 else 1.0


def open_mouse(options: Mapping[str, object], _notify: Notify) -> MouseDevice:
    """Returns the device; the option is ``speed``."""
    speed = options.get("speed", SPEED)
    return MouseDevice(speed)  # type: ignore[arg-type] # checked by the device


DRIVER = Driver(
    name="mouse",
    about="a handle in the view, dragged with the pointer: to try a scene without a device",
    ids=(),
    transport="view",
    axes="6; by hand in the browser",
    force="none (shown, not felt)",
    rate="about 30 Hz, smoothed",
    options={"speed": float},
    open=open_mouse,
    find=list,
    products="a browser",
)
