"""``hapticbridge scenes`` and ``hapticbridge new-scene``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from hapticbridge.arguments import option
from hapticbridge.cli.terminal import compiling, out, plain, print_written
from hapticbridge.device import DEFAULT_HAND, scene_hand
from hapticbridge.errors import SceneError
from hapticbridge.scene import (
    custom_text,
    load_scene,
    plain_model,
    read_scene,
    scene_names,
    scene_parameters,
    scene_path,
)


@dataclass(frozen=True, slots=True)
class Scenes:
    """List the scenes, or the parameters of one.

    Any scene of the list, or any MJCF file, can be given to 'hapticbridge run', and its parameters
    set with '--set'.

    Example:
        hapticbridge scenes peg_in_hole
    """

    scene: str | None = option(None, metavar="SCENE", is_positional=True)
    """An MJCF file, or a scene's name: show its parameters with unit, range and default."""

    def execute(self) -> int:
        """Prints the table; returns the exit code."""
        if self.scene is not None:
            return _show(self.scene)
        table = Table("scene", "about", "parameters", box=None, pad_edge=False)
        for name in scene_names():
            settable = ", ".join(p.name for p in scene_parameters(scene_path(name)))
            table.add_row(name, custom_text(load_scene(name).model, "about"), settable)
        out.print(table)
        out.print("next: hapticbridge scenes NAME (its parameters), hapticbridge run NAME")
        return 0


def _show(scene: str) -> int:
    """Prints what one scene is and what can be set in it."""
    path = scene_path(scene)
    # without load_scene, because the grip may have any name here
    with compiling(scene):
        model, parameters = plain_model(read_scene(path)), scene_parameters(path)
    hand = scene_hand(model, path)
    sentence, moving = custom_text(model, "about"), int((model.body_dofnum > 0).sum())
    out.print(f"[bold]{plain(path.stem)}[/bold]" + (f": {plain(sentence)}" if sentence else ""))
    bodies = "body" if moving == 1 else "bodies"
    freedom = "degree" if model.nv == 1 else "degrees"
    out.print(f"{moving} moving {bodies}, {model.nv} {freedom} of freedom; {plain(str(path))}")
    if path.with_suffix(".csv").is_file() or hand != DEFAULT_HAND:
        out.print(
            f"simulated hand: {hand.stiffness:g} N/m and {hand.damping:g} N s/m, "
            f"{hand.rotational_stiffness:g} N m/rad and {hand.rotational_damping:g} N m s/rad"
        )
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
    first, name = parameters[0], plain(scene)
    out.print(f"next: hapticbridge run {name} --set {first.name}={first.minimum:g}")
    return 0


TEMPLATE = Path(__file__).parent.parent / "templates" / "scene"
"""Files of a new scene, with NAME in place of its name."""


@dataclass(frozen=True, slots=True)
class NewScene:
    """Write a commented scene to start from.

    A folder with the MJCF of a tool and a fixture, a hand's motion, a parameter and a page.

    Example:
        hapticbridge new-scene my_tool
    """

    name: str = option(metavar="NAME", is_positional=True)
    """Name of the scene: small letters, digits and _, a letter first. The folder has it, too; it
    must not exist."""

    def execute(self) -> int:
        """Writes the files; returns the exit code."""
        if not re.fullmatch(r"[a-z][a-z0-9_]{0,63}", self.name):
            raise SceneError(
                f"'{self.name:.80}' is no name for a scene; use up to 64 small letters, digits and "
                "_, a letter first"
            )
        if self.name in scene_names():
            raise SceneError(f"a shipped scene is called '{self.name}'; choose another name")
        folder = Path(self.name)
        try:
            folder.mkdir()
        except FileExistsError:
            raise SceneError(f"'{folder}' exists; choose another name") from None
        for source in sorted(TEMPLATE.iterdir()):
            path = folder / source.name.replace("scene.", f"{self.name}.")
            text = source.read_text(encoding="utf-8").replace("NAME", self.name)
            path.write_text(text, encoding="utf-8")
            print_written(path)
        out.print(f"next: hapticbridge run {folder / self.name}.xml")
        return 0
