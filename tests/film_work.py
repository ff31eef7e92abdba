"""Work of the process that draws, in place of its own; that process imports this module."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from hapticbridge.confinement import Worker


def nothing(*_: object) -> None:
    """Loads nothing."""


def babble(_path: Path, out: Path, _shot: object, worker: Worker) -> str:
    """Tells what is no progress, as a process may that a scene took over; then draws."""
    worker.tell("a")
    for news in ([1], ["x", 2], [{}, 1], [3, 4]):
        worker.tell(news)
    print("a driver prints")
    out.write_bytes(b"drawn")
    return ""


def crash(*_: object) -> None:
    """Ends the process as a driver may."""
    os.kill(os.getpid(), signal.SIGSEGV)


def sleep(*_: object) -> None:
    """Draws for a minute."""
    time.sleep(60)
