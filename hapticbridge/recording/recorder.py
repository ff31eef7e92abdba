"""Recorder as seen by the bridge: a separate process behind the ring.

The process (``hapticbridge.recording.recorder_process``) is a new interpreter instead of a
``multiprocessing`` child, so a user's script needs no ``__main__`` guard. Its standard input
carries configuration and events, its standard output the answers, the shared ring the records.
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
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.files import limit_words, remove_file
from hapticbridge.kernel.record import TickFlag
from hapticbridge.recording import format as layout
from hapticbridge.recording.format import Attachment
from hapticbridge.recording.reader import read_hands, read_with_attachments
from hapticbridge.recording.ring import TAIL, Ring
from hapticbridge.recording.writer import check_contents, is_being_recorded, rewrite
from hapticbridge.signals import deferring_stops

# Second reader of a run


class RingObserver(Protocol):
    """Optional second reader of the ring from another process, such as the live view.

    The loop never waits for it.
    """

    def start(
        self,
        ring: str,
        snapshot: str,
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment],
    ) -> None:
        """Starts reading.

        A reader must free nothing of the ring. ``snapshot`` names the shared memory with the
        scene's positions. Metadata and attachments are those of a recording.
        """

    def event(self, event: Mapping[str, object]) -> None:
        """Receives an event; must neither block nor raise."""

    def close(self) -> None:
        """Stops reading; must not raise."""


# Waits for the recorder's process

STANDSTILL = 2.0
"""Longest wait in s for a recorder that takes no record and answers nothing. Force is zero and the
device closed by then. A shorter wait would give up a slow disk's recorder."""

MAX_CLOSE = 30.0
"""Longest wait in s for a recorder that still takes records: a full ring on a slow disk."""

_LOOK = 0.01
"""Time in s between checks of a recorder that is waited for."""

_LEFT: list[subprocess.Popen[bytes]] = []
"""Recorders left to finish by themselves; Python warns of a process that it forgets."""


# Completion of a recording whose recorder died


def salvage(path: Path, rows: NDArray[np.void], events: Sequence[Mapping[str, object]]) -> str:
    """Rewrites a cut recording with the records and events that it lacks.

    The ring keeps the last seconds of records, read or not, so records that the recorder had taken
    but not written are still available. ``rows`` and ``events`` are the newest ones, oldest first;
    of several hands, the records of each tick in the order of the hands. The file is replaced on
    success, otherwise unchanged.

    Returns:
        The outcome, as a clause.
    """
    beside = path.with_name(path.name + ".salvaged")
    try:
        recording, attachments = read_with_attachments(path, 0)
        ticks = [hand.ticks for hand in read_hands(path)]
        last = int(ticks[0]["tick"][-1]) if ticks[0].size else -1
        whole = rows[rows.size % len(ticks) :].reshape(-1, len(ticks))
        rest = whole[whole[:, 0]["tick"] > last]
        if rest.size and int(rest["tick"][0, 0]) != last + 1:
            return "the records after it are lost"
        known = {_key(event) for event in recording.events}
        kept = [*recording.events, *(event for event in events if _key(event) not in known)]
        ticks = [np.concatenate([own, rest[:, hand]]) for hand, own in enumerate(ticks)]
        rewrite(recording, attachments, beside, ticks, kept)
        beside.replace(path)
    except (RecordingError, OSError, ValueError):
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
        return "the records after it could not be written"
    return f"the bridge has repaired it: all {sum(map(len, ticks))} records are there"


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
# The package's __init__ loads MuJoCo and numba (a second, 100 MB), which the recorder does not
# need. The explicit path loads this very package with any sys.path of the child.


START_TIMEOUT = 30.0
"""Longest time in s until the recorder's file is open. A busy machine takes seconds to start it."""


