"""How ``hapticbridge check --lean`` looks for less, and says what it found."""

from __future__ import annotations

import shlex
from pathlib import Path

from hapticbridge.check.case import Case
from hapticbridge.check.draft import Setting
from hapticbridge.check.lean import Lean, find_lean
from hapticbridge.check.simplifications import OTHER_MOTIONS
from hapticbridge.check.trial import MAY_GO, Trial
from hapticbridge.cli.terminal import err, out, plain, progress
from hapticbridge.quantity import quantity

_HEADINGS = ("alone", "cost", "JND", "force, RMS", "peak", "torque, RMS", "tool off by")
"""Of the table; JND: felt error in just noticeable differences."""

_ROUNDING = 1e-9  # N and N m; what is below is how the computer adds


def look_for_lean(case: Case, budget: float) -> Lean:
    """Tries what could go, with progress on stderr.

    Raises:
        SceneError: The scene cannot be run as it is, or the budget is out of range.
    """
    with progress("leaner") as show:
        damping = case.info.damping or 0.0
        return find_lean(
            case.source,
            case.scene.grip,
            case.motion,
            Setting(case.coupling, case.period),
            budget=budget,
            device_damping=damping / case.scale**2,
            progress=show,
        )


def print_lean(lean: Lean) -> None:
    """Prints what could go, and how far it leads together."""
    judge = lean.judge
    tick = 1e6 * judge.seconds * judge.original.setting.period
    out.print(
        f"\n[bold]What could go[/] (felt up to {judge.budget:g} just noticeable differences; "
        f"the scene as it is: {tick:.3g} µs a tick)"
    )
    rows = [_numbers(trial) for trial in (*lean.alone, *lean.together)]
    ends = [_verdict(trial) for trial in lean.alone] + [plain(t.loses) for t in lean.together]
    widths = [max(map(len, column)) for column in zip(_HEADINGS, *rows, strict=True)]
    for number, (row, end) in enumerate(zip([_HEADINGS, *rows], ["", *ends], strict=True)):
        if number == len(lean.alone) + 1:
            out.print("  [bold]together, in order[/]")
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        cells[0] = row[0].ljust(widths[0])
        out.print(f"  {plain('  '.join(cells))}  {end}".rstrip())
    for trial in lean.alone:
        if trial.felt is None:
            out.print(f"  {plain(trial.name)}: {plain(trial.sentence)}")
    if not lean.together:
        out.print("  [green]nothing may go: the scene is lean[/]")
        return
    if any(trial.loses == OTHER_MOTIONS for trial in lean.together):
        out.print(
            "  [yellow]another motion may miss what this one did not need[/]: judge it by one that "
            "does all that the hand will do"
        )
    setting = lean.draft.setting
    if setting != judge.original.setting:
        out.print(
            f"  at {1 / setting.period:.4g} Hz, {setting.substeps} substep(s) a tick: the device "
            f"needs {lean.result.needed_damping:.3g} N s/m of damping"
        )
    cost = lean.result.cost or 1.0
    out.print(f"  all together: {100 * cost:.0f} % of the cost, {1 / cost:.2g} times as fast")


def print_written(lean: Lean, written: Trial, path: Path, *, is_quiet: bool) -> None:
    """Prints what the written scene is like, read back, and how to run it."""
    felt = 0.0 if written.felt is None else written.felt.felt
    cost = written.cost or 1.0
    err.print(
        f"wrote {plain(str(path))}: read back, {100 * cost:.0f} % of the cost, felt {felt:.2g} JND"
    )
    if is_quiet:
        return
    setting, asked = lean.draft.setting, lean.judge.original.setting
    command = f"hapticbridge run {shlex.quote(str(path))}"
    if lean.draft.grip != "grip":
        command += f" --grip {shlex.quote(lean.draft.grip)}"
    if setting.period != asked.period:
        command += f" --rate {1 / setting.period:g}"
    out.print(f"next: {plain(command)}")


def _verdict(trial: Trial) -> str:
    colour = "green" if trial.verdict == MAY_GO else "bright_black"
    loses = f" {plain(trial.loses)}" if trial.verdict == MAY_GO and trial.loses else ""
    return f"[{colour}]{trial.verdict}{loses}[/]"


def _numbers(trial: Trial) -> list[str]:
    felt = trial.felt
    if felt is None or trial.cost is None:
        return [trial.name, *["-"] * 6]
    return [
        trial.name,
        f"{100 * trial.cost:.0f} %",
        f"{felt.felt:.3f}",
        *(
            quantity(0.0 if value < _ROUNDING else value, unit)
            for value, unit in (
                (felt.force_rms, "N"),
                (felt.force_peak, "N"),
                (felt.torque_rms, "N m"),
            )
        ),
        f"{1e6 * felt.position_peak:.0f} µm",
    ]
