"""The host of a virtual machine, which stops it without a word."""

from __future__ import annotations

import os
from pathlib import Path

_STOLEN = 8
"""Column of the line ``cpu`` in ``/proc/stat``, the line's name being column 0."""


def stolen_time(proc: Path = Path("/proc")) -> float | None:
    """Returns the time in s that the host took from all cores together since the start.

    Args:
        proc: Root of procfs.

    Returns:
        In steps of a clock tick, 10 ms as a rule; None where the kernel does not tell.
    """
    try:
        columns = (proc / "stat").read_text(encoding="utf-8").split("\n", 1)[0].split()
        return int(columns[_STOLEN]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError, AttributeError):
        return None
