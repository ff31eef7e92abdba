"""Time stolen by the host of a virtual machine."""

from __future__ import annotations

import os
from pathlib import Path

_STOLEN = 8
"""Column of the line ``cpu`` in ``/proc/stat``; column 0 is the line's name."""


def stolen_time(proc: Path = Path("/proc")) -> float | None:
    """Returns the time in s that the host took from all cores since the start.

    The resolution is one clock tick, usually 10 ms. Returns None if the kernel does not report it.
    """
    try:
        columns = (proc / "stat").read_text(encoding="utf-8").split("\n", 1)[0].split()
        return int(columns[_STOLEN]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError, AttributeError):
        return None
