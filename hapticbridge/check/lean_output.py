"""MJCF file of the leanest version, read back and judged again."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterable
from operator import attrgetter
from pathlib import Path, PurePath
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from hapticbridge.check.lean import (
    CREATES,
    IS_FELT,
    MAY_GO,
    NOT_BORNE,
    SAVES_NOTHING,
    WARNS,
    Lean,
    VariantVerdict,
)
from hapticbridge.check.perception import FeltError
from hapticbridge.check.simplify import OTHER_MOTIONS
from hapticbridge.check.version import SceneVariant
from hapticbridge.errors import SceneError
from hapticbridge.kernel.mujoco_c import quiet
from hapticbridge.plotting import new_figure
from hapticbridge.scene import SceneSource, read_scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Plot of cost against felt error


_COLOURS = {
    MAY_GO: "#26a269",
    SAVES_NOTHING: "#5e5c64",
    IS_FELT: "#c01c28",
    CREATES: "#c64600",
    WARNS: "#986a44",
    NOT_BORNE: "#813d9c",
}
_MARKERS = {MAY_GO: "o", SAVES_NOTHING: "s", IS_FELT: "^", CREATES: "X", WARNS: "P", NOT_BORNE: "v"}
_PATH = "#1a5fb4"

LINEAR = 0.01
"""Felt error in JND below which the axis is linear, so that zero can be shown."""

LINE = 0.19
"""Height of a name in inches: 8 points and a gap."""

NAMES = 1.04
"""Left edge of the column of names, in widths of the axes."""


def draw_lean(lean: Lean, name: str) -> Figure:
    """Draws cost against felt error of every version that was tried."""
    tried = [trial for trial in lean.alone if trial.error is not None]
    points = [(trial.name, trial, _COLOURS[trial.verdict]) for trial in tried]
    points += [(f"{k}: {trial.name}", trial, _PATH) for k, trial in enumerate(lean.together, 1)]
    figure = new_figure(8.0, max(4.2, 1.3 + LINE * len(points)))
    axes = figure.add_subplot()
    axes.set_yscale("symlog", linthresh=LINEAR)
    budget = lean.judge.budget
    axes.set_ylim(-0.35 * LINEAR, 2.5 * max([budget, *(trial.jnd for _, trial, _ in points)]))
    axes.set_xlim(0.0, 1.06 * max([104.0, *(trial.percent for _, trial, _ in points)]))
    axes.axvline(100.0, color="0.8", linewidth=1.0, zorder=0)
    for verdict in dict.fromkeys(trial.verdict for trial in tried):
        those = [trial for trial in tried if trial.verdict == verdict]
        axes.plot(
            [trial.percent for trial in those],
            [trial.jnd for trial in those],
            _MARKERS[verdict],
            color=_COLOURS[verdict],
            markersize=6,
            alpha=0.8,
            label=f"alone: {verdict}",
        )
    axes.plot(
        [100.0, *(trial.percent for trial in lean.together)],
        [0.0, *(trial.jnd for trial in lean.together)],
        "D-",
        color=_PATH,
        markersize=6,
        zorder=3,
        label="taken together, in order" if lean.together else None,
    )
    axes.axhline(
        budget, color="black", linewidth=1.0, linestyle="--", label=f"budget: {budget:g} JND"
    )
    _write_names(axes, points)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlabel("cost (processor time, % of the scene as it is)")
    axes.set_ylabel("felt error (just noticeable differences)")
    axes.set_title(f"{name}: what could go without being felt", loc="left", fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _write_names(axes: Axes, points: list[tuple[str, VariantVerdict, str]]) -> None:
    """Writes the names in a column beside the axes, each with a line to its point.

    Names at the points would overlap, because many points coincide.
    """
    order = sorted(points, key=lambda point: (point[1].jnd, -point[1].percent))
    heights = np.linspace(0.0, 1.0, len(order)) if len(order) > 1 else np.array([0.5])
    for height, (name, trial, colour) in zip(heights, order, strict=True):
        axes.annotate(
            name,
            xy=(trial.percent, trial.jnd),
            xytext=(NAMES, float(height)),
            textcoords="axes fraction",
            fontsize=8,
            color=colour,
            va="center",
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.5, "alpha": 0.5},
        )


# Results of a search as JSON facts and CSV

TABLE_ENDING = ".csv"

Row = dict[str, str | float | int | None]


def lean_rows(lean: Lean) -> list[Row]:
    """Returns one row per trial: each alone, those combined, and the final version.

    ``step`` is empty for single trials and counts the combined ones.
    """
    steps = [("", trial) for trial in lean.alone]
    steps += [(str(k), trial) for k, trial in enumerate(lean.together, 1)]
    return [{"step": step, **trial_facts(trial)} for step, trial in [*steps, ("all", lean.result)]]


def trial_facts(trial: VariantVerdict) -> Row:
    """Returns one trial as a dictionary; values that a failed trial lacks are None."""
    error = trial.error
    return {
        "name": trial.name,
        "verdict": trial.verdict,
        "loses": trial.loses,
        "cost_ratio": trial.cost,
        **{n: None if error is None else of_kind(error) for n, of_kind in _ERRORS.items()},
        "environment": trial.environment,
        "mujoco_warnings": trial.warnings,
        "needed_damping_ns_per_m": trial.needed_damping,
        "sentence": trial.sentence,
    }


_ERRORS: dict[str, Callable[[FeltError], float]] = {
    "felt_jnd": attrgetter("jnd"),
    "peak_jnd": attrgetter("peak"),
    "force_rms_n": attrgetter("force_rms"),
    "force_peak_n": attrgetter("force_peak"),
    "force_percent_of_jnd": lambda error: 100.0 * error.force,
    "torque_rms_nm": attrgetter("torque_rms"),
    "torque_peak_nm": attrgetter("torque_peak"),
    "torque_percent_of_jnd": lambda error: 100.0 * error.torque,
    "position_peak_m": attrgetter("position_peak"),
    "angle_peak_rad": attrgetter("angle_peak"),
}


def lean_facts(lean: Lean, written: VariantVerdict | None = None) -> dict[str, object]:
    """Returns the result of a search, for JSON."""
    judge = lean.judge
    return {
        "budget_jnd": judge.budget,
        "motion_s": judge.motion.duration,
        "cost_s_per_tick": judge.seconds * judge.original.setting.period,
        "min_saving": judge.min_saving,
        "device_damping_ns_per_m": judge.device_damping,
        "environment": judge.rehearsal.environment,
        "alone": [trial_facts(trial) for trial in lean.alone],
        "together": [trial_facts(trial) for trial in lean.together],
        "result": trial_facts(lean.result),
        "removable": [trial.name for trial in lean.removable],
        "rate_hz": 1.0 / lean.draft.setting.period,
        "substeps": lean.draft.setting.substeps,
        "written": None if written is None else trial_facts(written),
    }


def check_table(path: Path, scenes: Iterable[Path]) -> None:
    """Checks that a table can be written, before the search starts.

    ``scenes`` are MJCF files, existing or to be written.

    Raises:
        SceneError: Its name does not end in .csv, its folder does not exist, or it would be read as
            a scene's hand motion.
    """
    if path.suffix.lower() != TABLE_ENDING:
        raise SceneError(f"cannot write the table to '{path}': its name must end in {TABLE_ENDING}")
    if not path.absolute().parent.is_dir():
        raise SceneError(f"cannot write the table to '{path}': its folder does not exist")
    for scene in scenes:
        if path.resolve() == scene.with_suffix(TABLE_ENDING).resolve():
            raise SceneError(
                f"'{path}' would be taken for the hand's motion in '{scene.name}'; choose another "
                "name"
            )


def write_table(lean: Lean, path: Path) -> None:
    """Writes the trials as CSV.

    Raises:
        SceneError: The file cannot be written.
    """
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            rows = lean_rows(lean)
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
    except OSError as error:
        raise SceneError(f"cannot write the table to '{path}': {error.strerror}") from None


ENDING = ".xml"


def check_target(source: SceneSource, path: Path, *, overwrite: bool = False) -> None:
    """Checks that a leaner scene can be written, before the search starts.

    Raises:
        SceneError: The file's name does not end in .xml, its folder does not exist, it is a file of
            the scene itself, or it exists and ``overwrite`` is False.
    """
    if path.suffix.lower() != ENDING:
        raise SceneError(f"cannot write the scene to '{path}': its name must end in {ENDING}")
    if path.resolve() in {file.resolve() for file in _files(source)}:
        raise SceneError(f"'{path}' is a file of the scene itself; choose another name")
    if not path.absolute().parent.is_dir():
        raise SceneError(f"cannot write the scene to '{path}': its folder does not exist")
    if path.exists() and not overwrite:
        raise SceneError(f"'{path}' exists; choose another file or add --overwrite")


def write_lean(lean: Lean, path: Path, *, overwrite: bool = False) -> VariantVerdict:
    """Writes the leanest version as MJCF.

    Included files become part of it, asset paths are relative to its folder, and its comment lists
    the changes. MuJoCo writes numbers with 6 digits, so the file differs from the judged version by
    rounding. It is therefore read back and judged again.

    Returns:
        The written scene against the original.

    Raises:
        SceneError: No simplification passed, or the file cannot be written or read back.
    """
    judge, source = lean.judge, lean.draft.source
    check_target(source, path, overwrite=overwrite)
    if not lean.together:
        raise SceneError("no simplification may be made, so there is no leaner scene to write")
    spec = source.spec.copy()
    _point_to_assets(spec, source, path.absolute().parent)
    setting = lean.draft.setting
    spec.option.timestep = setting.period / setting.substeps
    spec.comment = _comment(lean, str(spec.comment or ""))
    try:
        path.write_text(spec.to_xml(), encoding="utf-8")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise SceneError(f"cannot write the scene to '{path}': {reason}") from None
    written = SceneVariant(read_scene(path), lean.draft.grip, setting)
    with quiet():
        return judge.judge(
            "written", "the scene as it was read back from its file", written, is_last_word=True
        )


def _files(source: SceneSource) -> list[Path]:
    """Returns the paths of a scene's files; the first is the main one."""
    depth = len(PurePath(source.sources[0].name).parts)
    root = source.path.absolute().parents[depth - 1]
    return [root / file.name for file in source.sources]


