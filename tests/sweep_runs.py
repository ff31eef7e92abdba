"""Points, and sweeps of them, that tests of sweeps share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import sweep_functions as functions

from hapticbridge.sweep import Table, grid, sweep

POINTS = grid(stiffness=[1000, 3000.0, 1e4 / 3], damping=np.linspace(0.1, 0.3, 3), tool="peg")


def computed(scratch: Path) -> Counter[int]:
    return Counter(map(int, (scratch / "computed").read_text().split()))


def serial(function: Callable[[Any], Any] = functions.bound, points: Any = POINTS) -> Table:
    return sweep(function, points, jobs=1)


def kept(path: Path) -> list[str]:
    """Returns the lines of a file of results below the first."""
    return path.read_text().splitlines()[1:]


def is_same(first: Table, second: Table) -> bool:
    """Tells whether two tables have the same columns, types and bits."""
    return list(first.columns) == list(second.columns) and all(
        column.dtype == other.dtype
        and (column.tolist() if column.dtype == object else column.tobytes())
        == (other.tolist() if other.dtype == object else other.tobytes())
        for column, other in zip(first.columns.values(), second.columns.values(), strict=True)
    )
