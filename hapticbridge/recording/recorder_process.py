"""Recorder's process: drains the ring into the file, and outlives the bridge.

``hapticbridge.recording.recorder`` starts it. Its standard input carries one line of JSON, the
attachments' bytes, one line per event, and ``close``. Its answers on standard output are ``ready``,
``full``, ``closed`` or ``error``. If the input ends before ``close``, the bridge died.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import sys
import threading
import time
import traceback
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, Any, NoReturn, TextIO

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.live import Live
from rich.text import Text

from hapticbridge.errors import RecordingError
from hapticbridge.files import remove_file
from hapticbridge.kernel.record import TICK_DTYPE, TickFlag
from hapticbridge.recording.format import SHOWN_EVENT, Attachment, further_hands
from hapticbridge.recording.ring import Ring
from hapticbridge.recording.writer import RecordingWriter
from hapticbridge.units import format_energy, format_forces

# Live status line of a run

REDRAW = 0.125
"""Time in s between two drawings on a terminal."""

REPRINT = 2.0
"""Time in s between two plain lines."""


SILENCE = 0.2
"""Least time in s without a new sample of the device that is shown. A hand notices that the force
is gone; a slow device has a sample within it."""

LOWERED = {
    int(TickFlag.RUNS_AWAY): "FORCE TAKEN AWAY: the device does not move as it is pushed",
    int(TickFlag.SWINGING): "FORCE LOWERED: the device answers late, or an axis is reversed",
}
"""Words on a force that the watch lowered, by its flag; the first that was seen is shown."""


class RunState:
    """State of a run for the status line, collected from records.

    ``are_held`` has an entry per hand of the run: True if a hand feels the force of its device.
    """

    def __init__(self, are_held: tuple[bool, ...] = (True,)) -> None:
        self._are_held = are_held
        self._last: NDArray[np.void] | None = None
        self._last_tick = -1
        self._flags = 0
        self._overruns = 0
        self._dropped = 0
        self._fresh_ns = np.zeros(len(are_held))
        self._silence = self._longest_silence = 0.0

    def add(self, rows: NDArray[np.void]) -> None:
        """Adds new records, ``TICK_DTYPE``: of n >= 1 ticks, in each tick one per hand."""
        count = len(self._are_held)
        self._last = rows[-count:].copy()
        self._flags |= int(np.bitwise_or.reduce(rows["flags"]))
        self._add_silence(rows.reshape(-1, count))
        rows = rows[::count]  # counted by the first hand
        self._overruns += int(np.count_nonzero(rows["flags"] & TickFlag.OVERRUN))
        missing = np.diff(rows["tick"], prepend=self._last_tick) - 1
        is_gap = (rows["flags"] & TickFlag.DROPPED_BEFORE) != 0
        self._dropped += int(missing[is_gap].clip(min=0).sum())
        self._last_tick = int(rows["tick"][-1])

    def _add_silence(self, rows: NDArray[np.void]) -> None:
        """Adds the longest time without a new sample, of (n, hands) records."""
        due, is_stale = rows["deadline_ns"], rows["flags"] & TickFlag.STALE_SAMPLE != 0
        fresh = np.maximum.accumulate(np.where(is_stale, 0, due), axis=0)
        fresh = np.maximum(fresh, self._fresh_ns)
        since = 1e-9 * (due - fresh)
        self._silence = float(since[-1].max())
        self._longest_silence = max(self._longest_silence, float(since.max()))
        self._fresh_ns = fresh[-1]

    def __str__(self) -> str:
        if self._last is None:
            return "waiting for the first tick"
        forces, joules = [], []
        for row, is_held in zip(self._last, self._are_held, strict=True):
            hand, tool = (
                float(np.linalg.norm(row[name][:3]))
                for name in ("wrench_on_device", "wrench_on_tool")
            )
            forces.append(format_forces(hand if is_held else None, tool))
            joules.append(format_energy(float(row["device_energy"])))
        first = self._last[0]
        parts = [
            f"{first['deadline_ns'] * 1e-9:.1f} s",
            " | ".join(forces),
            f"environment {format_energy(float(first['environment_energy']))}",
            f"device {' | '.join(joules)}",
            f"{self._overruns} overruns",
        ]
        lowered = [words for flag, words in LOWERED.items() if self._flags & flag]
        parts += lowered[:1]
        if self._silence >= SILENCE:
            parts.append(f"NO NEW SAMPLE for {self._silence:.1f} s")
        elif self._longest_silence >= SILENCE:
            parts.append(f"once no new sample for {self._longest_silence:.1f} s")
        if self._dropped:
            parts.append(f"{self._dropped} records dropped")
        return "  ".join(parts)


def _are_held(metadata: dict[str, str]) -> tuple[bool, ...]:
    return tuple(
        not json.loads(each.get("device", "{}")).get("is_prescribed", False)
        for each in (metadata, *(metadata | own for own in further_hands(metadata)))
    )


class _Console(Console):
    """Console that raises when the terminal is closed; rich would end the process."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError(errno.EPIPE, "the terminal is gone")


