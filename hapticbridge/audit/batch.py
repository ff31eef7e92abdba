"""Audits many recordings, in parallel, into one table."""

from __future__ import annotations

import glob
import json
import math
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from hapticbridge.audit import audit
from hapticbridge.errors import RecordingError, StudyError, choices
from hapticbridge.files import finite_or_null
from hapticbridge.sweep.points import Value
from hapticbridge.sweep.results import Interrupted, Table, check_format
from hapticbridge.sweep.sweep import sweep

FEW = 8
"""Recordings below which no processes are started: each takes 3 s to start, as long as the audit
of two minutes at 1 kHz."""

UNREADABLE = "unreadable"
"""Verdict on a file that is no recording, or could not be read."""

_LONGEST_REASON = 1000
"""Letters of a reason that are kept; a damaged file may have a problem in each of its chunks."""

_UNITS = {
    "margin": "1",
    "slack_share": "1",
    "damping_margin": "1",
    "ticks": "1",
    "tick": "1",
    "duration": "s",
    "joules": "J",
    "kinetic": "J",
    "potential": "J",
    "coupling_work": "J",
    "actuator_work": "J",
    "external_work": "J",
    "environment_energy": "J",
    "device_energy": "J",
    "slack": "J",
}
"""Units of what is measured in a table of audits."""

_REPORT = "report"
"""Column that holds the whole report as JSON text."""


