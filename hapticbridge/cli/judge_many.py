"""How ``hapticbridge audit`` prints a table of many recordings."""

from __future__ import annotations

import math
from collections import Counter

from hapticbridge.audit import verdict_words
from hapticbridge.audit.batch import UNREADABLE
from hapticbridge.cli.terminal import err, out, plain
from hapticbridge.sweep.results import Table

_COLOURS = {"passive": "green", "active": "red", "invalid": "magenta", UNREADABLE: "magenta"}


def print_audits(table: Table) -> None:
    """Prints a line per recording, worst first, why those fail that do, and how many of each."""
    verdicts, margins = table.texts("verdict"), table.numbers("margin")
    columns = [table.texts(name) for name in ("environment", "port", "file", "reason")]
    durations, cut = table.numbers("duration"), table.numbers("is_cut")
    codes = table.numbers("exit_code")
    out.print(f"{'margin':>8}  {'verdict':<22} {'s':>8}  recording")
    for row, verdict in enumerate(verdicts):
        environment, port, file, reason = (str(column[row]) for column in columns)
        margin = "-" if math.isnan(margins[row]) else f"{margins[row]:.3g}"
        duration = "-" if math.isnan(durations[row]) else f"{durations[row]:.3f}"
        words = verdict_words(verdict, environment, port)
        told = f"[{_COLOURS[verdict]}]{words}[/]" + " " * max(22 - len(words), 0)
        name = plain(file) + (" [yellow](cut)[/]" if cut[row] == 1 else "")
        out.print(f"{margin:>8}  {told} {duration:>8}  {name}")
        if codes[row]:
            out.print(f"{'':>10}{_why(verdict, reason, str(table.texts('certified')[row]))}")
    counts = Counter(verdicts)
    told = ", ".join(f"{counts[verdict]} {verdict}" for verdict in _COLOURS if counts[verdict])
    out.print(f"{len(table)} recording{'s' if len(table) > 1 else ''}: {told}")


def print_unreadable(table: Table) -> None:
    """Names on stderr what was passed over."""
    for verdict, reason in zip(table.texts("verdict"), table.texts("reason"), strict=True):
        if verdict == UNREADABLE:
            err.print(f"[red]error:[/red] {plain(' '.join(str(reason).splitlines()))}")


def _why(verdict: str, reason: str, certified: str) -> str:
    if verdict == "passive" and certified == "no":
        return "the device has less damping than the coupling needs"
    return plain(" ".join(reason.splitlines()))
