"""How ``hapticbridge audit --what-if`` prints runs side by side."""

from __future__ import annotations

from rich.table import Table

from hapticbridge.cli.terminal import err, out, plain
from hapticbridge.quantity import quantity
from hapticbridge.whatif import WhatIf, WhatIfRun

_PEAK_UNITS = {"force": "N", "torque": "N m", "stretch": "m"}


def print_what_if(found: WhatIf) -> None:
    """Prints what was changed, the runs side by side, and what to know of them."""
    for name, unit, before, after in found.changes:
        out.print(plain(f"{name}: {_told(before)} -> {_told(after)} {unit}".rstrip()))
    table = Table(box=None, pad_edge=False)
    table.add_column(plain(found.path.name))
    for run in found.runs:
        table.add_column(run.name)
    table.add_row("verdict", *map(_verdict, found.runs))
    for name in found.runs[0].peaks:
        unit = _PEAK_UNITS[name.split()[0]]
        table.add_row(f"peak {name}", *(quantity(run.peaks[name], unit) for run in found.runs))
    for name in found.runs[0].report.energies:
        joules = [run.report.energies.get(name, 0.0) for run in found.runs]
        if any(joules):
            table.add_row(name.replace("_", " "), *(quantity(e, "J") for e in joules))
    table.add_row("slack used", *(f"{run.report.slack_share:.0%}" for run in found.runs))
    table.add_row("device bears it", *map(_certified, found.runs))
    table.add_row("ran", *(f"{run.report.duration:.3f} s" for run in found.runs))
    out.print(table)
    for run in found.runs[1:]:
        said = run.report.reason if run.report.verdict != "passive" else ""
        for text in (said, run.trip and f"tripped: {run.trip}"):
            if text:
                out.print(f"{run.name}: {plain(text)}")
    for condition in found.runs[-1].report.conditions:
        out.print(plain(condition))
    for note in found.notes:
        err.print(f"note: {plain(note)}")


def _verdict(run: WhatIfRun) -> str:
    report = run.report
    words = f"{report.verdict} ({report.environment})" if report.environment else report.verdict
    return f"{words}, tripped" if run.trip else words


def _certified(run: WhatIfRun) -> str:
    return {True: "yes", False: "no", None: "not judged"}[run.report.certified]


def _told(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else "none" if value is None else str(value)
