"""Gymnasium: a haptic device for an environment with MuJoCo inside.

The wrapper shows a site or body of the scene to the hand after each step, and turns the handle into
the environment's action. It is made for gymnasium-robotics, Gymnasium's own MuJoCo environments,
and dm_control through Shimmy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.errors import HapticBridgeError
from hapticbridge.program.device_loop import DeviceLoop, Handle
from hapticbridge.program.poses import offset_between, pose_of

Array = NDArray[np.float64]

FETCH_STEP = 0.05
"""Largest step in m of the gripper of gymnasium-robotics' Fetch: its action 1."""


def fetch_action(offset: Array, handle: Handle) -> Array:
    """Returns the action of gymnasium-robotics' Fetch; bit 0 of the buttons closes the gripper.

    Args:
        offset: Translation in m and rotation vector in rad from the gripper to the handle, (6,).
        handle: The handle.
    """
    return np.append(offset[:3] / FETCH_STEP, -1.0 if handle.buttons & 1 else 1.0)


class HapticWrapper(gymnasium.Wrapper):  # type: ignore[misc]
    """Environment in which a hand holds a site or body of the scene.

    ``step`` takes any action: the hand's, or a learner's, which the hand then feels.

        env = HapticWrapper(gymnasium.make("FetchReach-v4"), loop, "robot0:grip")
        env.reset()
        env.step(env.hand_action())

    Args:
        env: Environment with MuJoCo inside.
        loop: Open loop of the device; give it the environment's ``scene_rate``.
        tool: Site of the scene that the hand holds, else body.
        action: Function of the offset from the tool to the handle in m and rad, (6,), and the
            handle, which returns an action; it is clipped to the action space.

    Raises:
        HapticBridgeError: There is no MuJoCo scene, or it has no such tool.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        loop: DeviceLoop,
        tool: str,
        action: Callable[[Array, Handle], ArrayLike] = fetch_action,
    ) -> None:
        super().__init__(env)
        self._loop, self._action = loop, action
        model, _ = _scene(env)
        for kind in (mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY):
            self._kind, self._id = kind, mujoco.mj_name2id(model, kind, tool)
            if self._id >= 0:
                break
        else:
            names = ", ".join(model.site(i).name for i in range(model.nsite))
            raise HapticBridgeError(
                f"the scene has no site and no body '{tool}'; its sites are: {names or 'none'}"
            )

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Resets the environment, and puts the handle where the tool is."""
        result: tuple[Any, dict[str, Any]] = self.env.reset(**options)
        self._show(is_placed=True)
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the environment, and shows the tool to the hand."""
        result: tuple[Any, Any, bool, bool, dict[str, Any]] = self.env.step(action)
        self._show(is_placed=False)
        return result

    def hand_action(self) -> NDArray[Any]:
        """Returns the action that leads the tool to the handle."""
        handle, space = self._loop.pose(), self.action_space
        offset = offset_between(self._pose(), np.append(handle.position, handle.quaternion))
        action = np.clip(self._action(offset, handle), space.low, space.high)
        return np.asarray(action, dtype=space.dtype)

    def _pose(self) -> Array:
        data = _scene(self.env)[1]
        tool = (
            data.site(self._id) if self._kind == mujoco.mjtObj.mjOBJ_SITE else data.body(self._id)
        )
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = tool.xmat.reshape(3, 3), tool.xpos
        return pose_of(pose, np.zeros(4))

    def _show(self, *, is_placed: bool) -> None:
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(*_scene(self.env), self._kind, self._id, velocity, 0)
        self._loop.show(self._pose(), np.roll(velocity, 3), is_placed=is_placed)


def _scene(env: gymnasium.Env[Any, Any]) -> tuple[Any, Any]:
    """Returns an environment's model and data; dm_control makes new ones at each reset."""
    inner = env.unwrapped
    physics = getattr(getattr(inner, "_env", None), "physics", None)
    if physics is not None:
        return physics.model.ptr, physics.data.ptr
    try:
        return inner.model, inner.data
    except AttributeError:
        raise HapticBridgeError(f"there is no MuJoCo scene in {type(inner).__name__}") from None
