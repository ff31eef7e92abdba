"""``hapticbridge doctor``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Annotated

import tyro
from rich.table import Table

from hapticbridge.cli.terminal import out, plain, print_json, progress
from hapticbridge.realtime.doctor import Diagnosis, diagnose

_MARKS = {True: "[green]good[/green]", False: "[yellow]mend[/yellow]", None: "note"}


@dataclass(frozen=True, slots=True)
class Doctor:
    """Measure whether this machine holds the loop's rate.

    Says what stands in the way. Needs no device and moves no motor. The exit code is 1 where the
    verdict is 'unfit'.

    Example:
        hapticbridge doctor --rate 2000 --duration 60
    """

    rate: float = 1000.0
    """Ticks per second."""
    duration: float = 20.0
    """Seconds to measure; the loops that are compared take turns."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the diagnosis as JSON."""

    def execute(self) -> int:
        """Measures and prints; returns the exit code."""
        with progress(f"measuring for {self.duration:g} s") as show:
            diagnosis = diagnose(self.rate, self.duration, progress=_in_tenths(show))
        if self.as_json:
            print_json(asdict(diagnosis))
        else:
            _print(diagnosis)
        return 1 if diagnosis.verdict == "unfit" else 0


def _in_tenths(show: Callable[..., None]) -> Callable[[float, float], None]:
    return lambda done, whole: show(round(10 * done), round(10 * whole))


def _print(diagnosis: Diagnosis) -> None:
    table = Table(box=None, pad_edge=False)
    for heading in ("lateness in µs", "p50", "p99", "p99.9", "max", "missed"):
        table.add_column(heading, justify="left" if heading.startswith("late") else "right")
    for name, late in diagnosis.lateness.items():
        numbers = (late.median, late.p99, late.p999, late.worst)
        share = f"{late.missed} of {late.ticks + late.missed}"
        table.add_row(name, *(f"{value * 1e6:.0f}" for value in numbers), share)
    out.print(table)
    for finding in diagnosis.findings:
        out.print(f"{_MARKS[finding.is_good]}  {finding.name}: {plain(finding.sentence)}")
        if finding.remedy and finding.is_good is not True:
            out.print(f"      do: {plain(finding.remedy)}")
    out.print(f"[bold]{plain(diagnosis.sentence)}[/bold]")
