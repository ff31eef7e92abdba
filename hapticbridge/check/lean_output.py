"""MJCF file of the leanest version, read back and judged again."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable
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
from hapticbridge.check.observe import quiet
from hapticbridge.check.simplify import OTHER_MOTIONS
from hapticbridge.check.version import SceneVariant
from hapticbridge.errors import SceneError
from hapticbridge.plotting import new_figure
from hapticbridge.scene import SceneSource, read_scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D


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
    points = [(trial.name, trial, "") for trial in lean.alone if trial.error is not None]
    steps = [(f"{k + 1}: {t.name}", t, "path") for k, t in enumerate(lean.together)]
    points += steps
    figure = new_figure(8.0, max(4.2, 1.3 + LINE * len(points)))
    axes = figure.add_subplot()
    axes.set_yscale("symlog", linthresh=LINEAR)
    errors = [_error_of(trial) for _, trial, _ in points]
    axes.set_ylim(-0.35 * LINEAR, 2.5 * max([lean.judge.budget, *errors]))
    costs = [100.0 * _cost(trial) for _, trial, _ in points]
    axes.set_xlim(0.0, 1.06 * max([104.0, *costs]))
    axes.axhline(lean.judge.budget, color="black", linewidth=1.0, linestyle="--")
    axes.axvline(100.0, color="0.8", linewidth=1.0, zorder=0)
    _draw_path(axes, lean)
    for _, trial, kind in points:
        if not kind:
            axes.plot(
                100.0 * _cost(trial),
                _error_of(trial),
                _MARKERS[trial.verdict],
                color=_COLOURS[trial.verdict],
                markersize=6,
                alpha=0.8,
            )
    _write_names(axes, points)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlabel("cost (processor time, % of the scene as it is)")
    axes.set_ylabel("felt error (just noticeable differences)")
    axes.set_title(f"{name}: what could go without being felt", loc="left", fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(
        handles=_legend(points, lean),
        loc="outside lower center",
        ncols=3,
        fontsize=8,
        frameon=False,
    )
    return figure


def _error_of(trial: VariantVerdict) -> float:
    return 0.0 if trial.error is None else trial.error.jnd


def _cost(trial: VariantVerdict) -> float:
    return 1.0 if trial.cost is None else trial.cost


def _draw_path(axes: Axes, lean: Lean) -> None:
    x = [100.0, *(100.0 * _cost(trial) for trial in lean.together)]
    y = [0.0, *(_error_of(trial) for trial in lean.together)]
    axes.plot(x, y, "-", color=_PATH, linewidth=1.5, zorder=1)
    axes.plot(x, y, "D", color=_PATH, markersize=6, zorder=3)


def _write_names(axes: Axes, points: list[tuple[str, VariantVerdict, str]]) -> None:
    """Writes the names in a column beside the axes, each with a line to its point.

    Names at the points would overlap, because many points coincide.
    """
    order = sorted(points, key=lambda point: (_error_of(point[1]), -_cost(point[1])))
    heights = np.linspace(0.0, 1.0, len(order)) if len(order) > 1 else np.array([0.5])
    for height, (name, trial, kind) in zip(heights, order, strict=True):
        colour = _PATH if kind else _COLOURS[trial.verdict]
        axes.annotate(
            name,
            xy=(100.0 * _cost(trial), _error_of(trial)),
            xytext=(NAMES, float(height)),
            textcoords="axes fraction",
            fontsize=8,
            color=colour,
            va="center",
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.5, "alpha": 0.5},
        )


def _legend(points: list[tuple[str, VariantVerdict, str]], lean: Lean) -> list[Line2D]:
    from matplotlib.lines import Line2D  # noqa: PLC0415 - for a picture alone

    verdicts = list(dict.fromkeys(trial.verdict for _, trial, kind in points if not kind))
    handles = [
        Line2D(
            [],
            [],
            marker=_MARKERS[verdict],
            color=_COLOURS[verdict],
            linestyle="",
            label=f"alone: {verdict}",
        )
        for verdict in verdicts
    ]
    if lean.together:
        handles.append(Line2D([], [], marker="D", color=_PATH, label="taken together, in order"))
    budget = f"budget: {lean.judge.budget:g} JND"
    return [*handles, Line2D([], [], color="black", linestyle="--", label=budget)]


# Results of a search as JSON facts and CSV

TABLE_ENDING = ".csv"

COLUMNS = (
    "step",
    "name",
    "verdict",
    "loses",
    "cost_ratio",
    "felt_jnd",
    "peak_jnd",
    "force_rms_n",
    "force_peak_n",
    "force_percent_of_jnd",
    "torque_rms_nm",
    "torque_peak_nm",
    "torque_percent_of_jnd",
    "position_peak_m",
    "angle_peak_rad",
    "environment",
    "mujoco_warnings",
    "needed_damping_ns_per_m",
    "sentence",
)
"""Columns of the CSV table. ``step`` is empty for single trials and counts the combined ones."""


def lean_rows(lean: Lean) -> list[dict[str, str | float | int | None]]:
    """Returns one row per trial: each alone, those combined, and the final version."""
    steps = [("", trial) for trial in lean.alone]
    steps += [(str(k + 1), trial) for k, trial in enumerate(lean.together)]
    return [trial_facts(trial) | {"step": step} for step, trial in [*steps, ("all", lean.result)]]


def trial_facts(trial: VariantVerdict) -> dict[str, str | float | int | None]:
    """Returns one trial as a dictionary; values that a failed trial lacks are None."""
    error = trial.error
    return {
        "name": trial.name,
        "sentence": trial.sentence,
        "verdict": trial.verdict,
        "loses": trial.loses,
        "cost_ratio": trial.cost,
        "felt_jnd": None if error is None else error.jnd,
        "peak_jnd": None if error is None else error.peak,
        "force_rms_n": None if error is None else error.force_rms,
        "force_peak_n": None if error is None else error.force_peak,
        "force_percent_of_jnd": None if error is None else 100.0 * error.force,
        "torque_rms_nm": None if error is None else error.torque_rms,
        "torque_peak_nm": None if error is None else error.torque_peak,
        "torque_percent_of_jnd": None if error is None else 100.0 * error.torque,
        "position_peak_m": None if error is None else error.position_peak,
        "angle_peak_rad": None if error is None else error.angle_peak,
        "environment": trial.environment,
        "mujoco_warnings": trial.warnings,
        "needed_damping_ns_per_m": trial.needed_damping,
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
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(lean_rows(lean))
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
    main = source.path.absolute()
    root = main
    for _ in PurePath(source.sources[0].name).parts:
        root = root.parent
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
        sides = [moved(str(side), str(spec.texturedir)) for side in texture.cubefiles]
        for k, side in enumerate(sides):
            texture.cubefiles[k] = side
    spec.modelfiledir = str(folder)
    spec.meshdir = spec.texturedir = ""
    spec.strippath = False


def _comment(lean: Lean, before: str) -> str:
    """Returns the list of changes; XML forbids two dashes in a row within a comment."""
    source, setting, result = lean.draft.source, lean.draft.setting, lean.result
    error = 0.0 if result.error is None else result.error.jnd
    judge, cost = lean.judge, 100.0 * (result.cost or 1.0)
    lines = [
        "",
        f"  Made leaner from {source.path.name} by 'hapticbridge check': in a motion of "
        f"{judge.motion.duration:g} s it costs {cost:.0f} % of that scene,",
        f"  and differs by {error:.2g} just noticeable differences (allowed: {judge.budget:g}).",
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
