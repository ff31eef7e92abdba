"""Export of a recording's ticks, metadata and events."""

from __future__ import annotations

import csv
import ctypes
import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError, choices
from hapticbridge.files import (
    Hdf5File,
    check_regular,
    draft_of,
    import_extra,
    name_fault,
    reason_of,
    refuse_existing,
)
from hapticbridge.kernel.record import (
    FLAG_LEGEND,
    TICK_DTYPE,
    TableColumns,
    Timeline,
    due_times,
    force_on_hand,
)
from hapticbridge.recording import RecordingFile, open_recording
from hapticbridge.recording.reader import CUTTING_EVENTS, hand_named
from hapticbridge.recording.ros_messages import HANDLE, TOOL, axes_of
from hapticbridge.run.description import meta_float

# Interface of table writers


class Sink(Protocol):
    """A table being written."""

    def __init__(self, path: Path, recording: RecordingFile, columns: TableColumns) -> None: ...

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

    def __init__(self, path: Path, recording: RecordingFile, columns: TableColumns) -> None:
        self._columns = columns
        about = {
            "units": self._columns.units,
            "flags": FLAG_LEGEND,
            "meta": recording.meta,
            "events": recording.events,
        }
        text = json.dumps(about, indent=1, ensure_ascii=False)
        # what is no Unicode in an event's text stays an escape of JSON
        sidecar_of(path).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")
        self._file = path.open("w", encoding="utf-8", newline="")
        # sensors may have any name
        csv.writer(self._file, lineterminator="\n").writerow(self._columns.units)

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

    def __init__(self, path: Path, recording: RecordingFile, columns: TableColumns) -> None:
        h5py = import_extra("h5py", "HDF5", "hdf5", RecordingError)
        self._file = Hdf5File(path, "HDF5", RecordingError, rdcc_nbytes=_CACHE)
        text, root = h5py.string_dtype(), self._file.root
        meta = root.create_group("meta")
        for key, value in recording.meta.items():
            # a slash in the name would create a group
            meta.create_dataset(key.replace("/", "_"), data=value, dtype=text)
        events = [json.dumps(event) for event in recording.events]
        root.create_dataset("events", (len(events),), text, data=events)
        ticks = root.create_group("ticks")
        self._count = 0
        self._columns, self._sets = columns, []
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
        self._file.check()

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

    def __init__(self, path: Path, recording: RecordingFile, columns: TableColumns) -> None:
        self._arrow = import_extra("pyarrow", "Parquet", "tables", RecordingError)
        parquet = import_extra("pyarrow.parquet", "Parquet", "tables", RecordingError)
        self._columns = columns
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
        # opened here: pyarrow takes names in UTF-8 alone
        self._file = path.open("wb")
        # values rarely repeat, so a dictionary would only take space
        self._writer = parquet.ParquetWriter(
            self._file, self._schema, compression="zstd", use_dictionary=False
        )

    def add(self, ticks: NDArray[np.void]) -> None:
        """Implements ``Sink.add``."""
        arrays = [self._arrow.array(values) for values in self._columns.values(ticks)]
        self._writer.write_table(self._arrow.Table.from_arrays(arrays, schema=self._schema))

    def close(self) -> None:
        """Implements ``Sink.close``."""
        with self._file:
            self._writer.close()


# Viewers rerun and Foxglove, each with an arrangement of its panels

ENERGIES = ("kinetic", "potential", "coupling_work", "environment_energy", "device_energy")
"""Energies that are shown over time, in J."""

ARROW = 0.02
"""Length of a force's arrow in m per N."""

AXIS = 0.01
"""Length of the axes of a pose in m."""

PATH_EVERY = 16
"""Ticks between two points of the tool's path."""

_FOOTER = b"RRF2FOOT"
"""Mark in the last 16 bytes of a whole file of rerun. Its writer may fail without an error here."""

_START = 1 << 16
"""Bytes that must have room before rerun's writer starts; on a full disk it may wait forever."""

_FLUSH_TIME = 20.0
"""Longest wait in s for rerun's writer, which may end without an answer. A block takes 0.1 s."""

_IN_PART = "rerun wrote a part of it only; its own line above has the reason, or the disk is full"