def audit_all(
    paths: Sequence[Path],
    *,
    strict: bool = False,
    jobs: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Table:
    """Audits recordings and returns a row for each, the one nearest to a negative verdict first.

    Rows are sorted by ``margin`` (``AuditReport.margin``), from the smallest to the largest; before
    all of them come files that could not be read, then recordings that are invalid. A file that is
    cut is judged by what it holds, as ``audit`` alone does.

    Columns beside ``file``: ``margin``, ``verdict`` (also ``unreadable``), ``environment``,
    ``certified`` (yes, no or unknown), ``exit_code``, what ``AuditReport`` says otherwise, the
    energies at the end in J, and ``report``, the whole report as JSON (empty if unreadable).

    Args:
        paths: Recordings; different files.
        strict: As for ``audit``.
        jobs: Processes at most; 1 works in this one. By default as many as there are cores, and
            this one for fewer than 8 recordings.
        executor: Any executor, instead of processes.
        scheduler: Address of a dask.distributed scheduler, likewise; its workers must see the files
            under the same names.
        progress: Called with the recordings done and all of them.

    Raises:
        StudyError: The workers cannot be had.
        RecordingError: There is no recording.
        Interrupted: Ctrl-C; it has the rows of what was judged by then, sorted likewise.
    """
    if not paths:
        raise RecordingError("audit needs at least one recording")
    if jobs is None and len(paths) < FEW:
        jobs = 1
    try:
        table = sweep(
            partial(audit_point, strict=strict),
            [{"file": str(path.absolute() if scheduler else path)} for path in paths],
            chunk=1,
            executor=executor,
            scheduler=scheduler,
            jobs=jobs,
            progress=progress,
        )
    except Interrupted as stop:
        raise Interrupted(_sorted(_with_failures(stop.table))) from None
    return _sorted(_with_failures(table))


def audit_point(point: dict[str, str], *, strict: bool) -> dict[str, Value]:
    """Audits one recording; returns its row of the table."""
    try:
        report = audit(point["file"], strict=strict)
    except RecordingError as error:
        return {
            "margin": math.nan,
            "verdict": UNREADABLE,
            "exit_code": 2,
            "reason": str(error)[:_LONGEST_REASON],
        }
    report = replace(report, reason=report.reason[:_LONGEST_REASON])
    known: dict[str, Value] = {
        "margin": report.margin,
        "verdict": report.verdict,
        "environment": report.environment or "",
        "certified": {True: "yes", False: "no", None: "unknown"}[report.certified],
        "exit_code": report.exit_code,
        "slack_share": report.slack_share,
        "is_cut": report.is_cut,
        "ticks": report.ticks,
        "duration": report.duration,
        "port": report.port,
        "joules": report.joules,
        "resimulation": report.resimulation,
        "reason": report.reason,
    }
    if report.damping_margin is not None:
        known["damping_margin"] = report.damping_margin
    if report.tick is not None:
        known["tick"] = report.tick
    return known | report.energies | {_REPORT: report.to_json()}


def reports_of(table: Table) -> list[dict[str, object]]:
    """Returns the whole reports of a table, in its order, without files that were unreadable."""
    return [json.loads(text) for text in table.texts(_REPORT) if text]


def check_table_name(path: Path) -> None:
    """Checks that a table can be written under a name, before anything is computed for it.

    Raises:
        StudyError: It ends otherwise than .parquet, .csv or .json, pyarrow is missing, or there is
            no such folder.
    """
    form = path.suffix.removeprefix(".")
    if form not in ("parquet", "csv", "json"):
        endings = choices((".parquet", ".csv", ".json"))
        raise StudyError(f"'{path}' does not end like a table; endings: {endings}")
    if form != "json":
        check_format(form)
    if not path.absolute().parent.is_dir():
        raise StudyError(f"cannot write '{path}': its folder does not exist")


def write_audits(table: Table, path: Path) -> None:
    """Writes a table of audits as Parquet, CSV or JSON (a list of rows), by the name's end.

    In Parquet a column of numbers has its unit in its metadata, as in an export.

    Raises:
        StudyError: See ``check_table_name``, or the file cannot be written.
    """
    check_table_name(path)
    columns = {n: c for n, c in table.columns.items() if n not in (_REPORT, "error")}
    if path.suffix != ".json":
        kept = {**columns, "error": table["error"]}
        Table(kept).write(path, units=_UNITS)
        return
    values = {name: column.tolist() for name, column in columns.items()}
    rows = [dict(zip(values, row, strict=True)) for row in zip(*values.values(), strict=True)]
    try:
        path.write_text(json.dumps(finite_or_null(rows), indent=1, allow_nan=False) + "\n", "utf-8")
    except OSError as error:
        raise StudyError(f"{path}: cannot be written ({error.strerror})") from None


def worst_exit_code(table: Table) -> int:
    """Returns the largest exit code: 2 if a file could not be read, 1 if a verdict is negative."""
    return int(table.numbers("exit_code").max())


def _with_failures(table: Table) -> Table:
    """Gives a verdict to rows whose worker failed, so that they are not passed over in silence."""
    if not table.failed.any():
        return table
    filled = {
        "verdict": np.where(table.failed, UNREADABLE, table.texts("verdict")),
        "reason": np.where(table.failed, table["error"], table.texts("reason")),
        "exit_code": np.where(table.failed, 2, table.numbers("exit_code")),
        "margin": np.where(table.failed, np.nan, table.numbers("margin")),
    }
    return Table({**table.columns, **filled})


def _sorted(table: Table) -> Table:
    margins = table.numbers("margin")
    is_read = table.texts("verdict") != UNREADABLE
    # NaN goes last in a sort, and here first; equal margins by name
    order = np.lexsort((table.texts("file").astype(str), margins, ~np.isnan(margins), is_read))
    return table.select(order)


ENDING = ".mcap"
"""What recordings in a folder are known by, in small or capital letters."""


def find_recordings(words: Iterable[str | Path]) -> list[Path]:
    """Returns the recordings that files, folders and patterns name, each once.

    A folder stands for all files below it that end in ``.mcap``, in the order of their names. A
    word that is no file and holds ``*``, ``?`` or ``[`` is a pattern, in which ``**`` stands for
    any folders. Links to files are followed, links to folders below a folder are not: they may lead
    in a circle. What does not exist, and a folder below that cannot be read, are kept: the audit
    says so.

    Raises:
        RecordingError: There is no recording in a folder, none that fits a pattern, or the pattern
            is none.
    """
    found: dict[Path, Path] = {}
    for word in words:
        path = Path(word)
        files = [path]
        if path.is_dir():
            files = _below(path)
            if not files:
                raise RecordingError(f"there is no recording (*{ENDING}) in the folder '{path}'")
        elif glob.has_magic(str(path)) and not path.exists():
            files = _fitting(path)
            if not files:
                raise RecordingError(f"no recording fits '{path}'")
        for file in files:
            found.setdefault(file.resolve(), file)
    return list(found.values())


def _below(folder: Path) -> list[Path]:
    """Returns the recordings in and below a folder, and what of it cannot be read."""
    refused: list[Path] = []

    def refuse(error: OSError) -> None:
        refused.append(Path(error.filename))

    files = [
        Path(place) / name
        for place, _, names in os.walk(folder, onerror=refuse)
        for name in names
        if name.lower().endswith(ENDING)
    ]
    # a link after what it may lead to, which is then the one that is named
    return sorted([*files, *refused], key=lambda file: (file.is_symlink(), file))


def _fitting(pattern: Path) -> list[Path]:
    """Returns the files that fit a pattern, and those below the folders that do."""
    parts = pattern.parts
    first = next(index for index, part in enumerate(parts) if glob.has_magic(part))
    rest = str(Path(*parts[first:]))
    try:
        found = sorted(Path(*parts[:first]).glob(rest))
    except ValueError as error:
        raise RecordingError(f"'{pattern}' is no pattern: {error}") from None
    return [file for path in found for file in (_below(path) if path.is_dir() else [path])]