class Recorder:
    """Starts the recorder's process and sends events to it without blocking the loop.

    ``start`` returns at once; the process is there within about a quarter of a second
    (``wait_until_ready``). If the caller's process dies, the recorder drains the ring, writes the
    event ``bridge_died``, closes the file and removes the shared memory. Use it from one thread.

    Args:
        ring: Ring from ``Ring.shared``; the caller closes it after the recorder.
        path: The recording, overwritten if it exists; None records nothing.
        metadata: Metadata of the recording.
        attachments: Files that the recording carries.
        live: True shows the state of the run on standard error.
        epoch_ns: Unix time of the run's start in ns; None takes the present.

    Attributes:
        is_disk_full: True if the disk is full; the file then has space only for the end of the run.
        is_left: True if the process stood still at ``close`` and was left to finish by itself.

    Raises:
        RecordingError: The ring is not shared, or metadata or attachments cannot be written.
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
        self._path, self._cursors = path, ring.cursors
        configuration = {
            "ring": ring.name,
            "parent": os.getpid(),
            "path": None if path is None else str(Path(path).absolute()),
            "metadata": dict(metadata),
            "attachments": [[each.name, each.media_type, len(each.data)] for each in attachments],
            "epoch_ns": time.time_ns() if epoch_ns is None else epoch_ns,
            "live": live,
        }
        self._answers: SimpleQueue[dict[str, Any]] = SimpleQueue()
        self._outbox = bytearray()
        self._is_started = self._is_configured = self._is_closed = False
        self.is_disk_full = False
        self.is_left = self._has_failed = False
        self._pieces = [json.dumps(configuration).encode() + b"\n"]
        self._pieces += [each.data for each in attachments]

    def start(self) -> None:
        """Starts the process; ``abort`` or ``close`` ends it, also after a stop in the middle.

        Raises:
            RecordingError: The process cannot be started.
        """
        with deferring_stops():
            self._process = recorder_process()
            self._input = cast(IO[bytes], self._process.stdin)
            self._listener = threading.Thread(target=self._listen, daemon=True)
            # in a separate thread, because attachments exceed a pipe's buffer
            self._sender = threading.Thread(target=self._configure, daemon=True)
            self._listener.start()
            self._sender.start()
            self._is_started = True

    def wait_until_ready(self) -> None:
        """Waits until the file is open and has its metadata and attachments.

        Raises:
            RecordingError: The file cannot be written, the process died, or the time is over.
        """
        try:
            answer = self._answers.get(timeout=START_TIMEOUT)
        except Empty:
            self.abort()
            raise RecordingError(f"the recorder did not start within {START_TIMEOUT:g} s") from None
        if "ready" not in answer:
            raise self._failure(answer)

    def event(self, event: Mapping[str, object], time_ns: int) -> None:
        """Sends an event to the recording; never blocks and never raises.

        ``event["event"]`` is its name; ``time_ns`` counts from the start of the run.
        """
        self._outbox += layout.event_payload(event, time_ns) + b"\n"
        self._send()

    @property
    def pid(self) -> int:
        """Number of the recorder's process."""
        return self._process.pid

    def is_alive(self) -> bool:
        """Returns True if the process runs; otherwise ``close`` raises the reason."""
        self._send()
        return self._is_started and not self._is_closed and self._process.poll() is None

    def close(self) -> None:
        """Waits until the process has written all records and finished the file.

        Call it after the last record and event. A second call, or a call after a raised error, does
        nothing. The wait ends ``STANDSTILL`` after the last sign of life.

        Raises:
            RecordingError: The process died, could not write the file, or stands still and is left
                to finish it.
        """
        if self._is_closed or self._has_failed or not self._is_started:
            self._reap()
            return
        self._outbox += b'{"close":true}\n'
        answer = self._last_answer()
        if "left" in answer:
            self._leave(answer["left"])
        elif "closed" in answer:
            self._reap()
        else:
            raise self._failure(answer)

    def abort(self) -> None:
        """Ends the process at once, for a run that never began; the file stays as it is."""
        self._has_failed = True
        if self._is_started:
            self._process.kill()
        self._reap()

    def _last_answer(self) -> dict[str, Any]:
        """Returns the answer with which the process ends; ``left``, the reason, if none comes."""
        began = heard = time.monotonic()
        before = -1, -1
        while True:
            self._send()
            with contextlib.suppress(Empty):
                answer = self._answers.get(timeout=_LOOK)
                if not answer.keys().isdisjoint(("closed", "error", "exited")):
                    return answer
            now, state = time.monotonic(), (int(self._cursors[TAIL]), len(self._outbox))
            if state != before:
                before, heard = state, now
            if now > heard + STANDSTILL:
                return {"left": f"stood still for {STANDSTILL:g} s"}
            if now > began + MAX_CLOSE:
                return {"left": f"worked for {MAX_CLOSE:g} s"}

    def _leave(self, reason: str) -> None:
        """Leaves a process that stands still to finish its file, or ends one without a file.

        Raises:
            RecordingError: There is a file.
        """
        if self._path is None:
            self.abort()
            return
        self._is_closed = self._has_failed = self.is_left = True
        _LEFT.append(self._process)
        with contextlib.suppress(OSError):
            self._input.close()  # it ends its input, and so the recording, where the close waited
        pid = self._process.pid
        raise RecordingError(
            f"the recorder (process {pid}) has {reason} and is left to "
            f"finish '{self._path}', which is whole once that process has ended; "
            f"'kill -CONT {pid}' wakes it if it was stopped"
        )

    def _failure(self, answer: Mapping[str, Any]) -> RecordingError:
        self._has_failed = True
        self._reap()
        if "error" in answer:
            return RecordingError(str(answer["error"]))
        status = self._process.returncode
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        return RecordingError(
            f"the recorder's process {how}; the recording is readable up to the last whole "
            "chunk; 'hapticbridge repair' makes it whole"
        )

    def _reap(self) -> None:
        self._is_closed = True
        if self.is_left or not self._is_started:
            return
        for _ in range(2):
            try:
                self._process.wait(STANDSTILL)
                break
            except subprocess.TimeoutExpired:  # it gave its last answer, or was killed
                self._process.kill()
        else:  # inside a disk that does not answer; the system ends it after that
            _LEFT.append(self._process)
        self._sender.join(STANDSTILL)
        with contextlib.suppress(OSError):  # what is unsent has no receiver
            self._input.close()
        self._listener.join(STANDSTILL)

    def _configure(self) -> None:
        try:
            for piece in self._pieces:
                _write(self._input, piece)
            _set_blocking(self._input, False)
            self._is_configured = True
        except (OSError, ValueError):
            pass  # it died or was closed before it was ready; ``wait_until_ready`` raises

    def _send(self) -> None:
        if not self._outbox or not self._is_configured or self._is_closed:
            return
        try:
            sent = os.write(self._input.fileno(), self._outbox)
            del self._outbox[:sent]
        except BlockingIOError:
            pass  # the pipe is full: the next call tries again
        except OSError:
            self._outbox.clear()  # the process died; ``close`` raises the reason

    def _listen(self) -> None:
        with cast(IO[bytes], self._process.stdout) as answers:
            for line in answers:
                answer = json.loads(line)
                if "full" in answer:
                    self.is_disk_full = True
                else:
                    self._answers.put(answer)
        self._answers.put({"exited": True})


