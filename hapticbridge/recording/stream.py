"""The bridge's end of a recording: records leave through a ring, events through a pipe."""

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
"""How far the recorder may fall behind before a record is lost, in s and in records of 400 bytes;
a trip hands the last second of them to whoever catches it."""

NOBODY_READS = 1 << 62
"""Tail of a ring without a recorder: it is never full and keeps the newest records."""

RING_POLL = 1e-3
"""How often a run in simulated time looks whether the recorder made room, in s."""

KEPT_EVENTS = 4096
"""Events that can be written again should the recorder die; more cost memory alone."""

_ENDED = "the recorder ended in mid-run; the recording stops there"
_FULL = "the disk is full; the recording ends here, and is whole"


class RecordStream:
    """Where the loop leaves its records and events; it never waits in real time.

    ``rows`` and ``cursors`` are what ``kernel.publish.publish`` writes to. Where a file or a status
    line is asked for, the recorder's process reads them; else the ring keeps the newest records.
    To be closed after the loop, whatever happened.

    Args:
        path: The recording, overwritten if it exists; None records nothing.
        period: T in s; with it, how many records the ring must hold.
        live: Whether the recorder's process shows the state of the run on standard error.
        is_lossless: Whether the loop may wait for the recorder (simulated time) instead of losing
            records.
        onlooker: Who looks at the newest records beside the recorder, unasked and unwaited for.
        snapshot: Name of the shared memory with the scene's positions, for the onlooker.

    Attributes:
        rows: The ring's records, ``TICK_DTYPE``.
        cursors: The ring's cursors, ``kernel.publish.HEAD`` and ``TAIL``.
        recorder: The recorder's process, once started; None where nobody reads.
        lost: Flag of the next record: ``DROPPED_BEFORE`` if the one before it was lost, else 0.
        dropped: How many records were lost.

    Raises:
        RecordingError: There is no room for the ring.
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
        """Whether anybody reads the records, so that ``start`` is to be called."""
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
        """Tells the onlooker alone, if there is one; never waits and never raises."""
        if self._onlooker is not None:
            self._onlooker.event(news)

    def makes_room(self, *, may_wait: bool) -> bool:
        """Answers a ring that refused a record: try it again, or it is lost.

        Args:
            may_wait: Whether the run still goes on; a run that was told to stop waits for nobody.

        Returns:
            True after a wait, in simulated time. False where the record is counted as lost.

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
        """Notes what happened, if anybody reads; never waits and never raises.

        Args:
            event: Its name.
            tick: The tick before which it happened.
            time_ns: When, in ns since the start of the run.
            **details: What else is to be known of it.
        """
        told = {"event": event, "tick": tick, **details}
        if self.recorder is not None:
            self._events.append(told | {"time_ns": time_ns})
            self.recorder.event(told, time_ns)
        if self._onlooker is not None:
            self._onlooker.event(told)

    def look(self) -> None:
        """Looks whether the recorder still lives and has room; takes some microseconds.

        Raises:
            RecordingError: It does not, or its disk is full.
        """
        if self.recorder is not None and self.recorder.is_disk_full:
            raise RecordingError(_FULL)
        if self.recorder is not None and not self.recorder.is_alive():
            raise RecordingError(_ENDED)

    def latest(self, count: int) -> NDArray[np.void]:
        """Returns copies of the newest records, oldest first."""
        return self._ring.latest(count)

    def close(self) -> None:
        """Lets the recorder finish the file and removes the shared memory.

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
