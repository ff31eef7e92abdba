"""What a scene's file says about itself in ``<custom>``: texts and lists of numbers, by name.

Three names mean something here, each may be missing: the text ``about`` is a sentence on what the
scene is, the number ``picture`` the second of the hand path at which it is drawn, and the numbers
``simulated_hand`` are who performs the path (``device.scene_hand``).
"""

from __future__ import annotations

import mujoco


def custom_text(model: mujoco.MjModel, name: str) -> str:
    """Returns the custom text of a name; empty where the scene has none."""
    text_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, name)
    if text_id < 0:
        return ""
    start, size = model.text_adr[text_id], model.text_size[text_id]
    return bytes(model.text_data[start : start + size - 1]).decode()


def custom_numbers(model: mujoco.MjModel, name: str) -> tuple[float, ...]:
    """Returns the custom numbers of a name, finite or not; nothing where the scene has none."""
    number_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if number_id < 0:
        return ()
    start, size = model.numeric_adr[number_id], model.numeric_size[number_id]
    return tuple(model.numeric_data[start : start + size].tolist())
