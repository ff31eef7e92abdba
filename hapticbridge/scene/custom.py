"""Custom texts and numbers of a scene (``<custom>`` in MJCF), by name."""

from __future__ import annotations

import mujoco


def custom_text(model: mujoco.MjModel, name: str) -> str:
    """Returns the custom text of a name; empty if the scene has none.

    The bridge uses the text ``about``, a sentence that describes the scene.
    """
    text_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, name)
    if text_id < 0:
        return ""
    start, size = model.text_adr[text_id], model.text_size[text_id]
    return bytes(model.text_data[start : start + size - 1]).decode()


def custom_numbers(model: mujoco.MjModel, name: str) -> tuple[float, ...]:
    """Returns the custom numbers of a name, finite or not; empty if the scene has none.

    The bridge uses ``picture``, the time in s on the hand path at which the scene is drawn. It also
    uses ``simulated_hand``, the hand that follows the path (``device.simulated.scene_hand``).
    """
    number_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if number_id < 0:
        return ()
    start, size = model.numeric_adr[number_id], model.numeric_size[number_id]
    return tuple(model.numeric_data[start : start + size].tolist())
