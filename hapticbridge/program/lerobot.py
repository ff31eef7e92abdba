"""LeRobot 0.4: a haptic device as a teleoperator, for its command lines and for loops of your own.

The action is the handle's pose with the names of LeRobot's processors for the end effector:
``ee.x``, ``ee.y``, ``ee.z`` in m, ``ee.wx``, ``ee.wy``, ``ee.wz`` as a rotation vector in rad, and
``ee.gripper_pos``. Feedback is the robot's end effector with these names; an observation that has
them among others will do. ``lerobot-record`` and ``lerobot-teleoperate`` send no feedback: the hand
then moves the robot, and feels nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from numpy.typing import NDArray

from hapticbridge.errors import HapticBridgeError
from hapticbridge.program.device_loop import DeviceLoop
from hapticbridge.program.poses import quaternion_about, turn_between

POSE_NAMES = ("ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz")
"""Names of position in m and rotation vector in rad."""

GRIPPER_NAME = "ee.gripper_pos"
"""Name of the gripper's opening."""

CLOSE = 1
"""Bit of the button that closes the gripper while it is held."""

_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(kw_only=True)
class HapticDeviceConfig(TeleoperatorConfig):  # type: ignore[misc]  # LeRobot has no types
    """Configuration of a haptic device.

    Attributes:
        device: Device as for ``DeviceLoop``.
        recording: File to write (``.mcap``).
        is_simulated: True for simulated time.
        python: Interpreter of the environment that has the loop.
        open_gripper: Value of ``ee.gripper_pos`` for an open gripper; 0 is closed.
        start: Pose of the robot's end effector at the start, 6 numbers as in the action, for
            programs that send no feedback. Without it the first feedback has to come before the
            first action, because the action is a place to which the robot goes.
        options: Options of ``hapticbridge serve``, as ``{scale: 2, scene_rate: 30}``.
    """

    device: str = "simulated"
    recording: Path | None = None
    is_simulated: bool = False
    python: str | None = None
    open_gripper: float = 100.0
    start: list[float] = field(default_factory=list)
    options: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.start) not in (0, len(POSE_NAMES)):
            raise HapticBridgeError(
                f"start has {len(self.start)} numbers; it needs those of {', '.join(POSE_NAMES)}"
            )


class HapticDevice(Teleoperator):  # type: ignore[misc]
    """Haptic device as a teleoperator of LeRobot.

    Args:
        config: Its configuration.

    Attributes:
        loop: Loop of the device while it is connected, else None.
    """

    config_class = HapticDeviceConfig
    name = "hapticbridge"

    def __init__(self, config: HapticDeviceConfig) -> None:
        self.loop: DeviceLoop | None = None
        super().__init__(config)
        self.config = config
        self._has_feedback = False

    @property
    def action_features(self) -> dict[str, type]:
        """Names and types of the action."""
        return dict.fromkeys((*POSE_NAMES, GRIPPER_NAME), float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """Names and types of the feedback."""
        return dict.fromkeys(POSE_NAMES, float)

    @property
    def is_connected(self) -> bool:
        """True while the loop runs."""
        return self.loop is not None

    @property
    def is_calibrated(self) -> bool:
        """True: the device is calibrated by its driver."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Starts the loop, and waits until it runs."""
        del calibrate
        if self.loop is not None:
            raise DeviceAlreadyConnectedError
        config = self.config
        self.loop = DeviceLoop(
            config.device,
            recording=config.recording,
            is_simulated=config.is_simulated,
            python=config.python,
            **config.options,
        ).open()
        self._has_feedback = False
        if config.start:
            self.loop.show(_pose(np.array(config.start)))

    def calibrate(self) -> None:
        """Does nothing: the device is calibrated by its driver."""

    def configure(self) -> None:
        """Does nothing: the configuration has all options."""

    def get_action(self) -> dict[str, float]:
        """Returns the handle's pose, and closes the gripper while the button is held.

        Raises:
            HapticBridgeError: Neither feedback nor ``start`` says where the robot is.
        """
        loop = self._open_loop()
        if not (self._has_feedback or self.config.start):
            raise HapticBridgeError(
                "it is not known where the robot is: send feedback before the first action, or set "
                "start to the pose of its end effector"
            )
        handle = loop.pose()
        if not self._has_feedback:  # the handle itself is shown, and moves freely
            loop.show(np.append(handle.position, handle.quaternion), handle.velocity)
        turn = turn_between(_UPRIGHT, handle.quaternion)
        action = dict(zip(POSE_NAMES, map(float, (*handle.position, *turn)), strict=True))
        opening = 0.0 if handle.buttons & CLOSE else self.config.open_gripper
        return action | {GRIPPER_NAME: opening}

    def send_feedback(self, feedback: Mapping[str, Any]) -> None:
        """Shows the robot's end effector to the hand; the first one puts the handle there.

        Raises:
            HapticBridgeError: A number of the pose is missing.
        """
        loop = self._open_loop()
        missing = [name for name in POSE_NAMES if name not in feedback]
        if missing:
            raise HapticBridgeError(f"the feedback has no {', '.join(missing)}")
        numbers = np.array([float(feedback[name]) for name in POSE_NAMES])
        loop.show(_pose(numbers), is_placed=not self._has_feedback)
        self._has_feedback = True

    def disconnect(self) -> None:
        """Ends the force, and closes the recording."""
        self._open_loop().close()
        self.loop = None

    def _open_loop(self) -> DeviceLoop:
        if self.loop is None:
            raise DeviceNotConnectedError
        return self.loop


def _pose(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.append(numbers[:3], quaternion_about(numbers[3:]))
