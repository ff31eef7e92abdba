"""Export of a recording's ticks, metadata and events."""

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
"""Writer and file extensions of each format, the usual extension first."""


@dataclass(frozen=True, slots=True)
class Exported:
    """Result of an export.

    Attributes:
        files: The table, then its sidecar if there is one.
        recording: The recording without its ticks.
    """

    files: tuple[Path, ...]
    recording: RecordingFile

    @property
    def damage(self) -> tuple[str, ...]:
        """Damage of the recording, one sentence each; a cut recording is not damaged."""
        found = self.recording
        if found.problems or found.is_cut or found.digest == found.computed_digest:
            return found.problems
        return ("its content does not match its digest",)


def target_for(path: str | Path, form: str) -> Path:
    """Returns the default target of an export: a file beside the recording.

    Raises:
        RecordingError: The format is unknown.
    """
    return Path(path).with_suffix(_sink(form)[1][0])


def export(
    path: str | Path, form: str, target: str | Path | None = None, *, overwrite: bool = False
) -> Exported:
    """Writes a recording as a table: a row per tick, a column per number, with units.

    Vectors become columns with the suffixes ``_x`` and so on (a wrench's ``_fx`` to ``_tz``).
    Doubles keep every bit (in CSV all but the payload of a NaN). Metadata and events are included,
    the attached scene is not. If writing fails, no partial file remains. Memory does not grow with
    the recording's length. Damaged parts are left out and listed in the result.

    Args:
        path: The recording.
        form: One of ``FORMATS``.
        target: File with an extension of the format; None takes the recording's name with the usual
            one.
        overwrite: True replaces existing files.

    Raises:
        RecordingError: The recording cannot be read; the format is unknown or its package is not
            installed; or the target exists, is the recording, has a wrong extension or cannot be
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
