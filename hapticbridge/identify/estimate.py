"""Least squares with jackknife intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

Array = NDArray[np.float64]

CONFIDENCE = 0.95
"""Probability, without unit, that the true value lies within the interval."""

BLOCKS = 12
"""Number of parts of the run, left out in turn to measure the scatter of the result. With more, a
part would be shorter than the slowest swing and no longer independent."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its interval of ``CONFIDENCE``.

    Attributes:
        value: Estimate in SI units.
        half_width: Largest excess of the true value over ``value``, in the unit of ``value``.
        below: Additional lower width of the interval, >= 0. It covers effects too small to be
            detected that would make the true value smaller.
    """

    value: float
    half_width: float
    below: float = 0.0

    @property
    def least(self) -> float:
        """Lower end of the interval."""
        return self.value - self.half_width - self.below

    @property
    def most(self) -> float:
        """Upper end of the interval."""
        return self.value + self.half_width

    @property
    def is_seen(self) -> bool:
        """Significance: true if the interval excludes zero."""
        return self.least > 0.0 or self.most < 0.0

    def told(self) -> str:
        """Returns the value and its interval as text, rounded to the significant digits."""
        value = self.value
        if self.half_width > 0.0:
            value = round(value, -math.floor(math.log10(self.half_width))) + 0.0  # no −0
        up, down = f"{self.half_width:.1g}", f"{self.half_width + self.below:.1g}"
        return f"{value:.4g} ± {up}" if up == down else f"{value:.4g} +{up} −{down}"


def solved(columns: Array, right: Array) -> Array:
    """Returns the least-squares solution x, shape (k,), of columns · x = right."""
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    return np.asarray(np.linalg.lstsq(columns / scale, right, rcond=None)[0] / scale)


def half_widths(columns: Array, right: Array) -> Array:
    """Returns the half-widths of the least-squares solution by a jackknife over ``BLOCKS`` parts.

    The rows, at least ``BLOCKS``, are in the order of time. The only assumption is that distant
    rows have independent errors.

    References:
        Efron & Stein 1981, *The jackknife estimate of variance*.
    """
    block = np.arange(len(right)) * BLOCKS // len(right)
    without = np.array([solved(columns[block != j], right[block != j]) for j in range(BLOCKS)])
    spread = np.sum((without - without.mean(axis=0)) ** 2, axis=0) * (BLOCKS - 1) / BLOCKS
    return np.asarray(np.sqrt(spread) * student.ppf(0.5 + 0.5 * CONFIDENCE, BLOCKS - 1))
