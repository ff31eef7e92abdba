"""Writes a recording's ticks, metadata and events in another format."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from hapticbridge.errors import RecordingError, choices
from hapticbridge.export.csv_file import CsvSink, sidecar_of
from hapticbridge.export.hdf5 import Hdf5Sink
from hapticbridge.export.parquet import ParquetSink
from hapticbridge.export.sink import Sink
from hapticbridge.recording import RecordingFile, open_recording

FORMATS: dict[str, tuple[type[Sink], tuple[str, ...]]] = {
    "parquet": (ParquetSink, (".parquet", ".pq")),
    "csv": (CsvSink, (".csv",)),
    "hdf5": (Hdf5Sink, (".h5", ".hdf5")),
}
"""What writes each format, and the endings of its files, the usual one first."""


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written.

    Attributes:
        files: The table first, then what stands beside it.
        recording: What was read, without its ticks.
    """

    files: tuple[Path, ...]
    recording: RecordingFile

    @property
    def damage(self) -> tuple[str, ...]:
        """What is wrong with the recording, a sentence each; that it is cut is no damage."""
        found = self.recording
        if found.problems or found.is_cut or found.digest == found.computed_digest:
            return found.problems
        return ("its content does not match its digest",)


def target_for(path: str | Path, form: str) -> Path:
    """Returns where an export goes that names no file: beside the recording.

    Raises:
        RecordingError: The format is unknown.
    """
    return Path(path).with_suffix(_sink(form)[1][0])


def export(
    path: str | Path, form: str, target: str | Path | None = None, *, overwrite: bool = False
) -> Exported:
    """Writes a recording as a table: a row per tick, a column per number, with their units.

    Vectors become columns with the suffixes ``_x`` and so on (a wrench's ``_fx`` to ``_tz``).
    Doubles are kept to the bit (in CSV all but the payload of a NaN), metadata and events too; the
    attached scene is not. The file appears whole or not at all, and memory does not grow with the
    recording's length. What is damaged is left out; the result says whether anything was.

    Args:
        path: The recording.
        form: One of ``FORMATS``.
        target: The file, with an ending of the format; None: the recording's name with the usual
            one.
        overwrite: Replace files that exist.

    Raises:
        RecordingError: The recording cannot be read, the format is unknown or needs a package that
            is not installed, or the target exists, is the recording, ends otherwise or cannot be
            written.
    """
    sink_type, endings = _sink(form)
    recording = open_recording(path)
    target = target_for(path, form) if target is None else Path(target)
    if target.suffix.lower() not in endings:
        raise RecordingError(
            f"'{target}' does not end like {form}; its endings: {', '.join(endings)}"
        )
    files = (target, sidecar_of(target)) if form == "csv" else (target,)
    for file in files:
        if file.exists() and file.samefile(recording.path):
            raise RecordingError(f"'{file}' is the recording itself; choose another file")
        if file.exists() and not overwrite:
            raise RecordingError(f"'{file}' exists; choose another file or add --overwrite")
    draft = target.with_name(f".{target.name}.draft")
    drafts = (draft, sidecar_of(draft)) if form == "csv" else (draft,)
    try:
        sink = sink_type(draft, recording)
        try:
            for ticks in recording.blocks():
                sink.add(ticks)
        finally:
            sink.close()
        for written, file in zip(drafts, files, strict=True):
            written.replace(file)
    except OSError as error:
        reason = error.strerror or str(error)
        if not target.absolute().parent.is_dir():
            reason = f"the folder {target.parent} does not exist"
        raise RecordingError(f"cannot write '{target}': {reason}") from None
    finally:
        for written in drafts:
            with suppress(OSError):
                written.unlink(missing_ok=True)
    return Exported(files, recording)


def _sink(form: str) -> tuple[type[Sink], tuple[str, ...]]:
    if form not in FORMATS:
        raise RecordingError(f"format {form!r:.60} is unknown; the formats are {choices(FORMATS)}")
    return FORMATS[form]
