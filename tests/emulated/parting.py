"""Differences between runs that should be equal to the bit, so that a failure explains itself."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import hapticbridge as hb
from emulated.guest import GuestRun
from hapticbridge.kernel.record import COLUMNS, Column

MAX_NAMED = 8
"""Number of columns named, of the first record that differs; the rest is counted.
More than a few differ in each record after it."""


CLOCK_TOLERANCE = 1000
"""Largest difference in ns of two times of the clock that counts as none. A reading of the clock
takes 256 ns of virtual time, and a loaded machine makes a run read it once more or less."""


def repeated(run: Callable[[int], tuple[GuestRun, Path]], count: int) -> tuple[bool, str]:
    """Runs something some times over, and tells whether all recordings are one to the bit.

    Args:
        run: Runs it for the time of this number, from 1; returns how that ended, and its recording.
        count: How many times, at least once.

    Returns:
        Whether they are, and what they all are; else which run failed or differed, in what, and all
        that it and the first one printed.
    """
    first: tuple[GuestRun, NDArray[np.void]] | None = None
    for number in range(1, count + 1):
        ended, file = run(number)
        if ended.status != 0:
            return False, f"run {number} of {count} {ended}"
        ticks = hb.read_recording(file).ticks
        first = first or (ended, ticks)
        if (where := parting(first[1], ticks)) is not None:
            return False, f"runs 1 and {number}: {where}\nrun 1 {first[0]}\nrun {number} {ended}"
    digest = sha256(ticks.tobytes()).hexdigest()[:16]
    return True, f"{len(ticks)} ticks, {digest}"


def parting(first: NDArray[np.void], second: NDArray[np.void]) -> str | None:
    """Says where two runs part: every bit is compared, times of the clock to ``CLOCK_TOLERANCE``.

    ``hapticbridge compare`` leaves those times out, because no two real runs agree in them. In
    virtual time they must, and they are the first to show what else took time.

    Args:
        first: Records, ``TICK_DTYPE``.
        second: Likewise.

    Returns:
        The first record that differs, each of its numbers that do, with both values, and how much
        differs in all; None where nothing does.
    """
    lengths = f"{len(first)} and {len(second)} records"
    common = min(len(first), len(second))
    unequal = np.stack([_unequal(first[:common], second[:common], one) for one in COLUMNS], axis=1)
    if not unequal.any():
        if len(first) == len(second):
            return None
        return f"{lengths}; the {common} that both have are the same to the bit"
    rows, columns = unequal.any(axis=1), unequal.any(axis=0)
    row = int(np.argmax(rows))
    here = [column for column, is_other in zip(COLUMNS, unequal[row], strict=True) if is_other]
    named = [
        _named(first[row : row + 1], second[row : row + 1], column) for column in here[:MAX_NAMED]
    ]
    if len(here) > MAX_NAMED:
        named.append(f"{len(here) - MAX_NAMED} other numbers")
    ticks = f"{first['tick'][row]} and {second['tick'][row]}"
    return (
        f"record {row} (ticks {ticks}) is the first that differs: {'; '.join(named)}. "
        f"{np.count_nonzero(rows)} of {common} records and {np.count_nonzero(columns)} of "
        f"{len(COLUMNS)} columns differ; {lengths}"
    )


def _numbers(records: NDArray[np.void], column: Column) -> NDArray[np.int64 | np.float64]:
    field = records[column.field]
    return np.ascontiguousarray(field if column.part is None else field[..., column.part])


def _unequal(first: NDArray[np.void], second: NDArray[np.void], one: Column) -> NDArray[np.bool_]:
    """Compares bits, so the two zeros differ, and a NaN is like itself; times nearly."""
    a, b = (_numbers(records, one).view(np.int64) for records in (first, second))
    return np.abs(a - b) > CLOCK_TOLERANCE if one.unit == "ns" else np.asarray(a != b)


def _named(first: NDArray[np.void], second: NDArray[np.void], column: Column) -> str:
    a, b = (_numbers(records, column).item() for records in (first, second))
    unit = "" if column.unit == "1" else f" {column.unit}"
    return f"{column.name} {a!r} and {b!r}{unit}"
