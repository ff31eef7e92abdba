"""Waits of tests for what another process or thread does, with a limit."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

PATIENCE = 60.0
"""Time in s in which it must come, on a busy machine too."""


def until(condition: Callable[[], object], pause: float = 0.01) -> None:
    """Waits until a condition holds, and looks for it after each pause in s."""
    limit = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < limit, "it never came"
        time.sleep(pause)


def is_alive(pid: int) -> bool:
    """Returns whether a process runs: one that has ended and is not waited for does not."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return status.rsplit(")")[-1].split()[0] != "Z"


def has_ended(child: int) -> bool:
    """Returns whether a child process of this one has ended, and takes its status if so."""
    return os.waitpid(child, os.WNOHANG) != (0, 0)
