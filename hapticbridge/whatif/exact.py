"""Going back from a number that a run was computed with to the one that was asked for."""

from __future__ import annotations

import math
from collections.abc import Callable

NEIGHBOURS = 8
"""Doubles on either side of a guess that are tried. A product and a sum are off by two at most;
more would cost time alone."""


def that_gives(wanted: float, function: Callable[[float], float], guess: float) -> float:
    """Returns the double at or beside a guess for which a function gives exactly what is wanted.

    A recording keeps T and B', not the rate and the B that were asked for; 1/T and B' + K T/2, put
    in again, may end one digit in the last place beside T and B', and nothing is then repeated to
    the bit.

    Args:
        wanted: What the function must give.
        function: From what was asked for to what was computed with.
        guess: Its inverse, to rounding.

    Returns:
        The guess itself where no neighbour does better.
    """
    up = down = guess
    for _ in range(NEIGHBOURS + 1):
        for candidate in (up, down):
            if function(candidate) == wanted:
                return candidate
        up, down = math.nextafter(up, math.inf), math.nextafter(down, -math.inf)
    return guess
