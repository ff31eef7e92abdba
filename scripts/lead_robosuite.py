"""Lead robosuite's arms to a handle that is moved and turned; ``scripts/interfaces`` runs it.

The bases of two robots that face each other are turned by a quarter each, so a step in a wrong
frame does not arrive. The exit code is 1 if an arm does not.
"""

from __future__ import annotations

import sys
from typing import Any, cast

import numpy as np
import robosuite
from numpy.typing import ArrayLike, NDArray
from robosuite.controllers import load_composite_controller_config

from hapticbridge.program.device_loop import DeviceLoop, Handle
from hapticbridge.program.poses import matrix_of, offset_between, pose_of, quaternion_about
from hapticbridge.program.robosuite import HapticDevice

MOVE, TURN = np.array([0.05, -0.06, 0.06]), np.array([0.16, 0.32, -0.16])
"""Motion of the handle from the end effector, in m and rad."""

REACHED = 0.05
"""Largest distance from the handle at the end, in m and in rad. A wrong frame leaves 0.4."""


class MovedHandle:
    """Handle that stands beside the place where the end effector was put."""

    def __init__(self) -> None:
        self.shown, self.target = np.zeros(7), np.zeros(7)

    def show(self, pose: ArrayLike, velocity: ArrayLike, *, is_placed: bool = False) -> None:
        """Takes the end effector's pose, and the handle's from where it was put."""
        del velocity
        self.shown = pose_of(pose, np.zeros(4))
        if is_placed:
            target = np.eye(4)
            target[:3, :3] = matrix_of(quaternion_about(TURN)) @ matrix_of(self.shown[3:])
            target[:3, 3] = self.shown[:3] + MOVE
            self.target = pose_of(target, np.zeros(4))

    def pose(self) -> Handle:
        """Returns the handle, whose first button is held."""
        return Handle(self.target[:3], self.target[3:], np.zeros(6), 1, np.nan, np.zeros(6), True)


def distance(name: str, robots: str | list[str], number: int) -> NDArray[np.float64]:
    """Returns what an arm lacks to the handle after 3 s, in m and rad, (6,)."""
    env: Any = robosuite.make(
        name,
        robots=robots,
        controller_configs=load_composite_controller_config(controller="BASIC"),
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
    )
    env.reset()
    handle = MovedHandle()
    device = HapticDevice(env, cast(DeviceLoop, handle))
    device.start_control()
    device.active_robot = number
    for _ in range(60):
        action = device.input2action()
        vectors = [np.zeros(robot.action_dim) for robot in env.robots]
        chosen = action | {"right": action["right_delta"]}
        vectors[number] = env.robots[number].create_action_vector(chosen)
        env.step(np.concatenate(vectors))
    env.close()
    return offset_between(handle.shown, handle.target)


gaps = [
    np.abs(distance(name, robots, number)).max()
    for name, robots, number in (
        ("Lift", "Panda", 0),
        ("TwoArmLift", ["Panda", "Panda"], 0),
        ("TwoArmLift", ["Panda", "Panda"], 1),
    )
]
print("largest distance at the end:", ", ".join(f"{gap:.4f}" for gap in gaps))
sys.exit(1 if max(gaps) > REACHED else 0)
