"""``hapticbridge scenes``."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
from rich.table import Table

from hapticbridge.cli.terminal import out
from hapticbridge.scene import load_scene, scene_names


@dataclass(frozen=True, slots=True)
class Scenes:
    """List the scenes that come with hapticbridge.

    Any of them, or any MJCF file, can be given to 'hapticbridge run'. Example:

        hapticbridge scenes
    """

    def execute(self) -> int:
        """Prints the table; returns the exit code."""
        table = Table(
            "scene", "moving bodies", "degrees of freedom", "about", box=None, pad_edge=False
        )
        for name in scene_names():
            model = load_scene(name).model
            moving = int((model.body_dofnum > 0).sum())
            table.add_row(name, str(moving), str(model.nv), _about(model))
        out.print(table)
        return 0


def _about(model: mujoco.MjModel) -> str:
    """Returns the sentence that a scene carries as custom text ``about``."""
    text_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, "about")
    if text_id < 0:
        return ""
    start, size = model.text_adr[text_id], model.text_size[text_id]
    return bytes(model.text_data[start : start + size - 1]).decode()
