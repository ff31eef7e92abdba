"""Baseline of a C program, ``cyclictest``."""

from __future__ import annotations

import re
import shutil
import subprocess

import numpy as np
from numpy.typing import NDArray

from hapticbridge.realtime import Lateness, lateness_of

INSTALL = "sudo apt install rt-tests"
_LONGEST_US = 50_000
"""Width of the histogram in µs; later wake-ups count as the maximum."""

_TRIAL_NS = 1_000_000
"""Period in ns of the single wake-up that tests if the program runs."""

_PATIENCE = 5.0
"""Time in s, beyond twice the expected duration, after which a run is aborted."""

_BAR = re.compile(r"^(\d{6,}) (\d+)", re.MULTILINE)
_MAXIMUM = re.compile(r"^# Max Latencies: (\d+)", re.MULTILINE)
_OVERFLOWS = re.compile(r"^# Histogram Overflows: (\d+)", re.MULTILINE)


def lateness(period_ns: int, late_ns: NDArray[np.int64]) -> Lateness:
    """Returns the statistics of a run; each whole period of lateness is a skipped deadline."""
    return lateness_of(late_ns, int((late_ns // period_ns).sum()))


def is_there() -> bool:
    """Returns True if the program is installed."""
    return shutil.which("cyclictest") is not None


def refusal(priority: int, *, locks_memory: bool) -> str:
    """Returns the reason why the program cannot run here; empty if it can.

    It is part of the kernel developers' real-time tests (Debian: ``apt install rt-tests``).
    ``priority`` is 0 if SCHED_FIFO was refused.
    """
    if not is_there():
        return "it is not installed"
    if priority <= 0:
        return "it needs SCHED_FIFO, which was refused"
    answer = run(_TRIAL_NS, 1, priority, locks_memory=locks_memory)
    return answer if isinstance(answer, str) else ""


def run(
    period_ns: int,
    ticks: int,
    priority: int,
    *,
    locks_memory: bool,
    core: int | None = None,
) -> NDArray[np.int64] | str:
    """Runs one thread at the loop's priority; returns the lateness of each tick in ns.

    The program takes whole µs and skips missed deadlines. Without ``core`` the thread may move.

    Returns:
        The lateness, or the reason of a failure in words.
    """
    period_us = max(round(period_ns * 1e-3), 1)
    command = ["cyclictest", "--quiet", f"--priority={priority}", f"--interval={period_us}"]
    command += [f"--loops={ticks}", f"--histogram={_LONGEST_US}"]
    command += ["--mlockall"] if locks_memory else []
    command += [] if core is None else [f"--affinity={core}"]
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=_PATIENCE + 2e-9 * period_ns * ticks,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"it did not finish at {1e9 / period_ns:g} Hz"
    except OSError as error:
        return f"it cannot be started ({error.strerror})"
    late = parsed(done.stdout) if done.returncode == 0 else None
    if late is None:
        output = (done.stderr or done.stdout).strip().splitlines() or [f"status {done.returncode}"]
        return f"it failed: {output[-1].strip()}"
    return late


def parsed(text: str) -> NDArray[np.int64] | None:
    """Parses the histogram of ``cyclictest --histogram``; returns None if there is none."""
    bars = [(int(late), int(count)) for late, count in _BAR.findall(text)]
    late = [np.full(count, 1000 * us, dtype=np.int64) for us, count in bars]
    maximum, overflows = _MAXIMUM.search(text), _OVERFLOWS.search(text)
    if maximum and overflows:
        late.append(np.full(int(overflows[1]), 1000 * int(maximum[1]), dtype=np.int64))
    joined = np.concatenate(late) if late else np.zeros(0, dtype=np.int64)
    return joined if joined.size else None
