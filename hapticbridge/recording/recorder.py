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
from collections.abc import Mapping, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, Any, cast

from hapticbridge.errors import RecordingError
from hapticbridge.recording import format as layout
from hapticbridge.recording.format import Attachment
from hapticbridge.recording.ring import Ring
from hapticbridge.recording.writer import check_contents

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


class Recorder:
    """Starts the recorder's process and sends events to it without blocking the loop.

    The constructor returns at once; the process starts within about a quarter of a second
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
        # in a separate thread, because attachments exceed a pipe's buffer
        self._sender = threading.Thread(target=self._configure, args=(pieces,), daemon=True)
        self._sender.start()

    def wait_until_ready(self, timeout: float = 30.0) -> None:
        """Waits until the file is open and has its metadata and attachments.

        ``timeout`` is the longest wait in s.

        Raises:
            RecordingError: The file cannot be written, the process died, or the time is over.
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
        """Sends an event to the recording; never blocks and never raises.

        ``event["event"]`` is its name; ``time_ns`` counts from the start of the run.
        """
        self._outbox += layout.event_payload(event, time_ns) + b"\n"
        self._send()

    def is_alive(self) -> bool:
        """Returns True if the process runs; otherwise ``close`` raises the reason."""
        self._send()
        return not self._is_closed and self._process.poll() is None

    def close(self) -> None:
        """Waits until the process has written all records and finished the file.

        Call it after the last record and event. A second call, or a call after a raised error, does
        nothing.

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
            pass  # the process died; its last answer or exit status holds the reason
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
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        return RecordingError(
            f"the recorder's process {how}; the recording is readable up to the last whole "
            "chunk; 'hapticbridge repair' makes it whole"
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


def _start() -> subprocess.Popen[bytes]:
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
        raise RecordingError(f"the recorder cannot be started: {error.strerror}") from error


def _write(stream: IO[bytes], data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[stream.write(view) :]


def _set_blocking(stream: IO[bytes], is_blocking: bool) -> None:
    # on Windows from Python 3.12 on; before, a full pipe makes ``event`` block
    if sys.platform != "win32" or sys.version_info >= (3, 12):
        os.set_blocking(stream.fileno(), is_blocking)