_PATH = (128, 128, 128)
_FORCES = {"on_hand": (230, 97, 0), "on_tool": (26, 95, 180)}
_CLOCK = "time"


class RerunSink:
    """Writer of a recording for rerun (``.rrd``), with its blueprint.

    Poses and forces are under ``scene``, numbers over time under ``force`` and ``energy``, events
    under ``events``. The timeline ``time`` is that of the run, in s.

    Raises:
        RecordingError: rerun is not installed, or cannot be given the folder's name.
    """

    def __init__(self, path: Path, recording: RecordingFile, columns: TableColumns) -> None:
        self._rerun = import_extra("rerun", "a file for rerun", "rerun", RecordingError)
        if fault := name_fault(path.parent, "rerun"):
            raise RecordingError(f"cannot write into the folder '{path.parent}': {fault}")
        self._target, self._path = path, list[NDArray[np.float64]]()
        self._period, self._axes = recording.period, axes_of(recording.meta)
        name = f"hapticbridge: {recording.meta.get('scene', '')}"
        self._stream = self._rerun.RecordingStream(name)
        path.write_bytes(bytes(_START))
        self._stream.save(path, default_blueprint=self._blueprint())
        log = self._stream.log
        for frame in (HANDLE, TOOL):
            log(f"scene/{frame}", self._rerun.TransformAxes3D(AXIS), static=True)
        log("scene", self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, names in (("force/on_hand", "xyz"), ("force/on_tool", "xyz")):
            log(name, self._rerun.SeriesLines(names=list(names)), static=True)
        for energy in ENERGIES:
            log(f"energy/{energy}", self._rerun.SeriesLines(names=energy), static=True)
        for event in recording.events:
            time = event.get("time_ns")
            self._stream.set_time(_CLOCK, duration=1e-9 * time if isinstance(time, int) else 0.0)
            log("events", self._rerun.TextLog(json.dumps(event)))

    def add(self, ticks: NDArray[np.void]) -> None:
        """Implements ``Sink.add``."""
        rr, send = self._rerun, self._stream.send_columns
        self._path.append(ticks["tool_position"][::PATH_EVERY])
        clock = [rr.TimeColumn(_CLOCK, duration=due_times(ticks, self._period))]
        forces = {
            "on_hand": (HANDLE, force_on_hand(ticks, self._axes)),
            "on_tool": (TOOL, ticks["wrench_on_tool"][:, :3]),
        }
        for frame in (HANDLE, TOOL):
            quaternion = np.roll(ticks[f"{frame}_quaternion"], -1, axis=1)
            poses = rr.Transform3D.columns(
                translation=ticks[f"{frame}_position"], quaternion=quaternion
            )
            send(f"scene/{frame}", clock, poses)
        for name, (frame, force) in forces.items():
            arrows = rr.Arrows3D.columns(
                vectors=ARROW * force,
                origins=ticks[f"{frame}_position"],
                colors=np.tile(np.array(_FORCES[name], np.uint8), (len(ticks), 1)),
            )
            send(f"scene/force_{name}", clock, arrows)
            send(f"force/{name}", clock, rr.Scalars.columns(scalars=np.ascontiguousarray(force)))
        for energy in ENERGIES:
            column = rr.Scalars.columns(scalars=np.ascontiguousarray(ticks[energy]))
            send(f"energy/{energy}", clock, column)
        self._flush()

    def close(self) -> None:
        """Implements ``Sink.close``."""
        if self._path:
            path = self._rerun.LineStrips3D([np.concatenate(self._path)], colors=[_PATH])
            self._stream.log("scene/path", path, static=True)
        self._flush()
        self._stream.disconnect()
        with self._target.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 16))
            if _FOOTER not in file.read():
                raise OSError(_IN_PART)

    def _flush(self) -> None:
        try:
            self._stream.flush(timeout_sec=_FLUSH_TIME)
        except RuntimeError:  # its writer's thread has ended
            # releasing the stream would wait for that thread, perhaps for ever; so would the exit
            self._rerun.unregister_shutdown()
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._stream))
            raise OSError(_IN_PART) from None

    def _blueprint(self) -> Any:
        views = import_extra("rerun.blueprint", "a file for rerun", "rerun", RecordingError)
        return views.Blueprint(
            views.Horizontal(
                views.Spatial3DView(origin="scene", name="handle, tool and forces"),
                views.Vertical(
                    views.TimeSeriesView(origin="force", name="force (N)"),
                    views.TimeSeriesView(origin="energy", name="energy (J)"),
                    views.TextLogView(origin="events", name="events"),
                ),
            ),
            views.TimePanel(timeline=_CLOCK, expanded=False),
            collapse_panels=True,
        )


