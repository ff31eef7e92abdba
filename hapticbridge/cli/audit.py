"""``hapticbridge audit`` and ``hapticbridge repair``."""

from __future__ import annotations

import json
import math
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.table import Table as TextTable

from hapticbridge.arguments import option
from hapticbridge.audit import AuditReport, audit, verdict_words
from hapticbridge.audit.batch import (
    UNREADABLE,
    audit_all,
    check_table_name,
    find_recordings,
    reports_of,
    worst_exit_code,
    write_audits,
)
from hapticbridge.cli.terminal import err, out, plain, print_error, print_written, progress, working
from hapticbridge.demand.trip import Trip
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.plotting import check_ending
from hapticbridge.recording import Recording, read_recording, repair
from hapticbridge.recording.reader import read_hands
from hapticbridge.replay.film import Shot, still
from hapticbridge.report import check_page_name, plot_recording, telling_time, write_report
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.search import excess_of, pump_behind_trip
from hapticbridge.run.description import change_in, change_remedy
from hapticbridge.sweep import Interrupted, Table
from hapticbridge.units import energy_rows, format_energy
from hapticbridge.whatif import WhatIf, changes_from, draw_what_if, what_ifs, write_what_if
from hapticbridge.whatif.page import changes, rows, sentences
from hapticbridge.whatif.what_if import RUN_WORDS

_VERDICT_COLOURS = {
    "passive": "green",
    "unverified": "yellow",
    "active": "red",
    "empty": "bright_black",
    "invalid": "magenta",
    UNREADABLE: "magenta",
}


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
        coloured = f"[{_VERDICT_COLOURS[verdict]}]{words}[/]" + " " * max(22 - len(words), 0)
        name = plain(file) + (" [yellow](cut)[/]" if cut[row] == 1 else "")
        out.print(f"{margin:>8}  {coloured} {duration:>8}  {name}")
        if codes[row]:
            out.print(f"{'':>10}{plain(' '.join(reason.splitlines()))}")
    counts = Counter(verdicts)
    counted = ", ".join(
        f"{counts[verdict]} {verdict}" for verdict in _VERDICT_COLOURS if counts[verdict]
    )
    if refused := list(table.texts("certified")).count("no"):
        counted += f"; {refused} on a device that is not certified"
    out.print(f"{len(table)} recording{'s' if len(table) > 1 else ''}: {counted}")


def print_unreadable(table: Table) -> None:
    """Names on stderr what was passed over."""
    for verdict, reason in zip(table.texts("verdict"), table.texts("reason"), strict=True):
        if verdict == UNREADABLE:
            print_error(reason)


def print_what_if(what_if: WhatIf) -> None:
    """Prints what was changed, the runs side by side, and what to know of them."""
    for name, before, after in changes(what_if):
        out.print(plain(f"{name}: {before} -> {after}"))
    _print_runs(what_if)
    for run in what_if.runs[1:]:
        out.print(f"{run.name}: {RUN_WORDS[run.name]}")
        for text in (*sentences(run), *run.report.conditions):
            out.print(f"  {plain(text)}")
    for note in what_if.notes:
        err.print(f"note: {plain(note)}")


def print_alternatives(alternatives: Sequence[WhatIf]) -> None:
    """Prints the recorded run beside one run of each change, and what to know of them.

    It is the closed loop where there is one, else the run with the prescribed motion.
    """
    kind = alternatives[0].runs[-1].name
    runs = [alternatives[0].runs[0]]
    for each in alternatives:
        changed = ", ".join(f"{name} {after}" for name, _, after in changes(each))
        runs.append(replace(each.runs[-1], name=changed))
    _print_runs(replace(alternatives[0], runs=tuple(runs)))
    out.print(f"each column: {RUN_WORDS[kind]}")
    for run in runs[1:]:
        for text in sentences(run):
            out.print(f"  {plain(f'{run.name}: {text}')}")
    for note in dict.fromkeys(note for each in alternatives for note in each.notes):
        err.print(f"note: {plain(note)}")


