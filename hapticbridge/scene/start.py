"""Start of a scene, with the handle at the grip."""

from __future__ import annotations

import mujoco

from hapticbridge.kernel.names import HANDLE

START_KEYFRAME = "home"
"""Name of the keyframe that a scene starts from; without it a scene starts from ``qpos0``."""


def go_to_start(model: mujoco.MjModel, data: mujoco.MjData, grip: str) -> None:
    """Resets the data to the start, with the handle at the grip, and calls ``mj_forward``."""
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, START_KEYFRAME)
    if key >= 0:
        mujoco.mj_resetDataKeyframe(model, data, key)
    else:
        mujoco.mj_resetData(model, data)
    # the model's own handle pose may be outdated if its start was changed after loading
    mujoco.mj_kinematics(model, data)
    handle = model.body_mocapid[model.body(HANDLE).id]
    data.mocap_pos[handle] = data.site(grip).xpos
    data.mocap_quat[handle] = data.site_xquat[model.site(grip).id]
    mujoco.mj_forward(model, data)


def seat_handle(model: mujoco.MjModel, grip: str) -> None:
    """Places the handle at the grip, in ``qpos0`` and in every keyframe of a compiled model."""
    data = mujoco.MjData(model)
    body_id, site_id = model.body(HANDLE).id, model.site(grip).id
    mocap_id = int(model.body_mocapid[body_id])
    mujoco.mj_kinematics(model, data)
    model.body_pos[body_id] = data.site_xpos[site_id]
    model.body_quat[body_id] = data.site_xquat[site_id]
    for key in range(model.nkey):
        mujoco.mj_resetDataKeyframe(model, data, key)
        mujoco.mj_kinematics(model, data)
        model.key_mpos[key].reshape(-1, 3)[mocap_id] = data.site_xpos[site_id]
        model.key_mquat[key].reshape(-1, 4)[mocap_id] = data.site_xquat[site_id]