class FoxgloveSink:
    """Writer of a layout for Foxglove (``.json``), to be imported beside the recording itself."""

    def __init__(self, path: Path, recording: RecordingFile, columns: TableColumns) -> None:
        forces = [f"/wrench_on_hand.wrench.force.{axis}" for axis in "xyz"]
        energies = [f"/tick.{energy}" for energy in ENERGIES]
        panels = {
            "3D!scene": {
                "followTf": "world",
                "topics": {
                    topic: {"visible": True}
                    for topic in ("/handle_pose", "/tool_pose", "/wrench_on_hand")
                },
            },
            "Plot!force": _plot("force on the hand (N)", forces),
            "Plot!energy": _plot("energy (J)", energies),
            "RosOut!events": {"topicToRender": "/rosout", "minLogLevel": 1, "searchTerms": []},
        }
        right = {"first": "Plot!energy", "second": "RosOut!events", "direction": "column"}
        layout = {
            "configById": panels,
            "globalVariables": {},
            "userNodes": {},
            "playbackConfig": {"speed": 1.0},
            "layout": {
                "first": "3D!scene",
                "second": {"first": "Plot!force", "second": right, "direction": "column"},
                "direction": "row",
            },
        }
        path.write_text(json.dumps(layout, indent=1) + "\n", encoding="utf-8")

    def add(self, ticks: NDArray[np.void]) -> None:
        """Implements ``Sink.add``; never called, as the ticks stay in the recording."""

    def close(self) -> None:
        """Implements ``Sink.close``."""


