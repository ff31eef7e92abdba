"""Position resolution, found from positions."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_STEPS = 2_000_000
"""Largest number of steps in the travel. A smaller step counts as rounding of a double or a
float."""


def step_of(position: Array) -> float:
    """Returns the step of a reported position in its unit, 0 if it has none.

    All differences between positions must be multiples of the step. The smallest difference is
    refined by all of them: Δ = Σ n d / Σ n² over the differences d = n Δ.

    Args:
        position: Position in m, NaN without a sample.
    """
    values = np.unique(position[np.isfinite(position)])
    if len(values) < 3:
        return 0.0
    gaps = np.diff(values)
    span = float(values[-1] - values[0])
    gaps = gaps[gaps > span / MOST_STEPS]  # smaller gaps are equal positions rounded differently
    if not gaps.size:
        return 0.0
    step = float(gaps.min())
    counts = np.rint(gaps / step)
    if np.abs(gaps / step - counts).max() > 0.02 or len(gaps) < 3:
        return 0.0
    step = float(counts @ gaps / (counts @ counts))
    total = round(span / step)
    return span / total if math.isclose(span / total, step, rel_tol=1e-3) else 0.0
