"""Results of a search as JSON facts and CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

from hapticbridge.check.lean import Lean
from hapticbridge.check.trial import Trial
from hapticbridge.errors import SceneError

ENDING = ".csv"

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


def trial_facts(trial: Trial) -> dict[str, str | float | int | None]:
    """Returns one trial as a dictionary; values that a failed trial lacks are None."""
    felt = trial.felt
    return {
        "name": trial.name,
        "sentence": trial.sentence,
        "verdict": trial.verdict,
        "loses": trial.loses,
        "cost_ratio": trial.cost,
        "felt_jnd": None if felt is None else felt.felt,
        "peak_jnd": None if felt is None else felt.peak,
        "force_rms_n": None if felt is None else felt.force_rms,
        "force_peak_n": None if felt is None else felt.force_peak,
        "force_percent_of_jnd": None if felt is None else 100.0 * felt.force,
        "torque_rms_nm": None if felt is None else felt.torque_rms,
        "torque_peak_nm": None if felt is None else felt.torque_peak,
        "torque_percent_of_jnd": None if felt is None else 100.0 * felt.torque,
        "position_peak_m": None if felt is None else felt.position_peak,
        "angle_peak_rad": None if felt is None else felt.angle_peak,
        "environment": trial.environment,
        "mujoco_warnings": trial.warnings,
        "needed_damping_ns_per_m": trial.needed_damping,
    }


def lean_facts(lean: Lean, written: Trial | None = None) -> dict[str, object]:
    """Returns the result of a search, for JSON."""
    judge = lean.judge
    return {
        "budget_jnd": judge.budget,
        "motion_s": judge.motion.duration,
        "cost_s_per_tick": judge.seconds * judge.original.setting.period,
        "least_saving": judge.least_saving,
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
    if path.suffix.lower() != ENDING:
        raise SceneError(f"cannot write the table to '{path}': its name must end in {ENDING}")
    if not path.absolute().parent.is_dir():
        raise SceneError(f"cannot write the table to '{path}': its folder does not exist")
    for scene in scenes:
        if path.resolve() == scene.with_suffix(ENDING).resolve():
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
