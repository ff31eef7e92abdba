"""Differences between runs that should be equal to the bit, so that a failure explains itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

import hapticbridge as hb
from emulated.guest import GuestRun
from hapticbridge.kernel.record import CLOCK_FIELDS
from hapticbridge.tools.compare import compare

CLOCK_TOLERANCE = 1000
"""Largest difference in ns of two times of the clock that counts as none. A reading of the clock
takes 256 ns of virtual time, and a loaded machine makes a run read it once more or less."""


def repeated(run: Callable[[int], tuple[GuestRun, Path]], count: int) -> tuple[bool, str]:
    """Runs something some times over, and tells whether all recordings are one to the bit.

    Args:
        run: Runs it for the time of this number, from 1; returns how that ended, and its recording.
        count: How many times, at least once.

    Returns:
        Whether they are, and their length; else which run failed or differed, in what, and all
        that it and the first one printed.
    """
    first: tuple[GuestRun, Path] | None = None
    for number in range(1, count + 1):
        ended, file = run(number)
        if ended.status != 0:
            return False, f"run {number} of {count} {ended}"
        first = first or (ended, file)
        if where := parting(first[1], file):
            return False, f"runs 1 and {number}: {where}\nrun 1 {first[0]}\nrun {number} {ended}"
    return True, f"{len(hb.read_recording(file).ticks)} ticks"


def parting(first: Path, second: Path) -> str:
    """Says where two recordings part, in any bit or by ``CLOCK_TOLERANCE``; empty if nowhere.

    ``hapticbridge compare`` leaves times of the clock out, because no two real runs agree in them.
    In virtual time they must, and they are the first to show what else took time.
    """
    found = compare(first, second)
    if not found.is_same:
        return f"the first difference is {found.first}, records without a partner {found.alone}"
    a, b = (hb.read_recording(path).ticks for path in (first, second))
    apart = np.stack([np.abs(a[name] - b[name]) for name in CLOCK_FIELDS], axis=1)
    tick, field = np.unravel_index(int(np.argmax(apart > CLOCK_TOLERANCE)), apart.shape)
    if apart[tick, field] <= CLOCK_TOLERANCE:
        return ""
    return f"{CLOCK_FIELDS[field]} of tick {tick} differs by {apart[tick, field]} ns"
