"""Live status line of a run."""

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
"""Time in s between two drawings on a terminal."""

REPRINT = 2.0
"""Time in s between two plain lines."""


class RunState:
    """State of a run for the status line, collected from records."""

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
    """Console that raises when the terminal is closed; rich would end the process."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError(errno.EPIPE, "the terminal is gone")


class LiveLine:
    """Status line of a run: redrawn on a terminal, printed as plain lines elsewhere.

    After an error the stream is no longer used, and the recording continues.
    """

    def __init__(self, stream: TextIO) -> None:
        self._state = RunState()
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


def _millijoule(energy: float) -> str:
    return f"{energy * 1e3:.1f} mJ"
