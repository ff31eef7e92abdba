"""Repair of a cut recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hapticbridge.errors import RecordingError
from hapticbridge.recording import format as layout
from hapticbridge.recording.reader import Recording, read_recording, read_with_attachments
from hapticbridge.recording.writer import RecordingWriter

_BATCH = 4096
"""Records written at once. A larger batch takes more memory, a smaller one more time."""


def repair(path: str | Path, output: str | Path) -> Recording:
    """Writes a cut recording again as a whole one.

    Metadata, attachments, and all whole records and events are kept. An event ``repaired``
    describes the repair, and the digest is computed anew.

    Returns:
        The new recording, as read back.

    Raises:
        RecordingError: The recording cannot be read or is not cut, or the output exists or cannot
            be written.
    """
    path, output = Path(path), Path(output)
    recording, attachments = read_with_attachments(path)
    if not recording.is_cut:
        raise RecordingError(f"{path} is not cut, so there is nothing to repair")
    epoch = recording.meta.get(layout.EPOCH_KEY, "")
    writer = RecordingWriter(
        output,
        recording.meta,
        attachments,
        int(epoch) if epoch.isascii() and epoch.isdigit() and len(epoch) < 20 else 0,
        exclusive=True,
        record=recording.record,
    )
    try:
        _rewrite(writer, recording)
    except RecordingError:
        output.unlink(missing_ok=True)
        raise
    return read_recording(output)


def _rewrite(writer: RecordingWriter, recording: Recording) -> None:
    for start in range(0, recording.ticks.size, _BATCH):
        writer.write_ticks(recording.ticks[start : start + _BATCH])
    for event in recording.events:
        writer.write_event(event, _time(event))
    deadlines = recording.ticks["deadline_ns"][-1:].tolist()
    last = max([*deadlines, *map(_time, recording.events)], default=0)
    made = {
        "event": "repaired",
        "source": recording.path.name,
        "ticks": int(recording.ticks.size),
        "problems": list(recording.problems),
    }
    writer.write_event(made, last)
    writer.close()


def _time(event: dict[str, Any]) -> int:
    time = event.get("time_ns")
    return time if isinstance(time, int) and abs(time) < 2**63 else 0