class LiveLine:
    """Status line of a run: redrawn on a terminal, printed as plain lines elsewhere.

    After an error the stream is no longer used, and the recording continues.
    """

    def __init__(self, stream: TextIO, are_held: tuple[bool, ...] = (True,)) -> None:
        self._state = RunState(are_held)
        self._stream: TextIO | None = stream
        self._drawn = time.monotonic()
        self._is_fresh = False
        self._live: Live | None = None
        try:
            if stream.isatty():
                # rich must not redirect standard output, which carries the answers to the bridge
                self._live = Live(
                    self._text(),
                    console=_Console(file=stream),
                    auto_refresh=False,
                    redirect_stdout=False,
                    redirect_stderr=False,
                )
                self._live.start()
        except (OSError, ValueError):
            self._stream = None

    def update(self, rows: NDArray[np.void]) -> None:
        """Adds new records, or none, and draws if it is time."""
        if rows.size:
            self._state.add(rows)
            self._is_fresh = True
        if time.monotonic() - self._drawn >= (REDRAW if self._live else REPRINT):
            self._draw()

    def close(self) -> None:
        """Draws the last state and restores the terminal."""
        self._draw()
        try:
            if self._live is not None:
                self._live.stop()
        except (OSError, ValueError):
            self._stream = None

    def _draw(self) -> None:
        self._drawn = time.monotonic()
        if self._stream is None or not self._is_fresh:
            return
        self._is_fresh = False
        try:
            if self._live is not None:
                self._live.update(self._text(), refresh=True)
            else:
                print(self._state, file=self._stream, flush=True)
        except (OSError, ValueError):
            self._stream = None

    def _text(self) -> Text:
        return Text(str(self._state), no_wrap=True, overflow="ellipsis")


POLL = 0.005
"""Pause in s between reads of the ring: five records at 1 kHz."""

BATCH = 64
"""Largest number of records taken at once; after a full batch the next read follows at once. The
batch bounds the process's memory: with 4096 it grew by a megabyte after a stall of one second. A
smaller batch costs time; at 64 it is 0.3 µs per record."""