def _point_to_assets(spec: mujoco.MjSpec, source: SceneSource, folder: Path) -> None:
    """Makes the paths of meshes, textures and height fields relative to a folder."""
    files = _files(source)

    def moved(name: str, directory: str) -> str:
        if not name:
            return name
        name = name.replace("\\", "/")
        name = PurePath(name).name if spec.strippath else name
        home = source.path.absolute().parent
        likely = [home / directory / name, home / name]
        likely += [file for file in files if file.as_posix().endswith(f"/{name}")]
        found = next((each for each in likely if each.is_file()), None)
        return name if found is None else Path(os.path.relpath(found, folder)).as_posix()

    for elements, directory in (
        (spec.meshes, spec.meshdir),
        (spec.hfields, spec.meshdir),
        (spec.skins, spec.meshdir),
        (spec.textures, spec.texturedir),
    ):
        for element in elements:
            element.file = moved(str(element.file), str(directory))
    for texture in spec.textures:
        for k, side in enumerate(list(texture.cubefiles)):
            texture.cubefiles[k] = moved(str(side), str(spec.texturedir))
    spec.modelfiledir = str(folder)
    spec.meshdir = spec.texturedir = ""
    spec.strippath = False


def _comment(lean: Lean, before: str) -> str:
    """Returns the list of changes; XML forbids two dashes in a row within a comment."""
    source, setting, result = lean.draft.source, lean.draft.setting, lean.result
    judge = lean.judge
    lines = [
        "",
        f"  Made leaner from {source.path.name} by 'hapticbridge check': in a motion of "
        f"{judge.motion.duration:g} s it costs {result.percent:.0f} % of that scene,",
        f"  and differs by {result.jnd:.2g} just noticeable differences "
        f"(allowed: {judge.budget:g}).",
        *(f"  Taken: {trial.name} ({trial.sentence})." for trial in lean.together),
    ]
    if any(trial.loses == OTHER_MOTIONS for trial in lean.together):
        lines.append("  Another motion may miss what this one did not need.")
    if setting != lean.judge.original.setting:
        lines.append(
            f"  To be run at {1 / setting.period:g} Hz with {setting.substeps} substep(s) a tick; "
            f"the device then needs {result.needed_damping:.3g} N s/m of damping."
        )
    text = "\n".join([*lines, "  "]).replace("--", "- -")
    return f"{before.rstrip()}\n{text}" if before.strip() else text
