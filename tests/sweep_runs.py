"""Points, executors and folders that tests of sweeps share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import sweep_functions as functions

from hapticbridge.sweep.points import grid
from hapticbridge.sweep.results import Table
from hapticbridge.sweep.sweep import InThisProcess, sweep

POINTS = grid(stiffness=[1000, 3000.0, 1e4 / 3], damping=np.linspace(0.1, 0.3, 3), tool="peg")


def computed(scratch: Path) -> Counter[int]:
    return Counter(map(int, (scratch / "computed").read_text().split()))


def serial(function: Callable[[Any], Any] = functions.bound, points: Any = POINTS) -> Table:
    return sweep(function, points, executor=InThisProcess())


def parts(folder: Path) -> list[Path]:
    return sorted(folder.glob("part-*"))
