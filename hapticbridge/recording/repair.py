"""Repair of a cut recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.recording import format as layout
from hapticbridge.recording.format import Attachment
from hapticbridge.recording.reader import Recording, read_hands, read_with_attachments
from hapticbridge.recording.writer import RecordingWriter

_BATCH = 4096
"""Records written at once. A larger batch takes more memory, a smaller one more time."""


def repair(path: str | Path, output: str | Path) -> Recording:
    """Writes a cut recording again as a whole one.

    Metadata, attachments, and all whole records and events are kept. An event ``repaired``
    describes the repair, and the digest is computed anew.

    Returns:
        The new recording, as read back; of several hands, that of the first.

    Raises:
        RecordingError: The recording cannot be read or is not cut, or the output exists or cannot
            be written.
    """
    path, output = Path(path), Path(output)
    recording, attachments = read_with_attachments(path, 0)
    if not recording.is_cut:
        raise RecordingError(f"{path} is not cut, so there is nothing to repair")
    deadlines = recording.ticks["deadline_ns"][-1:].tolist()
    made = {
        "event": "repaired",
        "source": path.name,
        "ticks": int(recording.ticks.size),
        "problems": list(recording.problems),
        "time_ns": max([*deadlines, *map(_time, recording.events)], default=0),
    }
    events = [*recording.events, made]
    ticks = [recording.ticks, *(hand.ticks for hand in read_hands(path)[1:])]
    rewrite(recording, attachments, output, ticks, events, exclusive=True)
    return read_hands(output)[0]


def rewrite(
    recording: Recording,
    attachments: Sequence[Attachment],
    output: Path,
    ticks: Sequence[NDArray[np.void]],
    events: Sequence[Mapping[str, object]],
    *,
    exclusive: bool = False,
) -> None:
    """Writes a recording's metadata and attachments again, with these records and events.

    ``ticks`` are the records of each hand, equally many.

    Digest, chain and index are computed anew. A signature is not kept, because it is of another
    file.

    Raises:
        RecordingError: The file cannot be written, or exists and the access is ``exclusive``.
    """
    writer = RecordingWriter(
        output,
        recording.meta,
        attachments,
        layout.epoch_of(recording.meta),
        exclusive=exclusive,
        record=recording.record,
    )
    written = 0

    def write_until(stop: int) -> None:
        nonlocal written
        for start in range(written, stop, _BATCH):
            for hand, own in enumerate(ticks):
                writer.write_ticks(own[start : min(start + _BATCH, stop)], hand)
        written = max(written, stop)

    try:
        for event in events:  # each where it happened, so that a later cut does not lose them all
            time = _time(event)
            write_until(int(np.searchsorted(ticks[0]["deadline_ns"], time, side="right")))
            writer.write_event(event, time)
        write_until(ticks[0].size)
        writer.close()
    except RecordingError:
        output.unlink(missing_ok=True)
        raise


def _time(event: Mapping[str, object]) -> int:
    time = event.get("time_ns")
    return time if isinstance(time, int) and abs(time) < 2**63 else 0