class _Session:
    def __init__(self, configuration: dict[str, Any], attachments: list[Attachment]) -> None:
        self.ring = Ring.attach(configuration["ring"])
        self._parent = configuration["parent"]
        self._writer, self._path = None, Path(configuration["path"] or "")
        if configuration["path"] is not None:
            self._writer = RecordingWriter(
                configuration["path"],
                configuration["metadata"],
                attachments,
                configuration["epoch_ns"],
            )
        self._live = None
        if configuration["live"]:
            self._live = LiveLine(sys.stderr, _are_held(configuration["metadata"]))
        self._hands = 1 + len(further_hands(configuration["metadata"]))
        self._batch = BATCH // self._hands * self._hands
        self._last_time = 0
        self._last_tick = -1
        self._has_begun = self._has_reported_full = False
        self._is_posted = float(configuration["metadata"].get("credit", 0.0)) > 0.0
        self._posts, self._waiting = 0, np.zeros(0, TICK_DTYPE)

    def run(self, inbox: SimpleQueue[dict[str, Any] | None]) -> None:
        """Records until the bridge closes or dies."""
        end = None
        while end is None:
            count = self._drain_once()
            self._report_if_full()
            end = self._handle(inbox)
            # a process that the bridge forked may hold the pipe open after the bridge's death
            if end is None and os.getppid() != self._parent:
                time.sleep(0.1)  # lets the rest of the pipe arrive
                end = self._handle(inbox) or "died"
            if end is None and count < self._batch:
                time.sleep(POLL)
        while self._drain_once():
            pass
        if end != "died" and self._writer is not None:
            self._write_ticks(self._waiting)
        if end == "died":
            self.ring.unlink()
            self._write_event({"event": "bridge_died", "tick": self._last_tick}, self._last_time)
        if self._writer is not None:
            self._writer.close()
            if end == "died" and self._last_tick < 0:  # before its first tick
                remove_file(self._path)
        if self._live is not None:
            self._live.close()

    def _drain_once(self) -> int:
        rows = self.ring.take(self._batch)  # the producer adds one record per hand at once
        if self._writer is not None:
            self._write_ticks(self._known(rows))
        if self._live is not None:
            self._live.update(rows)
        return int(rows.size)

    def _known(self, rows: NDArray[np.void]) -> NDArray[np.void]:
        """Returns the records whose events were written, too.

        The event of the start, and what another program has shown, come a little after their ticks.
        Records that are written without them could not be audited if the bridge or machine dies.
        """
        if self._waiting.size:
            rows = np.concatenate([self._waiting, rows])
        count = rows.size if self._has_begun else 0
        if self._is_posted and count:
            count = int(np.searchsorted(rows["scene_step"], self._posts, side="right"))
        self._waiting = rows[count:].copy()
        return rows[:count]

    def _write_ticks(self, rows: NDArray[np.void]) -> None:
        assert self._writer is not None
        if rows.size:
            self._last_time = int(rows["deadline_ns"][-1])
            self._last_tick = int(rows["tick"][-1])
            for hand in range(self._hands):
                self._writer.write_ticks(rows[hand :: self._hands], hand)

    def _report_if_full(self) -> None:
        """Reports a full disk once; the reserve holds the data until the bridge ends.

        Records may arrive before the event of the start, which is the first one of a recording.
        """
        if self._writer is None or not self._has_begun:
            return
        if self._writer.is_full and not self._has_reported_full:
            self._has_reported_full = True
            self._write_event({"event": "disk_full", "tick": self._last_tick}, self._last_time)
            _answer(full=True)

    def _handle(self, inbox: SimpleQueue[dict[str, Any] | None]) -> str | None:
        """Writes the events that arrived; returns how the run ended, or None."""
        while True:
            try:
                event = inbox.get_nowait()
            except Empty:
                return None
            if event is None:
                return "died"
            if "close" in event:
                return "closed"
            self._write_event(event, event["time_ns"])

    def _write_event(self, event: dict[str, Any], time_ns: int) -> None:
        if self._writer is not None:
            self._posts += event.get("count", 0) if event["event"] == SHOWN_EVENT else 0
            self._writer.write_event(event, time_ns)
            self._has_begun = True


def listen(stream: IO[bytes], inbox: SimpleQueue[dict[str, Any] | None]) -> None:
    """Puts the events of a pipe, one line of JSON each, into a queue, and None at its end."""
    for line in stream:
        # a line without its end comes from a bridge that was killed while writing
        if line.endswith(b"\n"):
            inbox.put(json.loads(line))
    inbox.put(None)


def _answer(**answer: object) -> None:
    with contextlib.suppress(OSError):  # the bridge died; the file matters more
        os.write(sys.stdout.fileno(), json.dumps(answer).encode() + b"\n")


def _configuration(stream: IO[bytes]) -> tuple[dict[str, Any], list[Attachment]] | None:
    line = stream.readline()
    if not line.endswith(b"\n"):
        return None
    configuration: dict[str, Any] = json.loads(line)
    attachments = []
    for name, media_type, size in configuration["attachments"]:
        data = stream.read(size)
        if len(data) < size:
            return None
        attachments.append(Attachment(name, media_type, data))
    return configuration, attachments


def _drop_signals_and_priority() -> None:
    """Ignores signals meant for the bridge, and drops the loop's real-time priority."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def main() -> int:
    """Runs the recorder's process; returns its exit status."""
    _drop_signals_and_priority()
    stream = sys.stdin.buffer
    received = _configuration(stream)
    if received is None:
        return 1  # the bridge died before the run began
    configuration, attachments = received
    try:
        session = _Session(configuration, attachments)
        _answer(ready=True)
        inbox: SimpleQueue[dict[str, Any] | None] = SimpleQueue()
        threading.Thread(target=listen, args=(stream, inbox), daemon=True).start()
        session.run(inbox)
    except RecordingError as error:
        _answer(error=str(error))
        if os.getppid() != configuration["parent"]:
            print(f"hapticbridge: {error}", file=sys.stderr)
            Path(configuration["ring"]).unlink(missing_ok=True)
        return 1
    _answer(closed=True)
    return 0


def run() -> NoReturn:
    """Runs the recorder's process and ends it."""
    status = 1
    try:
        status = main()
    except BaseException:
        traceback.print_exc()
    # os._exit: the listening thread may hold the lock of standard input, which a normal exit
    # of the interpreter waits for
    os._exit(status)
