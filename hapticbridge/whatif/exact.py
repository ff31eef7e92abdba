"""Exact inversion of a floating-point function."""

from __future__ import annotations

import math
from collections.abc import Callable

NEIGHBOURS = 8
"""Number of doubles tried on either side of a guess. A product and a sum are off by two at most;
more would only cost time."""


def that_gives(wanted: float, function: Callable[[float], float], guess: float) -> float:
    """Returns the input near a guess whose computed value equals the wanted one bit for bit.

    A recording holds T and B', not the requested rate and B. Recomputed from 1/T and B' + K T/2, T
    and B' may differ in the last digit, and the repetition would no longer be exact.

    Returns:
        The input, or the guess if no neighbour gives the value.
    """
    up = down = guess
    for _ in range(NEIGHBOURS + 1):
        for candidate in (up, down):
            if function(candidate) == wanted:
                return candidate
        up, down = math.nextafter(up, math.inf), math.nextafter(down, -math.inf)
    return guess