def _print_runs(what_if: WhatIf) -> None:
    table = TextTable(box=None, pad_edge=False)
    table.add_column(plain(what_if.path.name))
    for run in what_if.runs:
        table.add_column(plain(run.name))
    for name, texts in rows(what_if):
        table.add_row(name, *map(plain, texts))
    out.print(table)


SCENE_SIZE = 640, 400
"""Width and height of a page's picture in pixels. It takes 150 kB; a larger one delays the page."""

_USUAL_EVENTS = ("start", "stop", "input", "finding")


@dataclass(frozen=True, slots=True)
class Audit:
    """Judge recorded runs offline: passive, active, unverified, and why.

    Several recordings, a folder (searched through and through) or a pattern give a table, sorted by
    the margin: the least share left, of the slack and of the device's damping; negative beyond the
    limit. What is no recording is named and passed over; Ctrl-C ends with the table of what was
    judged by then. Exit code 0 if all are passive and no device lacks damping, 1 if not, 2 if a
    file is no recording; with --what-if it is that of the changed runs.

    Examples:
        hapticbridge audit run.mcap --plot run.png
        hapticbridge audit runs/ --jobs 4 --table runs.parquet
        hapticbridge audit run.mcap --what-if stiffness=3000 --what-if rate=500
        hapticbridge audit run.mcap --what-if stiffness=400,800,1600
    """

    files: tuple[Path, ...] = option(metavar="FILE", is_positional=True)
    """Recordings (.mcap), folders of them, or patterns such as 'runs/**/a*.mcap'."""
    strict: bool = False
    """Accept only passivity itself, not the slack that the device's damping leaves."""
    accept_unverified: bool = False
    """Count 'unverified' as a success: passive in its records, but not simulated again here."""
    in_process: bool = False
    """Simulate in this process, for recordings of a known origin: without the child process whose
    memory and time are limited."""
    as_json: bool = option(False, flag="json")
    """Print the reports as a JSON list."""
    plot: Path | None = None
    """Draw force, position and energies into this picture (.png, .svg or .pdf; one file only)."""
    report: Path | None = None
    """Write a self-contained page (.html; one file only): verdict, cause, remedy, curves."""
    table: Path | None = None
    """Write a row per recording to this file: .parquet (extra 'tables'), .csv or .json."""
    jobs: int | None = None
    """Processes for several recordings; by default as many as there are cores, 1: none but this."""
    scheduler: str | None = None
    """Address of a dask.distributed scheduler to audit several on (extra 'cluster'), in place of
    --jobs; its workers must see the files under the same names."""

    what_if: tuple[str, ...] = option((), metavar="NAME=VALUE", is_repeated=True)
    """Simulate the recorded hand again with this changed; several of them add up to one change.
    Several values of one NAME, as in stiffness=400,800, are compared side by side. NAME is an
    option of 'run', as stiffness, rate, method, substeps, scale, controller or force_limit, or a
    parameter of the scene; an unknown name lists them. GRIP:stiffness and the like are of one of
    several hands. The change is simulated with the
    recorded motion and, where the device is known, with a model hand that yields. --plot and
    --report show all runs of one change side by side (one file only)."""

    def execute(self) -> int:
        """Audits; returns the exit code."""
        if not self.files:
            raise RecordingError("audit needs at least one recording")
        check_ending(self.plot)
        if self.report is not None:
            check_page_name(self.report)
        if self.table is not None:
            check_table_name(self.table)
        if self.jobs is not None and self.scheduler is not None:
            raise RecordingError("--jobs and --scheduler exclude each other")
        files = find_recordings(self.files)
        if files != list(self.files) or len(files) > 1 or self.table is not None:
            return self._audit_many(files)
        if self.jobs is not None or self.scheduler is not None:
            err.print("note: --jobs and --scheduler are for several recordings; here is one")
        if self.what_if:
            return self._ask(files[0])
        first = "the first audit on a machine compiles for up to a minute"
        with working(f"auditing {plain(str(files[0]))} ({first})"):
            report = audit(
                files[0],
                strict=self.strict,
                accepts_unverified=self.accept_unverified,
                in_process=self.in_process,
            )
        if self.as_json:
            out.print_json(json.dumps([json.loads(report.to_json())]))
        else:
            _print_report(report)
            self._print_cause(report)
        if self.plot is not None or self.report is not None:
            self._draw(report)
        return report.exit_code

    def _print_cause(self, report: AuditReport) -> None:
        """Prints the largest excess of an active run, or a trip, and what to change."""
        if report.verdict != "active":
            if report.trip is not None:
                self._print_trip(report, report.trip)
            return
        evidence = Evidence.of(read_recording(report.path, 0))
        excess = evidence and excess_of(evidence, report, in_process=self.in_process)
        if excess:
            out.print(
                f"most at tick {excess.worst_tick} ({excess.worst_time:.3f} s): "
                f"{format_energy(excess.worst)} beyond the bound"
            )
            out.print(f"likely cause: {plain(f'{excess.cause.kind}. {excess.cause.evidence}')}")
            out.print(f"what to change: {plain(excess.cause.remedy)}")
        out.print("next: hapticbridge guide active-verdict")

    def _print_trip(self, report: AuditReport, trip: Trip) -> None:
        """Prints what to change after a trip of a run that was passive until then."""
        recording = read_recording(report.path, 0)
        cause = pump_behind_trip(recording, report, in_process=self.in_process)
        if cause is not None:
            out.print(f"likely cause: {plain(f'{cause.kind}. {cause.evidence}')}")
            remedy = cause.remedy
        elif changed := change_in(recording.events):
            remedy = change_remedy(changed)
        else:
            created = report.energies.get("environment_energy", 0.0)
            remedy = trip.remedy(report.hand_energy, created)
        if remedy:
            out.print(f"what to change: {plain(remedy)}")
        page = "active-verdict" if cause is not None or report.hand_energy.limit else "faults"
        out.print(f"next: hapticbridge guide {page}")

    def _audit_many(self, files: list[Path]) -> int:
        if self.plot or self.report or self.what_if:
            raise RecordingError(
                "--plot, --report and --what-if take one recording at a time, and make no --table"
            )
        try:
            with progress("auditing") as show:
                table = audit_all(
                    files,
                    strict=self.strict,
                    accepts_unverified=self.accept_unverified,
                    in_process=self.in_process,
                    workers=self.scheduler or self.jobs,
                    progress=show,
                )
        except Interrupted as stop:
            self._print_table(stop.table)
            missing = f"{len(files) - len(stop.table)} of {len(files)} recordings were not judged"
            err.print(f"[yellow]warning:[/yellow] incomplete: {missing}")
            raise
        self._print_table(table)
        return worst_exit_code(table)

    def _print_table(self, table: Table) -> None:
        if self.as_json:
            out.print_json(json.dumps(reports_of(table)))
            print_unreadable(table)
        else:
            print_audits(table)
        if self.table is not None:
            write_audits(table, self.table)
            print_written(self.table)

    def _ask(self, file: Path) -> int:
        asked = changes_from(self.what_if)
        if len(asked) > 1 and (self.plot or self.report):
            raise RecordingError("--plot and --report show one change; give one value of each")
        with progress("simulating the changed runs") as show:
            first, *others = what_ifs(
                file, asked, strict=self.strict, in_process=self.in_process, progress=show
            )
        if others:
            every = [first, *others]
            if self.as_json:
                out.print_json(json.dumps([json.loads(each.to_json()) for each in every]))
            else:
                print_alternatives(every)
            return max(each.exit_code for each in every)
        if self.as_json:
            out.print_json(first.to_json())
        else:
            print_what_if(first)
        if self.plot is not None:
            draw_what_if(first, self.plot)
        if self.report is not None:
            before = first.runs[0]
            with working("drawing"):
                scene = self._scene_picture(before.recording, before.report)
                write_what_if(first, self.report, scene)
        print_written(self.plot, self.report)
        return first.exit_code

    def _draw(self, report: AuditReport) -> None:
        recording, *others = read_hands(report.path)
        with working("drawing"):
            if self.plot is not None:
                plot_recording(self.plot, recording, *others)
            if self.report is not None:
                scene = self._scene_picture(recording, report)
                write_report(
                    recording,
                    report,
                    self.report,
                    scene,
                    others=others,
                    in_process=self.in_process,
                )
        print_written(self.plot, self.report)

    def _scene_picture(self, recording: Recording, report: AuditReport) -> bytes | None:
        """Returns a picture of the scene; None if it cannot be drawn, which is no fault of it."""
        try:
            at = telling_time(recording, report)
            shot = Shot(at=at, width=SCENE_SIZE[0], height=SCENE_SIZE[1])
            return still(report.path, shot, in_process=self.in_process)
        except (HapticBridgeError, ValueError) as error:
            err.print(f"no picture of the scene: {plain(str(error))}")
            return None


