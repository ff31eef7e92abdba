"""Export of a recording's ticks, metadata and events."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError, choices
from hapticbridge.export_viewers import FoxgloveSink, RerunSink
from hapticbridge.files import import_extra, reason_of
from hapticbridge.record import FLAG_LEGEND, TableColumns, Timeline, due_times
from hapticbridge.recording import RecordingFile, open_recording
from hapticbridge.recording.reader import CUTTING_EVENTS, hand_named
from hapticbridge.run_description import meta_float

# Interface of table writers


class Sink(Protocol):
    """A table being written."""

    def __init__(self, path: Path, recording: RecordingFile) -> None: ...

    def add(self, ticks: NDArray[np.void]) -> None:
        """Appends records."""

    def close(self) -> None:
        """Finishes the file."""


# CSV format

SIDECAR = ".json"
"""Extension of the file beside the CSV, appended to its whole name."""


def sidecar_of(path: Path) -> Path:
    """Returns the path of the file with units, metadata and events."""
    return path.with_name(path.name + SIDECAR)


class CsvSink:
    """CSV writer whose numbers read back bit for bit; only a NaN loses its payload.

    The header has names only. Units, metadata and events go to ``NAME.csv.json`` as one object
    ``{"units", "flags", "meta", "events"}``, because most programs cannot read comments in a CSV.
    """

    def __init__(self, path: Path, recording: RecordingFile) -> None:
        self._columns = TableColumns(recording.record, recording.period)
        about = {
            "units": self._columns.units,
            "flags": FLAG_LEGEND,
            "meta": recording.meta,
            "events": recording.events,
        }
        text = json.dumps(about, indent=1, ensure_ascii=False)
        sidecar_of(path).write_text(text + "\n", encoding="utf-8")
        self._file = path.open("w", encoding="ascii", newline="")
        self._file.write(",".join(self._columns.units) + "\n")

    def add(self, ticks: NDArray[np.void]) -> None:
        """Implements ``Sink.add``."""
        # repr of a float is the shortest text that reads back to it
        texts = [map(repr, values.tolist()) for values in self._columns.values(ticks)]
        self._file.writelines(",".join(row) + "\n" for row in zip(*texts, strict=True))

    def close(self) -> None:
        """Implements ``Sink.close``."""
        self._file.close()


# HDF5 format

_CHUNK = 8192
"""Rows per chunk, 64 kB. Larger chunks compress better; smaller ones read faster for few rows."""


_CACHE = 2 * 8 * _CHUNK
"""Chunk cache in bytes per column: the chunks of one block. HDF5's default of 8 MB fills after 17
minutes at 1 kHz, 0.4 GB for all columns, and nothing is read again here."""


class Hdf5Sink:
    """HDF5 writer: ``/ticks/NAME`` per column, ``/meta/KEY`` per metadata text, and ``/events``.

    Each data set of ``/ticks`` has the attribute ``unit``, and ``flags`` the attribute ``bits``, a
    JSON object of their names. Events are JSON texts. Metadata are text
    data sets, because an attribute is limited to 64 kB.

    Raises:
        RecordingError: h5py is not installed.
    """

    def __init__(self, path: Path, recording: RecordingFile) -> None:
        h5py = import_extra("h5py", "HDF5", "hdf5", RecordingError)
        self._file = h5py.File(path, "w", rdcc_nbytes=_CACHE)
        text = h5py.string_dtype()
        meta = self._file.create_group("meta")
        for key, value in recording.meta.items():
            # a slash in the name would create a group
            meta.create_dataset(key.replace("/", "_"), data=value, dtype=text)
        events = [json.dumps(event) for event in recording.events]
        self._file.create_dataset("events", (len(events),), text, data=events)
        ticks = self._file.create_group("ticks")
        self._count = 0
        self._columns, self._sets = TableColumns(recording.record, recording.period), []
        for (name, unit), kind in zip(
            self._columns.units.items(), self._columns.kinds, strict=True
        ):
            data = ticks.create_dataset(
                name, (0,), f"<{kind}8", maxshape=(None,), chunks=(_CHUNK,), compression="gzip"
            )
            data.attrs["unit"] = unit
            self._sets.append(data)
        ticks["flags"].attrs["bits"] = json.dumps(FLAG_LEGEND)

    def add(self, ticks: NDArray[np.void]) -> None:
        """Implements ``Sink.add``."""
        end = self._count + len(ticks)
        for data, values in zip(self._sets, self._columns.values(ticks), strict=True):
            data.resize((end,))
            data[self._count :] = values
        self._count = end

    def close(self) -> None:
        """Implements ``Sink.close``."""
        self._file.close()


# Parquet format


class ParquetSink:
    """Parquet writer with one row group per block.

    Column metadata hold ``unit``. Schema metadata hold ``hapticbridge.meta`` (the recording's
    metadata as a JSON object of texts), ``hapticbridge.events`` (its events as a JSON list) and
    ``hapticbridge.flags`` (names of the bits of ``flags``).

    Raises:
        RecordingError: pyarrow is not installed.
    """

    def __init__(self, path: Path, recording: RecordingFile) -> None:
        self._arrow = import_extra("pyarrow", "Parquet", "tables", RecordingError)
        parquet = import_extra("pyarrow.parquet", "Parquet", "tables", RecordingError)
        self._columns = TableColumns(recording.record, recording.period)
        kinds = {"i": self._arrow.int64(), "f": self._arrow.float64()}
        fields = [
            self._arrow.field(name, kinds[kind], nullable=False, metadata={"unit": unit})
            for (name, unit), kind in zip(
                self._columns.units.items(), self._columns.kinds, strict=True
            )
        ]
        about = {
            "hapticbridge.meta": json.dumps(recording.meta),
            "hapticbridge.events": json.dumps(recording.events),
            "hapticbridge.flags": json.dumps(FLAG_LEGEND),
        }
        self._schema = self._arrow.schema(fields, metadata=about)
        # values rarely repeat, so a dictionary would only take space
        self._writer = parquet.ParquetWriter(
            path, self._schema, compression="zstd", use_dictionary=False
        )

    def add(self, ticks: NDArray[np.void]) -> None:
        """Implements ``Sink.add``."""
        arrays = [self._arrow.array(values) for values in self._columns.values(ticks)]
        self._writer.write_table(self._arrow.Table.from_arrays(arrays, schema=self._schema))

    def close(self) -> None:
        """Implements ``Sink.close``."""
        self._writer.close()


FORMATS: dict[str, tuple[type[Sink], tuple[str, ...]]] = {
    "parquet": (ParquetSink, (".parquet", ".pq")),
    "csv": (CsvSink, (".csv",)),
    "hdf5": (Hdf5Sink, (".h5", ".hdf5")),
    "rerun": (RerunSink, (".rrd",)),
    "foxglove": (FoxgloveSink, (".json",)),
}
"""Writer and file extensions of each format, the usual extension first."""


EVERYTHING = (-math.inf, math.inf)
"""Unlimited span in s of the run's clock."""

