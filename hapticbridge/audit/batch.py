"""Audit of many recordings in parallel, with one table as the result."""

from __future__ import annotations

import glob
import json
import math
import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from hapticbridge.audit import audit
from hapticbridge.confinement import ForeignSceneError
from hapticbridge.errors import RecordingError, StudyError, choices
from hapticbridge.files import check_target, finite_or_null, name_fault, writing
from hapticbridge.recording.reader import foreign_file
from hapticbridge.sweep import Interrupted, Table, Value, Workers, check_format, sweep

FEW = 8
"""Number of recordings below which no processes are started. A process takes 3 s to start, as long
as the audit of two minutes at 1 kHz."""

UNREADABLE = "unreadable"
"""Verdict on a file that is not a recording or cannot be read."""

_MAX_REASON = 1000
"""Largest length of a reason in characters. A damaged file may have a problem in each chunk."""

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
"""Units of the numeric columns of a table."""

_COLUMNS = (
    *("margin", "verdict", "environment", "certified", "exit_code", "slack_share", "is_cut"),
    *("ticks", "duration", "port", "joules", "resimulation", "reason"),
)
"""Columns of a table that every report fills, in order."""

_REPORT = "report"
"""Name of the column that holds the whole report as JSON text."""


def audit_all(
    paths: Sequence[Path],
    *,
    strict: bool = False,
    accepts_unverified: bool = False,
    in_process: bool = False,
    workers: Workers = None,
    progress: Callable[[int, int], None] | None = None,
) -> Table:
    """Audits recordings and returns one row for each, most critical first.

    Files that cannot be read come first, then invalid recordings, then the others by increasing
    ``AuditReport.margin``. A cut file is judged on the part that remains.

    Columns beside ``file``: ``margin``, ``verdict`` (also ``unreadable``), ``environment``,
    ``certified`` (yes, if timely, no, not judged or nothing to certify), ``exit_code``, the other
    fields of ``AuditReport``, the energies at the end in J, and ``report``, the whole report as
    JSON (empty if unreadable).

    Args:
        paths: Recordings; different files.
        strict: True accepts only (14) itself; see ``audit``.
        accepts_unverified: True counts ``unverified`` as a success; see ``audit``.
        in_process: True simulates without the limits of a child process; see ``audit``.
        workers: As for ``sweep``, by default 1 for fewer than 8 recordings. The workers of a
            scheduler must see the files under these names.
        progress: Called with the number of finished recordings and the number of all.

    Raises:
        StudyError: The workers cannot be started or reached.
        RecordingError: ``paths`` is empty, or a name is no Unicode text.
        Interrupted: Ctrl-C was pressed; its table holds the finished rows in this order.
    """
    if not paths:
        raise RecordingError("audit needs at least one recording")
    for path in paths:
        if fault := name_fault(path, "a table"):
            raise RecordingError(f"'{path}' is in no table: {fault}")
    if workers is None and len(paths) < FEW:
        workers = 1
    is_far = isinstance(workers, str)
    try:
        table = sweep(
            partial(
                audit_point,
                strict=strict,
                accepts_unverified=accepts_unverified,
                in_process=in_process,
            ),
            [{"file": str(path.absolute() if is_far else path)} for path in paths],
            chunk=1,
            workers=workers,
            progress=progress,
        )
    except Interrupted as stop:
        raise Interrupted(_sorted(_with_failures(stop.table))) from None
    return _sorted(_with_failures(table))


def audit_point(
    point: dict[str, str],
    *,
    strict: bool,
    accepts_unverified: bool = False,
    in_process: bool = False,
) -> dict[str, Value]:
    """Audits one recording; returns its row."""
    try:
        report = audit(
            point["file"],
            strict=strict,
            accepts_unverified=accepts_unverified,
            in_process=in_process,
        )
    except (RecordingError, ForeignSceneError) as error:
        return {
            "margin": math.nan,
            "verdict": UNREADABLE,
            "exit_code": 2,
            "reason": str(error)[:_MAX_REASON],
        }
    known: dict[str, Value] = {name: getattr(report, name) for name in _COLUMNS}
    known["reason"] = report.reason[:_MAX_REASON]
    known["environment"] = report.state
    known["certified"] = report.answer
    if report.damping_margin is not None:
        known["damping_margin"] = report.damping_margin
    if report.tick is not None:
        known["tick"] = report.tick
    return known | report.energies | {_REPORT: report.to_json()}