def recorder_process() -> subprocess.Popen[bytes]:
    """Starts a recorder's process, which waits for its configuration.

    Raises:
        RecordingError: The process cannot be started.
    """
    package = str(Path(__file__).resolve().parents[1])
    try:
        return subprocess.Popen(
            # -P: a file in the user's working folder must not replace a module
            [sys.executable, "-P", "-c", _BOOTSTRAP, package],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            # Ctrl-C and a hang-up reach the bridge alone, which then closes the recording
            start_new_session=True,
        )
    except OSError as error:
        raise RecordingError(
            f"the recorder cannot be started: {limit_words(error.errno) or error.strerror}"
        ) from error


def _write(stream: IO[bytes], data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[stream.write(view) :]


def _set_blocking(stream: IO[bytes], is_blocking: bool) -> None:
    # on Windows from Python 3.12 on; before, a full pipe makes ``event`` block
    if sys.platform != "win32" or sys.version_info >= (3, 12):
        os.set_blocking(stream.fileno(), is_blocking)


# Bridge's end of a recording

RING_SECONDS, MAX_RECORDS = 8.0, 1 << 16
"""Capacity of the ring in s, and at most in records of 400 bytes: the lag of the recorder before a
record is lost. A trip's exception carries its last second."""

NOBODY_READS = 1 << 62
"""Tail cursor of a ring without a recorder; the ring is never full and keeps the newest records."""

RING_POLL = 1e-3
"""Time in s between checks for space in the ring, in simulated time."""

KEPT_EVENTS = 4096
"""Number of events kept to be written again if the recorder dies; more would only cost memory."""

RING_PATIENCE = 30.0
"""Longest wait in s for space in the ring while the recorder takes no record, in simulated time."""


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """Returns values that change when a file is opened for a recording; None without a file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


_ENDED = "the recorder ended during the run; the recording stops there"
_FULL = "the disk is full; the recording ends here and is whole"


@dataclass(frozen=True, slots=True)
class RecordOutput:
    """Destinations of a run's records.

    Attributes:
        path: File of the recording, overwritten if it exists; None records nothing.
        observer: Second reader of the ring, such as ``view.Window``, for which the loop never
            waits; None without one.
        live: True shows the state of the run on standard error.
    """

    path: Path | None = None
    observer: RingObserver | None = None
    live: bool = False


class RecordStream:
    """Records leave through a ring, events through a pipe; the loop never waits in real time.

    ``kernel.tick.publish`` writes to ``rows`` and ``cursors``. With a file or a status line the
    recorder's process reads them; otherwise the ring keeps the newest records. Close it after the
    loop in any case.

    Args:
        output: Destinations of the records.
        period: T in s, which determines the ring's capacity.
        may_wait: True if the loop may wait for the recorder (simulated time) instead of losing
            records.
        snapshot: Name of the shared memory with the scene's positions, for the observer.
        hands: Number of hands; the ring has a record per hand of each tick, in order.

    Attributes:
        rows: The ring's records, ``TICK_DTYPE``.
        cursors: The ring's cursors, ``kernel.tick.HEAD`` and ``TAIL``.
        recorder: The recorder's process once started; None without one.
        lost: Flag of the next record: ``DROPPED_BEFORE`` if the one before it was lost, else 0.
        dropped: Number of lost records.

    Raises:
        RecordingError: There is no memory for the ring.
    """

    def __init__(
        self,
        output: RecordOutput,
        period: float,
        *,
        may_wait: bool,
        snapshot: str = "",
        hands: int = 1,
    ) -> None:
        self._path, self._is_live, self._may_wait = output.path, output.live, may_wait
        self._is_read = output.path is not None or output.live
        self._hands = hands
        capacity = min(hands * round(RING_SECONDS / period), MAX_RECORDS) // hands * hands
        self._observer, self._snapshot = output.observer, snapshot
        is_shared = self._is_read or output.observer is not None
        self._ring = Ring.shared(capacity) if is_shared else Ring.local(capacity)
        self.rows, self.cursors = self._ring.rows, self._ring.cursors
        if not self._is_read:
            self.cursors[TAIL] = NOBODY_READS
        self.recorder: Recorder | None = None
        self.lost = self.dropped = 0
        self._taken, self._taken_at = -1, 0.0
        self._stamp_before: tuple[int, int, int] | None = None
        self._events: deque[dict[str, Any]] = deque(maxlen=KEPT_EVENTS)

    @property
    def is_read(self) -> bool:
        """True if there is a reader, so that ``start`` must be called."""
        return self._is_read or self._observer is not None

    def start(self, metadata: Mapping[str, str], attachments: Sequence[Attachment]) -> None:
        """Starts the recorder's process and waits until the file is open.

        Raises:
            RecordingError: The process cannot be started, or the file cannot be written.
        """
        if self._is_read:
            self._stamp_before = None if self._path is None else _stamp(self._path)
            self.recorder = Recorder(
                self._ring, self._path, metadata, attachments, live=self._is_live
            )
            self.recorder.start()
            self.recorder.wait_until_ready()
        if self._observer is not None:
            self._observer.start(str(self._ring.name), self._snapshot, metadata, attachments)
        self.notify_observer(
            {"event": "recording", "path": None if self._path is None else str(self._path)}
        )

    def notify_observer(self, news: Mapping[str, object]) -> None:
        """Sends news to the observer only; never blocks and never raises."""
        if self._observer is not None:
            self._observer.event(news)

    def makes_room(self, *, is_stopping: bool) -> bool:
        """Handles a record refused by a full ring.

        A run that was told to stop must not wait (``is_stopping``).

        Returns:
            True after a wait in simulated time, to try again. False if the record is counted as
            lost.

        Raises:
            RecordingError: The recorder's process ended, or stood still for ``RING_PATIENCE``.
        """
        if self.recorder is None or not self.recorder.is_alive():
            raise RecordingError(_ENDED)
        if self._may_wait and not is_stopping:
            taken, now = int(self.cursors[TAIL]), time.monotonic()
            if taken != self._taken:
                self._taken, self._taken_at = taken, now
            elif now - self._taken_at > RING_PATIENCE:
                raise RecordingError(f"the recorder has taken no record for {RING_PATIENCE:g} s")
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
        if self._observer is not None:
            self._observer.event(payload)

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
        """Returns copies of the newest ``count`` ticks, oldest first, with a record per hand."""
        return self._ring.latest(self._hands * count)

    def close(self, *, is_discarded: bool = False) -> None:
        """Waits until the recorder has finished the file, and removes the shared memory.

        A run that never began has no recording (``is_discarded``): its file is removed.

        Raises:
            RecordingError: The recorder's process died, could not write the file, or stands still.
        """
        try:
            if self.recorder is not None and is_discarded:
                self._discard(self.recorder)
            elif self.recorder is not None:
                self._close_recorder(self.recorder)
        finally:
            if self._observer is not None:
                self._observer.close()
            self._ring.close()

    def _discard(self, recorder: Recorder) -> None:
        recorder.abort()
        path = self._path
        # else the recorder never opened it: it holds an earlier run, or that of another bridge
        is_opened = path is not None and _stamp(path) != self._stamp_before
        if path is not None and is_opened and not is_being_recorded(path):
            remove_file(path)

    def _close_recorder(self, recorder: Recorder) -> None:
        try:
            recorder.close()
        except RecordingError as error:
            if recorder.is_left:
                raise  # it may still write the file
            if self._path is None or not self._path.exists() or not self._ring.rows.size:
                raise
            last = self._events[-1]["time_ns"] if self._events else 0
            died = {"event": "recorder_died", "reason": str(error), "time_ns": last}
            rows = self._ring.latest(self._ring.capacity)
            outcome = salvage(self._path, rows, [*self._events, died])
            raise RecordingError(f"{error}; {outcome}") from None
