"""Process of the device's loop on the program's own machine."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import IO, Any, cast

from hapticbridge.errors import HapticBridgeError

TOKEN_VARIABLE = "HAPTICBRIDGE_TOKEN"
"""Environment variable with the token of a loop."""

PROGRAM_VARIABLE = "HAPTICBRIDGE_PROGRAM"
"""Environment variable with the number of the process that a loop serves, and ends with."""

READY_TIME, CLOSE_TIME = 300.0, 60.0
"""Longest waits in s: for a loop that starts (the first start compiles), and for one that ends and
closes its recording."""

ADVICE = "python= or HAPTICBRIDGE_PYTHON names a Python with all that hapticbridge depends on"
"""Advice for an interpreter that cannot run the loop."""

KEPT_LINES = 20
"""Lines of its standard error that are kept, to say why it ended."""

_HEADS = ("error:", "safety trip:")
"""Beginnings of the lines that say why it ended; the program gets them as an exception."""


class LoopProcess:
    """Process of ``hapticbridge serve``.

    Args:
        command: Its command line.
        token: Token of its datagrams.
    """

    def __init__(self, command: Sequence[str], token: str) -> None:
        self._command, self._token = list(command), token
        self._process: subprocess.Popen[str] | None = None
        self._lines: list[str] = []

    def start(self) -> tuple[str, int]:
        """Starts it, and returns its address once the loop runs.

        Raises:
            HapticBridgeError: It cannot start; the message is its own.
        """
        try:
            self._process = process = subprocess.Popen(
                self._command,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env={
                    **os.environ,
                    TOKEN_VARIABLE: self._token,
                    PROGRAM_VARIABLE: str(os.getpid()),
                },
                start_new_session=True,  # Ctrl-C is the program's; it ends the loop in order
            )
        except OSError as error:
            raise HapticBridgeError(
                f"the device loop cannot start: {self._command[0]}: {error.strerror}"
            ) from None
        self._reader = threading.Thread(
            target=self._read, args=(cast(IO[str], process.stderr),), daemon=True
        )
        self._reader.start()
        timer = threading.Timer(READY_TIME, process.kill)
        timer.start()
        try:
            told = json.loads(cast(IO[str], process.stdout).readline())
            return str(told["host"]), int(told["port"])
        except (ValueError, KeyError, TypeError):
            self.end()
            is_its_own = any(line.startswith(_HEADS) for line in self._lines)
            advice = "" if is_its_own else f" ({self._command[0]}; {ADVICE})"
            raise HapticBridgeError(
                f"the device loop cannot start: {self.last_error}{advice}"
            ) from None
        except BaseException:  # as Ctrl-C while it compiles
            self.end()
            raise
        finally:
            timer.cancel()

    @property
    def pid(self) -> int | None:
        """Number of the process; None before it was started."""
        return None if self._process is None else self._process.pid

    @property
    def is_running(self) -> bool:
        """True until the process has ended."""
        return self._process is not None and self._process.poll() is None

    @property
    def last_error(self) -> str:
        """Reason for which it ended, as far as it said one."""
        told = [line for line in self._lines if line.startswith(_HEADS)]
        last = (told or self._lines or ["it said nothing"])[-1]
        return last.partition(": ")[2] if last.startswith(_HEADS) else last

    def end(self, patience: float = 0.0) -> dict[str, Any]:
        """Ends it in order, and returns its summary; empty if it gave none.

        ``patience`` is the time in s that it has to end by itself.
        """
        process = self._process
        if process is None:
            return {}
        for end, wait in (
            (None, patience),
            (signal.SIGINT, CLOSE_TIME),
            (signal.SIGKILL, CLOSE_TIME),
        ):
            with suppress(OSError, subprocess.TimeoutExpired):
                if end is not None:
                    process.send_signal(end)
                process.wait(wait)
                break
        self._reader.join(CLOSE_TIME)
        with cast(IO[str], process.stdout) as told:
            text = told.read()
        with suppress(ValueError):
            return dict(json.loads(text))
        return {}

    def _read(self, stream: IO[str]) -> None:
        """Keeps what it says, and passes on what is no error."""
        with stream:
            for line in stream:
                self._lines.append(line.strip())
                del self._lines[:-KEPT_LINES]
                if not line.startswith(_HEADS):
                    print(line.rstrip(), file=sys.stderr)
