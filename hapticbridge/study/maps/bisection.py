"""One search for all maps: the largest value at which something is still stable."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hapticbridge.errors import StudyError

WIDTH = 1e-3
"""Relative width of a bracket, without unit, at which maps end a search: a tenth of a per cent. An
agreement is never quoted below half of it. Halving it costs one run more."""


@dataclass(frozen=True, slots=True)
class Bracket:
    """Between what a search ended.

    Attributes:
        lower: Largest value that was seen stable; 0 if the lower end of the search was not.
        upper: Smallest value above it that was not; inf if the upper end of the search was stable.
    """

    lower: float
    upper: float

    @property
    def middle(self) -> float:
        """The geometric middle: at most half the relative width away from the limit."""
        if self.lower == 0 or math.isinf(self.upper):
            return self.lower if self.lower == 0 else self.upper
        return math.sqrt(self.lower * self.upper)


def largest_stable(
    is_stable: Callable[[float], bool], lower: float, upper: float, width: float = WIDTH
) -> Bracket:
    """Searches by bisection, even in the logarithm, for where stability ends.

    Args:
        is_stable: Whether a value is stable; stable below one limit and not above it. Where it
            changes more than once, one of the changes is found.
        lower: Where the search begins, > 0.
        upper: Where it ends, > lower. Ends that have nothing to do with a prediction make the
            search independent of it.
        width: Relative width at which it ends, > 0.

    Returns:
        The bracket; ``Bracket(0, lower)`` if nothing was stable and ``Bracket(upper, inf)`` if all
        was.

    Raises:
        StudyError: An end or the width is out of range.
    """
    if not (0 < lower < upper < math.inf and 0 < width < math.inf):
        raise StudyError(
            f"a search from {lower!r} to {upper!r} with the width {width!r} is none; it needs "
            "0 < lower < upper and a width > 0"
        )
    if not is_stable(lower):
        return Bracket(0.0, lower)
    if is_stable(upper):
        return Bracket(upper, math.inf)
    while upper > lower * (1 + width):
        middle = math.sqrt(lower * upper)
        lower, upper = (middle, upper) if is_stable(middle) else (lower, middle)
    return Bracket(lower, upper)


def agreement(measured: ArrayLike, predicted: ArrayLike, width: float = WIDTH) -> float | None:
    """Returns the largest relative deviation that a search of that width can tell.

    That is max(deviation, width/2), without unit; None where nothing can be compared.

    Args:
        measured: Middles of brackets, any shape.
        predicted: Broadcasts with them.
        width: Relative width of the brackets.
    """
    ratio = np.asarray(measured, dtype=np.float64) / np.asarray(predicted, dtype=np.float64)
    known = np.abs(ratio[np.isfinite(ratio)] - 1)
    return max(float(known.max()), width / 2) if known.size else None


def per_cent(share: float | None) -> str:
    """Returns an agreement in words, to three digits at most."""
    return "nowhere comparable" if share is None else f"within {100 * share:.2g} %"
