"""The step of a reported position, found from the positions alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_STEPS = 2_000_000
"""Step of resolution below travel/MOST_STEPS is none: rounding of a double, or of a float."""


def step_of(position: Array) -> float:
    """Returns the step of a reported position, 0 where it has none.

    All differences between positions that occur must be multiples of it. It is found as the
    smallest difference, and made exact by all of them: Σ n d / Σ n² over the differences d = n Δ.

    Args:
        position: In m, NaN where there is none.
    """
    values = np.unique(position[np.isfinite(position)])
    if len(values) < 3:
        return 0.0
    gaps = np.diff(values)
    span = float(values[-1] - values[0])
    gaps = gaps[gaps > span / MOST_STEPS]  # equal numbers, reached by different roundings
    if not gaps.size:
        return 0.0
    step = float(gaps.min())
    counts = np.rint(gaps / step)
    if np.abs(gaps / step - counts).max() > 0.02 or len(gaps) < 3:
        return 0.0
    step = float(counts @ gaps / (counts @ counts))
    total = round(span / step)
    return span / total if math.isclose(span / total, step, rel_tol=1e-3) else 0.0
