"""robosuite 1.5: a haptic device for its teleoperation and its recording of demonstrations.

robosuite's OSC controllers take a step of the end effector, in the frame of the robot's base:

    a = clip(R_bᵀ (h ⊖ x + v_h d / k) / s, −1, 1)

with h and v_h the handle's pose and velocity, x the pose from which the controller counts, R_b the
base's orientation, k and d the controller's gains, and s its largest step in m and rad. It brakes
an arm by d times its velocity, so without v_h the arm would follow d / k late: 0.16 s by default.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from robosuite.controllers.parts.arm.osc import OperationalSpaceController
from robosuite.devices import Device

from hapticbridge.errors import HapticBridgeError
from hapticbridge.program.device_loop import DeviceLoop
from hapticbridge.program.poses import offset_between, pose_of

Array = NDArray[np.float64]

GRASP, RESET = 1, 2
"""Bits of the button that closes the gripper while it is held, and of the one that ends a trial."""


class HapticDevice(Device):  # type: ignore[misc]  # robosuite has no types
    """Haptic device in front of the active arm, whose end effector is shown to the hand.

    Args:
        env: Environment of robosuite with an OSC_POSE controller in each arm.
        loop: Open loop of the device; give it ``scene_rate=env.control_freq``.
    """

    def __init__(self, env: Any, loop: DeviceLoop) -> None:
        super().__init__(env)
        self._loop, self._shown_arm = loop, ""
        self._reset_internal_state()

    def start_control(self) -> None:
        """Puts the handle where the end effector is, as after a reset of the environment."""
        self._reset_internal_state()
        self._shown_arm = ""
        self._show(self._controller())

    def get_controller_state(self) -> dict[str, Any]:
        """Shows the end effector, and returns the step that leads it to the handle."""
        controller = self._controller()
        self._show(controller)
        handle = self._loop.pose()
        pose = np.append(handle.position, handle.quaternion)
        is_in_base = controller.input_ref_frame == "base"
        origin = np.eye(4)
        if is_in_base:
            origin[:3, :3], origin[:3, 3] = controller.origin_ori, controller.origin_pos
        counted = np.eye(4)
        counted[:3, :3] = controller.compute_goal_ori(np.zeros(3))
        counted[:3, 3] = controller.compute_goal_pos(np.zeros(3))
        step = offset_between(pose_of(origin @ counted, np.zeros(4)), pose)
        step += handle.velocity * controller.kd / controller.kp
        move, turn = step[:3] @ origin[:3, :3], step[3:] @ origin[:3, :3]
        return {
            "dpos": move,
            "rotation": handle.matrix[:3, :3],
            # robosuite swaps and mirrors these for a gripper that looks down
            "raw_drotation": np.array([turn[1], turn[0], -turn[2]]),
            "grasp": bool(handle.buttons & GRASP),
            "reset": bool(handle.buttons & RESET),
            "base_mode": int(self.base_mode),
        }

    def _postprocess_device_outputs(self, dpos: Array, drotation: Array) -> tuple[Array, Array]:
        step = np.append(dpos, drotation) / self._controller().output_max
        step = np.clip(step, -1.0, 1.0)
        return step[:3], step[3:]

    def _show(self, controller: Any) -> None:
        controller.update(force=True)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = controller.ref_ori_mat, controller.ref_pos
        arm = f"{self.active_robot} {self.active_arm}"
        self._loop.show(
            pose,
            np.append(controller.ref_pos_vel, controller.ref_ori_vel),
            is_placed=arm != self._shown_arm,
        )
        self._shown_arm = arm

    def _controller(self) -> Any:
        controller = self.env.robots[self.active_robot].part_controllers[self.active_arm]
        if not isinstance(controller, OperationalSpaceController) or not controller.use_ori:
            raise HapticBridgeError(
                f"the controller of arm '{self.active_arm}' is {controller.name}; a haptic device "
                "needs OSC_POSE"
            )
        return controller