def reports_of(table: Table) -> list[dict[str, object]]:
    """Returns the whole reports of a table, in its order, without unreadable files."""
    return [json.loads(text) for text in table.texts(_REPORT) if text]


def check_table_name(path: Path) -> None:
    """Checks that a table can be written to a file, before anything is computed for it.

    Raises:
        StudyError: The extension is not .parquet, .csv or .json, pyarrow is missing, or no such
            file can be made.
    """
    form = path.suffix.removeprefix(".")
    if form not in ("parquet", "csv", "json"):
        endings = choices((".parquet", ".csv", ".json"))
        raise StudyError(f"the table '{path}' must end in one of {endings}")
    if form != "json":
        check_format(form)
    check_target(path, StudyError)


def write_audits(table: Table, path: Path) -> None:
    """Writes a table of audits as Parquet, CSV or JSON (a list of rows), by the extension.

    In Parquet the metadata of a numeric column hold its unit.

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
    with writing(path, StudyError):
        path.write_text(json.dumps(finite_or_null(rows), indent=1, allow_nan=False) + "\n", "utf-8")


def worst_exit_code(table: Table) -> int:
    """Returns the largest exit code: 2 for an unreadable file, 1 for a negative verdict."""
    return int(table.numbers("exit_code").max())


def _with_failures(table: Table) -> Table:
    """Gives the verdict ``unreadable`` to rows whose worker failed."""
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
    # a sort puts NaN last, here it comes first; equal margins are sorted by name
    order = np.lexsort((table.texts("file").astype(str), margins, ~np.isnan(margins), is_read))
    return table.select(order)


ENDING = ".mcap"
"""Extension of recordings in a folder, in small or capital letters."""


def find_recordings(words: Iterable[str | Path]) -> list[Path]:
    """Returns the recordings named by files, folders and patterns, each once.

    A folder stands for all ``.mcap`` files below it, in the order of their names. A word that is
    not a file and contains ``*``, ``?`` or ``[`` is a pattern, in which ``**`` stands for any
    folders. Links to files are followed; links to folders below a folder are not, because they may
    form a circle. Missing files and unreadable folders are kept, so that the audit reports them.

    Raises:
        RecordingError: A folder contains no recording, or a pattern is malformed or matches none.
    """
    found: dict[Path, Path] = {}
    for word in words:
        path = Path(word)
        files = [path]
        if path.is_dir():
            files = _below(path)
            if not files:
                raise RecordingError(
                    f"there is no recording (*{ENDING}) in the folder '{path}'{_bag_in(path)}"
                )
        elif glob.has_magic(str(path)) and not path.exists():
            files = _fitting(path)
            if not files:
                raise RecordingError(f"no recording matches '{path}'")
        for file in files:
            try:
                found.setdefault(file.resolve(), file)
            except RuntimeError:  # a link to itself, of which reading says more
                found.setdefault(file.absolute(), file)
    return list(found.values())


def _bag_in(folder: Path) -> str:
    """Returns a clause on a bag that is not read in a folder without recordings, or nothing."""
    try:
        files = sorted(folder.iterdir())
    except OSError:  # which the message before it tells
        return ""
    kinds = ((file.name, foreign_file(file)) for file in files)
    return next((f": '{name}' is {kind}" for name, kind in kinds if kind), "")


def _below(folder: Path) -> list[Path]:
    """Returns the recordings in and below a folder, and the folders that cannot be read."""
    refused: list[Path] = []

    def refuse(error: OSError) -> None:
        refused.append(Path(error.filename))

    files = [
        Path(place) / name
        for place, _, names in os.walk(folder, onerror=refuse)
        for name in names
        if name.lower().endswith(ENDING)
    ]
    # a link comes after its target, so that the target's name is kept
    return sorted([*files, *refused], key=lambda file: (file.is_symlink(), file))


def _fitting(pattern: Path) -> list[Path]:
    """Returns the files that match a pattern, and those below the folders that match."""
    parts = pattern.parts
    first = next(index for index, part in enumerate(parts) if glob.has_magic(part))
    rest = str(Path(*parts[first:]))
    try:
        found = sorted(Path(*parts[:first]).glob(rest))
    except ValueError as error:
        raise RecordingError(f"'{pattern}' is not a valid pattern: {error}") from None
    return [file for path in found for file in (_below(path) if path.is_dir() else [path])]
