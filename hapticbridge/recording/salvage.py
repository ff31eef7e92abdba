"""Completion of a recording whose recorder died."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.recording import format as layout
from hapticbridge.recording.reader import read_with_attachments
from hapticbridge.recording.writer import RecordingWriter


def salvage(path: Path, rows: NDArray[np.void], events: Sequence[Mapping[str, object]]) -> str:
    """Rewrites a cut recording with the records and events that it lacks.

    The ring keeps the last seconds of records, read or not, so records that the recorder had taken
    but not written are still available. ``rows`` and ``events`` are the newest ones, oldest first.
    The file is replaced on success, otherwise unchanged.

    Returns:
        The outcome, as a clause.
    """
    beside = path.with_name(path.name + ".salvaged")
    try:
        recording, attachments = read_with_attachments(path)
        ticks = recording.ticks
        last = int(ticks["tick"][-1]) if ticks.size else -1
        rest = rows[rows["tick"] > last]
        if rest.size and int(rest["tick"][0]) != last + 1:
            return "the records after it are lost"
        epoch = recording.meta.get(layout.EPOCH_KEY, "0")
        writer = RecordingWriter(beside, recording.meta, attachments, int(epoch))
        writer.write_ticks(ticks)
        writer.write_ticks(rest)
        known = {_key(event) for event in recording.events}
        kept = [*recording.events, *(event for event in events if _key(event) not in known)]
        for event in kept:
            time = event.get("time_ns")
            writer.write_event(event, time if isinstance(time, int) else 0)
        writer.close()
        beside.replace(path)
    except (RecordingError, OSError, ValueError):
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
        return "the records after it could not be written"
    total = ticks.size + rest.size
    return f"the bridge has repaired it: all {total} records are there"


def _key(event: Mapping[str, object]) -> tuple[object, ...]:
    return event.get("event"), event.get("tick"), event.get("time_ns")
