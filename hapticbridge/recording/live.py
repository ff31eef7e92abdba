"""The live line of a run: one line that is redrawn on a terminal, plain lines elsewhere."""

from __future__ import annotations

import errno
import time
from typing import TextIO

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.live import Live
from rich.text import Text

from hapticbridge.tick import TickFlag

REDRAW = 0.125
"""Pause in s between two drawings on a terminal."""

REPRINT = 2.0
"""Pause in s between two plain lines."""


class RunState:
    """What the live line tells, gathered from the records."""

    def __init__(self) -> None:
        self._last: NDArray[np.void] | None = None
        self._overruns = 0
        self._dropped = 0

    def add(self, rows: NDArray[np.void]) -> None:
        """Adds new records, shape (n,), n >= 1, ``TICK_DTYPE``."""
        self._overruns += int(np.count_nonzero(rows["flags"] & TickFlag.OVERRUN))
        before = -1 if self._last is None else int(self._last["tick"])
        missing = np.diff(rows["tick"], prepend=before) - 1
        is_gap = (rows["flags"] & TickFlag.DROPPED_BEFORE) != 0
        self._dropped += int(missing[is_gap].clip(min=0).sum())
        self._last = rows[-1].copy()

    def __str__(self) -> str:
        if self._last is None:
            return "waiting for the first tick"
        row = self._last
        parts = [
            f"{row['deadline_ns'] * 1e-9:.1f} s",
            f"{np.linalg.norm(row['wrench_on_tool'][:3]):.1f} N",
            f"environment {_millijoule(float(row['environment_energy']))}",
            f"device {_millijoule(float(row['device_energy']))}",
            f"{self._overruns} overruns",
        ]
        if self._dropped:
            parts.append(f"{self._dropped} records dropped")
        return "  ".join(parts)


class _Console(Console):
    """A console that reports a closed terminal instead of ending the process, as rich would."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError(errno.EPIPE, "the terminal is gone")


class LiveLine:
    """Shows the state of a run; a stream that fails is left alone, the recording goes on.

    Args:
        stream: Where to; whether it is a terminal decides the way.
    """

    def __init__(self, stream: TextIO) -> None:
        self._state = RunState()
        self._stream: TextIO | None = stream
        self._drawn = time.monotonic()
        self._is_fresh = False
        self._live: Live | None = None
        try:
            if stream.isatty():
                # standard output carries the answers to the bridge: rich must not redirect it
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
        """Takes new records, also none, and draws when it is time to."""
        if rows.size:
            self._state.add(rows)
            self._is_fresh = True
        if time.monotonic() - self._drawn >= (REDRAW if self._live else REPRINT):
            self._draw()

    def close(self) -> None:
        """Draws the last state and leaves the terminal as it was."""
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


def _millijoule(energy: float) -> str:
    return f"{energy * 1e3:.1f} mJ"
