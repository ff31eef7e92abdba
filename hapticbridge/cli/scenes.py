"""``hapticbridge scenes``."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import tyro
from rich.table import Table

from hapticbridge.cli.terminal import out, plain
from hapticbridge.scene import load_scene, scene_names, scene_parameters, scene_path


@dataclass(frozen=True, slots=True)
class Scenes:
    """List the scenes that come with hapticbridge, or the parameters of one.

    Any of them, or any MJCF file, can be given to 'hapticbridge run', and its parameters set with
    '--set'. Example:

        hapticbridge scenes peg_in_hole
    """

    scene: tyro.conf.Positional[str | None] = None
    """An MJCF file, or a scene's name: show its parameters with unit, range and default."""

    def execute(self) -> int:
        """Prints the table; returns the exit code."""
        if self.scene is not None:
            return _show(self.scene)
        table = Table("scene", "about", "parameters", box=None, pad_edge=False)
        for name in scene_names():
            settable = ", ".join(p.name for p in scene_parameters(scene_path(name)))
            table.add_row(name, _about(load_scene(name).model), settable)
        out.print(table)
        out.print("next: hapticbridge scenes NAME (its parameters), hapticbridge run NAME")
        return 0


def _show(scene: str) -> int:
    """Prints what one scene is and what can be set in it."""
    path = scene_path(scene)
    model, parameters = load_scene(path).model, scene_parameters(path)
    sentence, moving = _about(model), int((model.body_dofnum > 0).sum())
    out.print(f"[bold]{plain(path.stem)}[/bold]" + (f": {plain(sentence)}" if sentence else ""))
    bodies = "body" if moving == 1 else "bodies"
    freedom = "degree" if model.nv == 1 else "degrees"
    out.print(f"{moving} moving {bodies}, {model.nv} {freedom} of freedom; {plain(str(path))}")
    if not parameters:
        out.print("no parameters")
        return 0
    table = Table("parameter", "default", "range", "unit", "about", box=None, pad_edge=False)
    for parameter in parameters:
        low, high = parameter.minimum, parameter.maximum
        table.add_row(
            parameter.name,
            f"{parameter.default:g}",
            f"{low:g} to {high:g}",
            plain(parameter.unit),
            plain(parameter.about),
        )
    out.print(table)
    first, asked = parameters[0], plain(scene)
    out.print(f"next: hapticbridge run {asked} --set {first.name}={first.minimum:g}")
    return 0


def _about(model: mujoco.MjModel) -> str:
    """Returns the sentence that a scene carries as custom text ``about``."""
    text_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, "about")
    if text_id < 0:
        return ""
    start, size = model.text_adr[text_id], model.text_size[text_id]
    return bytes(model.text_data[start : start + size - 1]).decode()