_ROUNDING = 0.5e-9
"""Half a nanosecond, in s. Recorded times are whole nanoseconds, so a tick due at 0.3 s counts as
due then with any rounding of 0.3."""


@dataclass(frozen=True, slots=True)
class Exported:
    """Result of an export.

    Attributes:
        files: The table, then its sidecar if there is one.
        recording: The recording without its ticks.
        ticks: Count of rows in the table.
        events: Events that were written.
    """

    files: tuple[Path, ...]
    recording: RecordingFile
    ticks: int
    events: tuple[dict[str, Any], ...]

    @property
    def damage(self) -> tuple[str, ...]:
        """Damage of the recording, one sentence each; a cut recording is not damaged."""
        found = self.recording
        fault = found.seal_fault
        return found.problems or ((fault,) if fault else ())


def target_for(path: str | Path, form: str) -> Path:
    """Returns the default target of an export: a file beside the recording.

    Raises:
        RecordingError: The format is unknown.
    """
    return Path(path).with_suffix(_sink(form)[1][0])


def export(
    path: str | Path,
    form: str,
    target: str | Path | None = None,
    *,
    span: tuple[float, float] = EVERYTHING,
    overwrite: bool = False,
    hand: str | None = None,
) -> Exported:
    """Writes a recording as a table: a row per tick, a column per number and one of seconds.

    Vectors become columns with the suffixes ``_x`` and so on (a wrench's ``_fx`` to ``_tz``).
    Doubles keep every bit (in CSV all but the payload of a NaN). Metadata and events are included,
    the attached scene is not. If writing fails, no partial file remains. Memory does not grow with
    the recording's length. Damaged parts are left out and listed in the result.

    Args:
        path: The recording.
        form: One of ``FORMATS``.
        target: File with an extension of the format; None takes the recording's name with the
            usual one.
        span: Start and end in s of the run's clock, the end excluded. Only ticks due and events
            in it are written; metadata ``cut`` then holds the two times. Events that say that the
            recording lacks an end, and metadata ``incomplete`` with the reason, are always written.
        overwrite: True replaces existing files.
        hand: Grip of the hand whose records are written; None for a run of one hand.

    Raises:
        RecordingError: The recording cannot be read, or has no such hand; the format is unknown or
            its package is not installed; no tick lies in the span; or the target exists, is the
            recording, has a wrong extension or cannot be written.
    """
    sink_type, endings = _sink(form)
    recording = open_recording(path, None if hand is None else hand_named(path, hand))
    target = target_for(path, form) if target is None else Path(target)
    if target.suffix.lower() not in endings:
        raise RecordingError(f"the {form} file '{target}' must end in {' or '.join(endings)}")
    files = (target, sidecar_of(target)) if form == "csv" else (target,)
    for file in files:
        if file.exists() and file.samefile(recording.path):
            raise RecordingError(f"'{file}' is the recording itself; choose another file")
        if file.exists() and not overwrite:
            raise RecordingError(f"'{file}' exists; choose another file or add --overwrite")
    piece, count = _piece(recording, span), 0
    draft = target.with_name(f".{target.name}.draft")
    drafts = (draft, sidecar_of(draft)) if form == "csv" else (draft,)
    try:
        sink = sink_type(draft, piece)
        try:
            for ticks in _blocks(recording, span):
                sink.add(ticks)
                count += len(ticks)
        finally:
            sink.close()
        if not count and span != EVERYTHING:
            raise RecordingError(_no_tick(recording, span))
        for written, file in zip(drafts, files, strict=True):
            written.replace(file)
    except OSError as error:
        raise RecordingError(f"cannot write '{target}': {reason_of(error, target)}") from None
    finally:
        for written in drafts:
            with suppress(OSError):
                written.unlink(missing_ok=True)
    return Exported(files, recording, count, tuple(piece.events))