def _plot(title: str, paths: list[str]) -> dict[str, object]:
    series = [
        {
            "value": path,
            "label": path.rpartition(".")[2],
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for path in paths
    ]
    return {"title": title, "paths": series, "showLegend": True, "xAxisVal": "timestamp"}


FORMATS: dict[str, tuple[type[Sink], tuple[str, ...]]] = {
    "parquet": (ParquetSink, (".parquet", ".pq")),
    "csv": (CsvSink, (".csv",)),
    "hdf5": (Hdf5Sink, (".h5", ".hdf5")),
    "rerun": (RerunSink, (".rrd",)),
    "foxglove": (FoxgloveSink, (".json",)),
}
"""Writer and file extensions of each format, the usual extension first."""

TABLES = ("parquet", "csv", "hdf5")
"""Formats with a column for each number."""


LAYOUT = "foxglove"
"""Format that holds nothing of the recording: it arranges the topics of the whole, of its first
hand if there are several, as only the first has topics of its pose."""

EVERYTHING = (-math.inf, math.inf)
"""Unlimited span in s of the run's clock."""


@dataclass(frozen=True, slots=True)
class Part:
    """Part of a recording that a table holds.

    Attributes:
        span: Start and end in s of the run's clock, the end excluded. Only ticks due and events in
            it are written; metadata ``cut`` then holds the two times. Events that say that the
            recording lacks an end, and metadata ``incomplete`` with the reason, are always written.
        hand: Grip of the hand whose records are written; None for a run of one hand.
        has_sensors: True adds columns ``sensor_NAME``, the readings of the scene's own sensors; the
            run is simulated again for them.
    """

    span: tuple[float, float] = EVERYTHING
    hand: str | None = None
    has_sensors: bool = False


def _columns(recording: RecordingFile, form: str, part: Part) -> TableColumns:
    if not part.has_sensors:
        return TableColumns(TICK_DTYPE, recording.period)
    if form not in TABLES:
        raise RecordingError(f"sensors are columns of tables: {choices(TABLES)}; not of {form}")
    return _ColumnsWithSensors(recording)


WHOLE = Part()
"""All ticks of a run of one hand, as recorded."""


class _ColumnsWithSensors(TableColumns):
    """Columns of ticks, and of the readings of a scene's sensors in them."""

    def __init__(self, recording: RecordingFile) -> None:
        super().__init__(TICK_DTYPE, recording.period)
        # imported here, because no other table needs the packages that draw
        from hapticbridge.replay.film import sensors  # noqa: PLC0415

        self._sensors = sensors(recording.path)
        self.units |= {f"sensor_{name}": "MuJoCo's" for name in self._sensors.names}
        self.kinds += ["f"] * len(self._sensors.names)
        self.odd = {
            why: [f"sensor_{name}" for name in names] for why, names in self._sensors.odd.items()
        }

    def values(self, ticks: NDArray[np.void]) -> list[NDArray[Any]]:
        """Returns the columns of some records, each contiguous, (n,), int64 or float64."""
        rows = np.searchsorted(self._sensors.ticks, ticks["tick"])
        readings = np.ascontiguousarray(self._sensors.values[rows].T)
        return [*super().values(ticks), *readings]


_ROUNDING = 0.5e-9
"""Half a nanosecond, in s. Recorded times are whole nanoseconds, so a tick due at 0.3 s counts as
due then with any rounding of 0.3."""


@dataclass(frozen=True, slots=True)
class Exported:
    """Result of an export.

    Attributes:
        files: The table, then its sidecar if there is one.
        recording: The recording without its ticks.
        ticks: Count of rows in the table; 0 of a layout.
        events: Events that were written; none of a layout.
        odd: Columns of sensors whose readings the file alone would not give, by the reason.
    """

    files: tuple[Path, ...]
    recording: RecordingFile
    ticks: int
    events: tuple[dict[str, Any], ...]
    odd: Mapping[str, list[str]]


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
    part: Part = WHOLE,
    overwrite: bool = False,
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
        part: Span, hand and columns to write.
        overwrite: True replaces existing files.

    Raises:
        RecordingError: The recording cannot be read, or has no such hand; the format is unknown or
            its package is not installed; no tick lies in the span; or the target exists, is the
            recording, has a wrong extension or cannot be written.
        HapticBridgeError: The scene has no sensors, or cannot be simulated again.
    """
    sink_type, endings = _sink(form)
    span = part.span
    recording = _opened(path, form, part)
    target = target_for(path, form) if target is None else Path(target)
    if target.suffix.lower() not in endings:
        raise RecordingError(f"the {form} file '{target}' must end in {' or '.join(endings)}")
    files = (target, sidecar_of(target)) if form == "csv" else (target,)
    for file in files:
        if file.exists() and file.samefile(recording.path):
            raise RecordingError(f"'{file}' is the recording itself; choose another file")
        check_regular(file, RecordingError)
        refuse_existing(file, RecordingError, overwrite=overwrite)
    piece, count = _piece(recording, span), 0
    columns = _columns(recording, form, part)
    place = target.resolve()
    draft = draft_of(place)
    drafts = (draft, sidecar_of(draft)) if form == "csv" else (draft,)
    try:
        sink = sink_type(draft, piece, columns)
        try:
            for ticks in () if form == LAYOUT else _blocks(recording, span):
                sink.add(ticks)
                count += len(ticks)
        finally:
            sink.close()
        if not count and span != EVERYTHING:
            raise RecordingError(_no_tick(recording, span))
        for written, file in zip(drafts, files, strict=True):
            written.replace(file.resolve())  # a link is followed
    except OSError as error:
        raise RecordingError(f"cannot write '{target}': {reason_of(error, target)}") from None
    finally:
        for written in drafts:
            with suppress(OSError):
                written.unlink(missing_ok=True)
    odd = columns.odd if isinstance(columns, _ColumnsWithSensors) else {}
    events = () if form == LAYOUT else tuple(piece.events)
    return Exported(files, recording, count, events, odd)


def _opened(path: str | Path, form: str, part: Part) -> RecordingFile:
    """Opens the recording of a hand; for a layout that of the first."""
    if form != LAYOUT:
        return open_recording(path, None if part.hand is None else hand_named(path, part.hand))
    if part.span != EVERYTHING or part.hand is not None:
        raise RecordingError(
            f"--from, --to and --hand have no effect on {form}: a layout arranges the topics of "
            "the whole recording, with the poses of its first hand; leave them out"
        )
    return open_recording(path, 0)


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
