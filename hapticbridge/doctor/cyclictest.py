"""``cyclictest`` as a baseline: what a program in C reaches on this machine.

It comes with the real-time tests of the kernel's developers (Debian: ``apt install rt-tests``).
"""

from __future__ import annotations

import re
import shutil
import subprocess

import numpy as np
from numpy.typing import NDArray

from hapticbridge.realtime.remedies import PRIORITY

INSTALL = "sudo apt install rt-tests"
_LONGEST_US = 50_000
"""Width of the histogram in µs; later wake-ups are counted at the maximum."""

_BAR = re.compile(r"^(\d{6,}) (\d+)", re.MULTILINE)
_MAXIMUM = re.compile(r"^# Max Latencies: (\d+)", re.MULTILINE)
_OVERFLOWS = re.compile(r"^# Histogram Overflows: (\d+)", re.MULTILINE)


def is_there() -> bool:
    """Tells whether the program is installed."""
    return shutil.which("cyclictest") is not None


def run(period_ns: int, ticks: int) -> NDArray[np.int64] | None:
    """Runs one thread at the loop's priority; returns how late each tick woke in ns.

    Args:
        period_ns: In ns; the program takes whole µs.
        ticks: How many wake-ups.

    Returns:
        None where it failed, as it does without the permission for real time.
    """
    period_us = max(round(period_ns * 1e-3), 1)
    command = ["cyclictest", "--quiet", "--mlockall", f"--priority={PRIORITY}"]
    command += [f"--interval={period_us}", f"--loops={ticks}", f"--histogram={_LONGEST_US}"]
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=10.0 + 5e-9 * period_ns * ticks,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return parsed(done.stdout) if done.returncode == 0 else None


def parsed(text: str) -> NDArray[np.int64] | None:
    """Reads the histogram that ``cyclictest --histogram`` prints; None where there is none."""
    bars = [(int(late), int(count)) for late, count in _BAR.findall(text)]
    late = [np.full(count, 1000 * us, dtype=np.int64) for us, count in bars]
    maximum, overflows = _MAXIMUM.search(text), _OVERFLOWS.search(text)
    if maximum and overflows:
        late.append(np.full(int(overflows[1]), 1000 * int(maximum[1]), dtype=np.int64))
    joined = np.concatenate(late) if late else np.zeros(0, dtype=np.int64)
    return joined if joined.size else None
