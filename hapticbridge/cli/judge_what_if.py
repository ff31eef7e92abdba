"""How ``hapticbridge audit --what-if`` prints runs side by side."""

from __future__ import annotations

from rich.table import Table

from hapticbridge.cli.terminal import err, out, plain
from hapticbridge.whatif import WhatIf
from hapticbridge.whatif.side_by_side import changes, rows, sentences


def print_what_if(found: WhatIf) -> None:
    """Prints what was changed, the runs side by side, and what to know of them."""
    for name, before, after in changes(found):
        out.print(plain(f"{name}: {before} -> {after}"))
    table = Table(box=None, pad_edge=False)
    table.add_column(plain(found.path.name))
    for run in found.runs:
        table.add_column(run.name)
    for name, texts in rows(found):
        table.add_row(name, *map(plain, texts))
    out.print(table)
    for run in found.runs[1:]:
        for text in sentences(run):
            out.print(f"{run.name}: {plain(text)}")
    for condition in found.runs[-1].report.conditions:
        out.print(plain(condition))
    for note in found.notes:
        err.print(f"note: {plain(note)}")