def time_of(event: Mapping[str, Any]) -> float:
    """Returns when an event happened, in s of the run's clock; NaN where a damaged one lacks it."""
    time = event.get("time_ns")
    return 1e-9 * time if isinstance(time, int) else math.nan


def _piece(recording: RecordingFile, span: tuple[float, float]) -> RecordingFile:
    """Returns the description of a recording with only the events of a span."""
    start, end = span
    if not start < end:  # also refuses NaN
        raise RecordingError(
            f"the piece from {start:g} s to {end:g} s is empty; its end must be later"
        )
    if recording.cut_sentence:
        recording = replace(recording, meta=recording.meta | {"incomplete": recording.cut_sentence})
    if span == EVERYTHING:
        return recording
    events = [
        event
        for event in recording.events
        if start <= time_of(event) < end or event.get("event") in CUTTING_EVENTS
    ]
    limits = [time if math.isfinite(time) else None for time in span]
    meta = recording.meta | {"cut": json.dumps(limits)}
    return replace(recording, events=events, meta=meta)


def _blocks(recording: RecordingFile, span: tuple[float, float]) -> Iterator[NDArray[np.void]]:
    if span == EVERYTHING:
        yield from recording.blocks()
        return
    start, end = span
    period = meta_float(recording.meta, "period_s")
    for ticks in recording.blocks():
        due = due_times(ticks, period) + _ROUNDING
        found = ticks[(start <= due) & (due < end)]
        if found.size:
            yield found


def _no_tick(recording: RecordingFile, span: tuple[float, float]) -> str:
    duration = Timeline(recording.blocks(), meta_float(recording.meta, "period_s")).duration
    return (
        f"no tick was due from {span[0]:g} s to {span[1]:g} s; the recording ends at {duration:g} s"
    )


def _sink(form: str) -> tuple[type[Sink], tuple[str, ...]]:
    if form not in FORMATS:
        raise RecordingError(f"format {form!r:.60} is unknown; the formats are {choices(FORMATS)}")
    return FORMATS[form]
