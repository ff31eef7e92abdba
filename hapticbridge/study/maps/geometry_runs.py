"""What the map ``geometry`` runs: pegs of any length, rendered directly and behind the coupling."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hapticbridge.study.maps.bisection import largest_stable
from hapticbridge.study.maps.bound_of_method import limit_by_6
from hapticbridge.study.maps.fitting_peg import (
    DEVICE_DAMPING,
    PERIOD,
    ROTATIONAL_DAMPING,
    contact_stiffness_limit,
    first_growth,
    has_calmed,
    is_stable,
    run,
)
from hapticbridge.study.maps.stability_map import Point

LENGTH = (5e-3, 0.5)
"""Range of L in m, even in its logarithm."""

CONTACT_STIFFNESS = (10.0, 1e6)
"""Range of K_c in N/m, even in its logarithm: its limit at both ends of ``LENGTH`` lies within."""

ROTATIONAL_STIFFNESS = (0.1, 10.0)
"""Range of K_r in N m/rad, even in its logarithm, about the bounds of 3 and 4 N m/rad."""

LIMITS_AMONG = 60
"""One limit is searched for every so many cells; a search takes about a dozen runs."""

BEHIND = ("implicit", "compensated", "lossless")
"""Methods with a coupling, which all get the same B_r asked for."""

METHODS_SHOWN = ("direct", *BEHIND)

BOUNDS = {
    name: float(limit_by_6(name, DEVICE_DAMPING, PERIOD, ROTATIONAL_DAMPING)) for name in BEHIND
}
"""The largest K_r in N m/rad by (6): 2 (b_θ − B_r)/T for ``implicit``; 2 b_θ/T for the others, of
whose B' nothing is left there."""


def points(count: int) -> Sequence[Point]:
    """Returns a grid of length and stiffness for each method, about ``count`` in all, and limits.

    ``stiffness`` is K_c in N/m for ``direct`` and K_r in N m/rad behind the coupling. The limits
    are searched over L at given K_c for ``direct``, and over K_r at given L behind the coupling.
    """
    side = max(2, round((count / len(METHODS_SHOWN)) ** 0.5))
    lengths = np.geomspace(*LENGTH, side)
    ranges = {"direct": CONTACT_STIFFNESS} | dict.fromkeys(BEHIND, ROTATIONAL_STIFFNESS)
    cells: list[Point] = [
        {"what": "cell", "method": name, "length": float(length), "stiffness": float(stiffness)}
        for name in METHODS_SHOWN
        for length in lengths
        for stiffness in np.geomspace(*ranges[name], side)
    ]
    many = max(3, count // (len(METHODS_SHOWN) * LIMITS_AMONG))
    searched = np.geomspace(*LENGTH, many)
    direct: list[Point] = [
        {"what": "limit", "method": "direct", "length": 0.0, "stiffness": float(stiffness)}
        for stiffness in contact_stiffness_limit(searched[::-1])
    ]
    behind: list[Point] = [
        {"what": "limit", "method": name, "length": float(length), "stiffness": 0.0}
        for name in BEHIND
        for length in searched
    ]
    return cells + direct + behind


def evaluate(point: Point) -> Mapping[str, float | int | str | bool]:
    """Runs one peg behind its worst hand, or searches for the limit that the point leaves open."""
    name, length, stiffness = (
        str(point["method"]),
        float(point["length"]),
        float(point["stiffness"]),
    )
    if point["what"] == "limit":
        if name == "direct":
            found = largest_stable(
                lambda value: is_stable(name, value, stiffness), LENGTH[0] / 4, 4 * LENGTH[1]
            )
        else:
            lower, upper = ROTATIONAL_STIFFNESS
            found = largest_stable(
                lambda value: is_stable(name, length, value), lower / 4, 4 * upper
            )
        return {"limit": found.middle}
    outcome = run(name, length, stiffness)
    return {
        "stable": has_calmed(outcome, name, length, stiffness),
        "environment": outcome.environment,
        "created": outcome.created,
        "first_active": outcome.first_active,
        "first_growth": first_growth(outcome, name, length, stiffness),
    }
