"""``hapticbridge audit`` and ``hapticbridge repair``."""

from __future__ import annotations

import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from hapticbridge.audit import AuditReport, audit
from hapticbridge.cli.terminal import err, out, plain, print_error, quantity
from hapticbridge.errors import RecordingError
from hapticbridge.picture import check_ending
from hapticbridge.recording import read_recording, repair
from hapticbridge.report import plot_recording, write_report

_USUAL_EVENTS = ("start", "stop", "input")
_COLOURS = {"passive": "green", "active": "red", "invalid": "magenta"}


@dataclass(frozen=True, slots=True)
class Audit:
    """Judge recorded runs offline: passive, active or invalid, and why.

    Exit code 0 if all are passive and no device lacks damping, 1 if not, 2 if a file is no
    recording. Example:

        hapticbridge audit run.mcap --plot run.png
    """

    files: tyro.conf.Positional[tuple[Path, ...]]
    """Recordings (.mcap)."""
    strict: bool = False
    """Accept only passivity itself, not the slack that the device's damping leaves."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the reports as a JSON list."""
    plot: Path | None = None
    """Draw force, position and energies into this picture (.png, .svg or .pdf; one file only)."""
    report: Path | None = None
    """Write a self-contained HTML page (one file only)."""

    def execute(self) -> int:
        """Audits; returns the exit code."""
        if not self.files:
            raise RecordingError("audit needs at least one recording")
        if len(self.files) > 1 and (self.plot or self.report):
            raise RecordingError("--plot and --report take one recording at a time")
        if self.plot is not None:
            check_ending(self.plot)
        reports, unreadable = [], 0
        for file in self.files:
            try:
                with err.status(f"auditing {plain(str(file))} …"):
                    report = audit(file, strict=self.strict)
            except RecordingError as error:
                if len(self.files) == 1:
                    raise
                print_error(error)  # one bad file must not hide what the others are
                unreadable = 2
                continue
            reports.append(report)
            if not self.as_json:
                _print_report(report)
        if self.as_json:
            out.print_json(json.dumps([json.loads(report.to_json()) for report in reports]))
        if self.plot is not None or self.report is not None:
            self._draw(reports[0])
        return max(unreadable, *(report.exit_code for report in reports), 0)

    def _draw(self, report: AuditReport) -> None:
        recording = read_recording(report.path)
        with err.status("drawing …"):
            if self.plot is not None:
                plot_recording(recording, self.plot)
            if self.report is not None:
                write_report(recording, report, self.report)
        for written in (self.plot, self.report):
            if written is not None:
                err.print(f"wrote {plain(str(written))}")


def _print_report(report: AuditReport) -> None:
    colour = _COLOURS[report.verdict]
    environment = f" ({report.environment})" if report.environment else ""
    out.print(f"{plain(str(report.path))}: [bold {colour}]{report.verdict}[/]{environment}")
    out.print(f"  {plain(report.reason)}")
    if report.resimulation.startswith("not"):
        out.print(f"  [yellow]{plain(report.resimulation)}[/]")
    elif report.resimulation:
        out.print(f"  simulated again: {report.resimulation}")
    for sentence in (*report.rendered[:1], *report.conditions):
        out.print(f"  {plain(sentence)}")
    if not report.conditions:
        out.print(
            "  device condition b >= KT/2 + B': not applicable, the motion is prescribed or the "
            "damping unknown"
        )
    if report.is_cut:
        out.print(
            "  the file is cut: the verdict is on what it holds; "
            f"'hapticbridge repair {plain(shlex.quote(str(report.path)))} OUTPUT' makes it whole"
        )
    told = {name: count for name, count in report.events.items() if name not in _USUAL_EVENTS}
    if told:
        listed = ", ".join(f"{name} ({count})" for name, count in told.items())
        out.print(f"  events: {plain(listed)}")
    out.print(f"  {report.ticks} ticks, {report.duration:.3f} s")
    energies = [
        f"{name.replace('_', ' ')} {quantity(e, 'J')}" for name, e in report.energies.items() if e
    ]
    if energies:
        out.print(f"  {', '.join(energies)}")


@dataclass(frozen=True, slots=True)
class Repair:
    """Make a whole file of a recording that was cut by a crash.

    All whole chunks are kept, and an event says what was done. Example:

        hapticbridge repair cut.mcap whole.mcap
    """

    file: tyro.conf.Positional[Path]
    """The cut recording; it is not changed."""
    output: tyro.conf.Positional[Path]
    """The file to write; it must not exist."""

    def execute(self) -> int:
        """Repairs; returns the exit code."""
        with err.status(f"repairing {plain(str(self.file))} …"):
            mended = repair(self.file, self.output)
        found = f"{len(mended.ticks)} ticks, {len(mended.events)} events"
        out.print(f"wrote {plain(str(self.output))}: {found}")
        return 0
