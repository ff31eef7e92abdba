"""The recorder as the bridge sees it: a process of its own behind the ring.

The process (``hapticbridge.recording.recorder_process``) is started as a new interpreter, not by
``multiprocessing``, so a user's script needs no ``__main__`` guard. Configuration and events go
through its standard input, its answers come back through its standard output, records through the
shared-memory ring.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.record import TickFlag
from hapticbridge.recording import format as layout
from hapticbridge.recording.format import Attachment
from hapticbridge.recording.reader import read_with_attachments
from hapticbridge.recording.ring import TAIL, Ring
from hapticbridge.recording.writer import RecordingWriter, check_contents

# Who may look at a run beside its recorder.


class RingObserver(Protocol):
    """Looks at a run from another process; the loop neither waits for it nor asks it anything."""

    def start(
        self,
        ring: str,
        snapshot: str,
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment],
    ) -> None:
        """Starts looking.

        Args:
            ring: Name of the ring, as ``Ring.attach`` takes it; what attaches must free nothing.
            snapshot: Name of the scene's newest positions, as ``Snapshot.attach`` takes it.
            metadata: Of the run, as a recording has them.
            attachments: Likewise.
        """

    def event(self, event: Mapping[str, object]) -> None:
        """Takes an event; must neither wait nor raise."""

    def close(self) -> None:
        """Ends looking; must not raise."""


# Makes a recording whole whose recorder died while the bridge lived on.
#
# The ring keeps the last seconds of records, read or not: what the recorder had taken and not
# yet written is still there.


def salvage(path: Path, rows: NDArray[np.void], events: Sequence[Mapping[str, object]]) -> str:
    """Writes a cut recording again, with the records and events that it lacks.

    Args:
        path: The recording; replaced at once where all goes well, else left as it is.
        rows: The newest records, oldest first, ``TICK_DTYPE``.
        events: The newest events, oldest first, with ``time_ns``.

    Returns:
        What became of it, as a clause.
    """
    beside = path.with_name(path.name + ".salvaged")
    try:
        recording, attachments = read_with_attachments(path)
        ticks = recording.ticks
        last = int(ticks["tick"][-1]) if ticks.size else -1
        rest = rows[rows["tick"] > last]
        if rest.size and int(rest["tick"][0]) != last + 1:
            return "the records behind that are lost"
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
        return "the records behind that could not be written"
    total = ticks.size + rest.size
    return f"the bridge has done so: all {total} records are there"


def _key(event: Mapping[str, object]) -> tuple[object, ...]:
    return event.get("event"), event.get("tick"), event.get("time_ns")


_BOOTSTRAP = """
import sys, types
package = types.ModuleType("hapticbridge")
package.__path__ = [sys.argv[1]]
sys.modules["hapticbridge"] = package
from hapticbridge.recording.recorder_process import run
run()
"""
# The package's own __init__ loads MuJoCo and numba (a second, 100 MB), which the recorder needs
# not; and found by its path, it is this very package, whatever sys.path the child has.


class Recorder:
    """Starts the recorder's process and talks to it, without ever waiting inside the loop.

    The constructor returns at once; the process starts (about a quarter of a second) while the
    caller does something else, until ``wait_until_ready``. If the caller's process dies, the
    recorder drains the ring, writes the event ``bridge_died``, closes the file and removes the
    shared memory. To be used from one thread.

    Args:
        ring: A ring made by ``Ring.shared``; the caller closes it after the recorder.
        path: The recording, overwritten if it exists; None records nothing.
        metadata: Names and values of the recording's metadata.
        attachments: Files that the recording carries.
        live: Whether the process shows the state of the run on standard error.
        epoch_ns: Unix time of the run's start, in ns; now if it is not given.

    Attributes:
        is_disk_full: Whether the disk is; the file then takes no more than a run that ends.

    Raises:
        RecordingError: The ring is not shared, metadata or attachments cannot be written, or the
            process cannot be started.
    """

    def __init__(
        self,
        ring: Ring,
        path: str | Path | None,
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment],
        *,
        live: bool = False,
        epoch_ns: int | None = None,
    ) -> None:
        if ring.name is None:
            raise RecordingError("the recorder needs a shared ring, not a local one")
        check_contents(metadata, attachments)
        configuration = {
            "ring": ring.name,
            "parent": os.getpid(),
            "path": None if path is None else str(Path(path).absolute()),
            "metadata": dict(metadata),
            "attachments": [[item.name, item.media_type, len(item.data)] for item in attachments],
            "epoch_ns": time.time_ns() if epoch_ns is None else epoch_ns,
            "live": live,
        }
        self._answers: SimpleQueue[dict[str, Any]] = SimpleQueue()
        self._outbox = bytearray()
        self._is_configured = False
        self._is_closed = False
        self.is_disk_full = False
        self._has_failed = False
        self._process = _start()
        self._input = cast(IO[bytes], self._process.stdin)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        pieces = [json.dumps(configuration).encode() + b"\n"]
        pieces += [item.data for item in attachments]
        # in a thread of its own, because attachments are larger than what a pipe takes at once
        self._sender = threading.Thread(target=self._configure, args=(pieces,), daemon=True)
        self._sender.start()

    def wait_until_ready(self, timeout: float = 30.0) -> None:
        """Waits until the file is open and carries its metadata and attachments.

        Args:
            timeout: Longest wait in s.

        Raises:
            RecordingError: The file cannot be written, the process died, or time is over.
        """
        try:
            answer = self._answers.get(timeout=timeout)
        except Empty:
            self._has_failed = True
            self._process.kill()
            self._reap()
            raise RecordingError(f"the recorder did not start within {timeout} s") from None
        if "ready" not in answer:
            raise self._failure(answer)

    def event(self, event: Mapping[str, object], time_ns: int) -> None:
        """Sends an event to the recording; never waits and never raises.

        Args:
            event: What happened: ``event`` names it, the rest is its data.
            time_ns: When, in ns since the start of the run.
        """
        self._outbox += layout.event_payload(event, time_ns) + b"\n"
        self._send()

    def is_alive(self) -> bool:
        """Returns whether the process runs; if not, ``close`` says why."""
        self._send()
        return not self._is_closed and self._process.poll() is None

    def close(self) -> None:
        """Lets the process write all that is in the ring and finish the file.

        To be called after the last record and event. The second call does nothing, and neither
        does one after an error that was already raised.

        Raises:
            RecordingError: The process died, or could not write the file.
        """
        if self._is_closed or self._has_failed:
            self._reap()
            return
        self._sender.join()
        try:
            _set_blocking(self._input, True)
            _write(self._input, bytes(self._outbox) + b'{"close": true}\n')
        except OSError:
            pass  # it died; its last answer or its exit status says why
        self._outbox.clear()
        answer: dict[str, Any] = {}
        while "closed" not in answer and "error" not in answer and "exited" not in answer:
            answer = self._answers.get()
        if "closed" not in answer:
            raise self._failure(answer)
        self._reap()

    def _failure(self, answer: Mapping[str, Any]) -> RecordingError:
        self._has_failed = True
        self._reap()
        if "error" in answer:
            return RecordingError(str(answer["error"]))
        status = self._process.returncode
        how = f"killed by signal {-status}" if status < 0 else f"ended with status {status}"
        return RecordingError(
            f"the recorder's process was {how}; what it wrote is readable up to the last whole "
            "chunk, and 'hapticbridge repair' makes a whole file of it"
        )

    def _reap(self) -> None:
        self._is_closed = True
        self._process.wait()
        self._sender.join()
        with contextlib.suppress(OSError):  # what is unsent has no receiver
            self._input.close()
        self._listener.join()

    def _configure(self, pieces: list[bytes]) -> None:
        try:
            for piece in pieces:
                _write(self._input, piece)
            _set_blocking(self._input, False)
            self._is_configured = True
        except (OSError, ValueError):
            pass  # it died or was closed before it was ready: ``wait_until_ready`` says so

    def _send(self) -> None:
        if not self._outbox or not self._is_configured or self._is_closed:
            return
        try:
            sent = os.write(self._input.fileno(), self._outbox)
            del self._outbox[:sent]
        except BlockingIOError:
            pass  # the pipe is full: the next call tries again
        except OSError:
            self._outbox.clear()  # it died: nobody reads events any more, ``close`` says why

    def _listen(self) -> None:
        with cast(IO[bytes], self._process.stdout) as answers:
            for line in answers:
                answer = json.loads(line)
                if "full" in answer:
                    self.is_disk_full = True
                else:
                    self._answers.put(answer)
        self._answers.put({"exited": True})


def _start() -> subprocess.Popen[bytes]:
    package = str(Path(__file__).resolve().parents[1])
    try:
        return subprocess.Popen(
            # -P: a file in the user's working folder must not stand in for a module
            [sys.executable, "-P", "-c", _BOOTSTRAP, package],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            # Ctrl-C and a hang-up reach the bridge alone, which then closes the recording
            start_new_session=True,
        )
    except OSError as error:
        raise RecordingError(f"the recorder cannot be started: {error.strerror}") from error


def _write(stream: IO[bytes], data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[stream.write(view) :]


def _set_blocking(stream: IO[bytes], is_blocking: bool) -> None:
    # pipes of Windows know this from Python 3.12 on; before, a full pipe makes ``event`` wait
    if sys.platform != "win32" or sys.version_info >= (3, 12):
        os.set_blocking(stream.fileno(), is_blocking)


# The bridge's end of a recording: records leave through a ring, events through a pipe.

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
        onlooker: RingObserver | None = None,
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