def _print_report(report: AuditReport) -> None:
    colour = _VERDICT_COLOURS[report.verdict]
    is_judged = report.environment and not report.port and not report.credit
    judged = "environment " if is_judged else ""
    has_tripped = report.trip and report.verdict != "empty"
    tripped = ", [bold yellow]then the guard stopped the run[/]" if has_tripped else ""
    out.print(f"{plain(str(report.path))}: {judged}[bold {colour}]{report.words}[/]{tripped}")
    out.print(f"  {plain(report.reason)}")
    if report.obstacle:
        out.print(f"  [yellow]{plain(report.resimulation)}[/]")
    elif report.resimulation:
        out.print(f"  simulated again: {report.resimulation}")
    for sentence in report.findings:
        out.print(f"  [yellow]the run warned:[/yellow] {plain(sentence)}")
    certification = report.certification
    for sentence in report.couplings:
        out.print(f"  {plain(sentence)}")
    in_time = ", with every tick in time" if certification and certification.is_by_time else ""
    for sentence in report.conditions:
        out.print(f"  {plain(sentence)}{in_time}")
    if certification is not None:
        out.print(f"  {plain(certification.words)}")
    if report.is_cut:
        mend = f"'hapticbridge repair {shlex.quote(str(report.path))} OUTPUT' makes it whole"
        hint = f"; {mend}" if report.lacks_end else ""
        out.print(plain(f"  {report.cut}: the verdict is on what it holds{hint}"))
    unusual = {name: count for name, count in report.events.items() if name not in _USUAL_EVENTS}
    if unusual:
        listed = ", ".join(f"{name} ({count})" for name, count in unusual.items())
        out.print(f"  events: {plain(listed)}")
    rate = f", {certification.kept.remark}" if certification and certification.kept.remark else ""
    unfinished = "; the tick that tripped is not among them" if report.trip else ""
    time = f", {report.duration:.3f} s" if report.duration else ""  # unknown without metadata
    out.print(f"  {report.ticks} ticks{time}{rate}{unfinished}")
    rows = energy_rows(report.energies, report.start_potential, report.credit)
    if energies := [" ".join(row) for row in rows]:
        out.print(f"  {', '.join(energies)}")


@dataclass(frozen=True, slots=True)
class Repair:
    """Make a whole file of a recording that a crash cut.

    All whole chunks are kept, and an event says what was done.

    Example:
        hapticbridge repair cut.mcap whole.mcap
    """

    file: Path = option(metavar="FILE", is_positional=True)
    """The cut recording; it is not changed."""
    output: Path = option(metavar="OUTPUT", is_positional=True)
    """The file to write; it must not exist."""

    def execute(self) -> int:
        """Repairs; returns the exit code."""
        with err.status(f"repairing {plain(str(self.file))} …"):
            mended = repair(self.file, self.output)
        contents = f"{len(mended.ticks)} ticks, {len(mended.events)} events"
        out.print(f"wrote {plain(str(self.output))}: {contents}")
        return 0
