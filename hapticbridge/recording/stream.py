"""Bridge's end of a recording."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.recording.format import Attachment
from hapticbridge.recording.onlooker import Onlooker
from hapticbridge.recording.recorder import Recorder
from hapticbridge.recording.ring import TAIL, Ring
from hapticbridge.recording.salvage import salvage
from hapticbridge.tick import TickFlag

RING_SECONDS, MOST_RECORDS = 8.0, 1 << 16
"""Capacity of the ring in s, and at most in records of 400 bytes: the lag of the recorder before a
record is lost. A trip's exception carries its last second."""

NOBODY_READS = 1 << 62
"""Tail cursor of a ring without a recorder; the ring is never full and keeps the newest records."""

RING_POLL = 1e-3
"""Time in s between checks for space in the ring, in simulated time."""

KEPT_EVENTS = 4096
"""Number of events kept to be written again if the recorder dies; more would only cost memory."""

_ENDED = "the recorder ended during the run; the recording stops there"
_FULL = "the disk is full; the recording ends here and is whole"


class RecordStream:
    """Records leave through a ring, events through a pipe; the loop never waits in real time.

    ``kernel.publish.publish`` writes to ``rows`` and ``cursors``. With a file or a status line the
    recorder's process reads them; otherwise the ring keeps the newest records. Close it after the
    loop in any case.

    Args:
        path: The recording, overwritten if it exists; None records nothing.
        period: T in s, which determines the ring's capacity.
        live: True shows the state of the run on standard error.
        is_lossless: True if the loop may wait for the recorder (simulated time) instead of losing
            records.
        onlooker: Optional second reader of the ring, such as the live view. The loop never waits
            for it.

    Attributes:
        rows: The ring's records, ``TICK_DTYPE``.
        cursors: The ring's cursors, ``kernel.publish.HEAD`` and ``TAIL``.
        recorder: The recorder's process once started; None without one.
        lost: Flag of the next record: ``DROPPED_BEFORE`` if the one before it was lost, else 0.
        dropped: Number of lost records.

    Raises:
        RecordingError: There is no memory for the ring.
    """

    def __init__(
        self,
        path: Path | None,
        period: float,
        *,
        live: bool,
        is_lossless: bool,
        onlooker: Onlooker | None = None,
        snapshot: str = "",
    ) -> None:
        self._path, self._is_live, self._is_lossless = path, live, is_lossless
        self._is_read = path is not None or live
        capacity = min(round(RING_SECONDS / period), MOST_RECORDS)
        self._onlooker, self._snapshot = onlooker, snapshot
        is_shared = self._is_read or onlooker is not None
        self._ring = Ring.shared(capacity) if is_shared else Ring.local(capacity)
        self.rows, self.cursors = self._ring.rows, self._ring.cursors
        if not self._is_read:
            self.cursors[TAIL] = NOBODY_READS
        self.recorder: Recorder | None = None
        self.lost = self.dropped = 0
        self._events: deque[dict[str, Any]] = deque(maxlen=KEPT_EVENTS)

    @property
    def is_read(self) -> bool:
        """True if there is a reader, so that ``start`` must be called."""
        return self._is_read or self._onlooker is not None

    def start(self, metadata: Mapping[str, str], attachments: Sequence[Attachment]) -> None:
        """Starts the recorder's process and waits until the file is open.

        Raises:
            RecordingError: The process cannot be started, or the file cannot be written.
        """
        if self._is_read:
            self.recorder = Recorder(
                self._ring, self._path, metadata, attachments, live=self._is_live
            )
            self.recorder.wait_until_ready()
        if self._onlooker is not None:
            self._onlooker.start(str(self._ring.name), self._snapshot, metadata, attachments)
        self.tell({"event": "recording", "path": None if self._path is None else str(self._path)})

    def tell(self, news: Mapping[str, object]) -> None:
        """Sends news to the onlooker only; never blocks and never raises."""
        if self._onlooker is not None:
            self._onlooker.event(news)

    def makes_room(self, *, may_wait: bool) -> bool:
        """Handles a record refused by a full ring.

        A run that was told to stop must not wait (``may_wait``).

        Returns:
            True after a wait in simulated time, to try again. False if the record is counted as
            lost.

        Raises:
            RecordingError: The recorder's process ended.
        """
        if self.recorder is None or not self.recorder.is_alive():
            raise RecordingError(_ENDED)
        if self._is_lossless and may_wait:
            time.sleep(RING_POLL)
            return True
        self.dropped += 1
        self.lost = int(TickFlag.DROPPED_BEFORE)
        return False

    def event(self, event: str, tick: int, time_ns: int, **details: object) -> None:
        """Sends an event to all readers; never blocks and never raises.

        It happened before ``tick``; ``time_ns`` counts from the start of the run.
        """
        payload = {"event": event, "tick": tick, **details}
        if self.recorder is not None:
            self._events.append(payload | {"time_ns": time_ns})
            self.recorder.event(payload, time_ns)
        if self._onlooker is not None:
            self._onlooker.event(payload)

    def look(self) -> None:
        """Checks that the recorder lives and its disk has space; takes some microseconds.

        Raises:
            RecordingError: The recorder ended, or its disk is full.
        """
        if self.recorder is not None and self.recorder.is_disk_full:
            raise RecordingError(_FULL)
        if self.recorder is not None and not self.recorder.is_alive():
            raise RecordingError(_ENDED)

    def latest(self, count: int) -> NDArray[np.void]:
        """Returns copies of the newest records, oldest first."""
        return self._ring.latest(count)

    def close(self) -> None:
        """Waits until the recorder has finished the file, and removes the shared memory.

        Raises:
            RecordingError: The recorder's process died, or could not write the file.
        """
        try:
            if self.recorder is not None:
                self._close_recorder(self.recorder)
        finally:
            if self._onlooker is not None:
                self._onlooker.close()
            self._ring.close()

    def _close_recorder(self, recorder: Recorder) -> None:
        try:
            recorder.close()
        except RecordingError as error:
            if self._path is None or not self._path.exists() or not self._ring.rows.size:
                raise
            last = self._events[-1]["time_ns"] if self._events else 0
            died = {"event": "recorder_died", "reason": str(error), "time_ns": last}
            rows = self._ring.latest(self._ring.capacity)
            outcome = salvage(self._path, rows, [*self._events, died])
            raise RecordingError(f"{error}; {outcome}") from None
