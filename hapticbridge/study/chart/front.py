"""Which points are worth their cost: the Pareto front."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def pareto_front(costs: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Returns the indices of the points that no other point beats, cheapest first.

    A point is beaten by one that costs no more and errs no more, and less in one of the two. Of
    equal points the first stays. Points with a cost or an error that is not finite are never on
    the front.

    Args:
        costs: One per point.
        errors: One per point.
    """
    points = np.stack([np.asarray(costs, float), np.asarray(errors, float)], axis=-1)
    order = [i for i in np.lexsort(points.T[::-1]) if np.isfinite(points[i]).all()]
    front: list[int] = []
    least = np.inf
    for index in order:
        if points[index, 1] < least:
            least = points[index, 1]
            front.append(int(index))
    return front
