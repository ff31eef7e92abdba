"""Leanest version of a scene: JSON facts, and an MJCF file that is read back and judged again."""

from __future__ import annotations

import os
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path, PurePath

import mujoco

from hapticbridge.check.lean import Lean, VariantVerdict
from hapticbridge.check.perception import FeltError
from hapticbridge.check.simplify import OTHER_MOTIONS
from hapticbridge.check.version import SceneVariant
from hapticbridge.errors import SceneError
from hapticbridge.files import check_target, reason_of, refuse_existing
from hapticbridge.kernel.mujoco_c import quiet
from hapticbridge.scene import SceneSource, read_scene
from hapticbridge.scene.handle import set_step
from hapticbridge.units import format_number


def trial_facts(trial: VariantVerdict) -> dict[str, str | float | int | None]:
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


ENDING = ".xml"


def check_lean_target(source: SceneSource, path: Path, *, overwrite: bool = False) -> None:
    """Checks that a leaner scene can be written, before the search starts.

    Raises:
        SceneError: The file's name does not end in .xml, it cannot be made, it is a file of the
            scene itself, or it exists and ``overwrite`` is False.
    """
    if path.suffix.lower() != ENDING:
        raise SceneError(f"cannot write the scene to '{path}': its name must end in {ENDING}")
    if path.resolve() in {file.resolve() for file in _files(source)}:
        raise SceneError(f"'{path}' is a file of the scene itself; choose another name")
    check_target(path, SceneError)
    refuse_existing(path, SceneError, overwrite=overwrite)


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
    check_lean_target(source, path, overwrite=overwrite)
    if not lean.together:
        raise SceneError("no simplification may be made, so there is no leaner scene to write")
    spec = source.spec.copy()
    _point_to_assets(spec, source, path.absolute().parent)
    setting = lean.draft.setting
    set_step(spec, setting.period / setting.substeps)
    spec.comment = _comment(lean, str(spec.comment or ""))
    try:
        path.write_text(spec.to_xml(), encoding="utf-8")
    except (OSError, ValueError) as error:
        words = " ".join(str(error).split())
        reason = reason_of(error, path) if isinstance(error, OSError) else words
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
        f"  and differs by {format_number(result.jnd, 2)} just noticeable differences (allowed: "
        f"{judge.budget:g}).",
        *(f"  Taken: {trial.name} ({trial.sentence})." for trial in lean.together),
    ]
    if any(trial.loses == OTHER_MOTIONS for trial in lean.together):
        lines.append("  Another motion may miss what this one did not need.")
    if setting != lean.judge.original.setting:
        lines.append(
            f"  To be run at {1 / setting.period:g} Hz with {setting.substeps} substep(s) a tick; "
            f"the device then needs {format_number(result.needed_damping, 3)} N s/m of damping."
        )
    text = "\n".join([*lines, "  "]).replace("--", "- -")
    return f"{before.rstrip()}\n{text}" if before.strip() else text
