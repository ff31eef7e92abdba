"""Map ``geometry``: how long a peg may be, rendered directly and through the coupling."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hapticbridge.passivity import maximum_stiffness
from hapticbridge.picture import new_figure
from hapticbridge.study.maps.bisection import agreement, largest_stable, per_cent
from hapticbridge.study.maps.fitting_peg import (
    DEVICE_DAMPING,
    PERIOD,
    ROTATIONAL_DAMPING,
    contact_stiffness_limit,
    first_growth,
    has_calmed,
    is_stable,
    length_limit,
    run,
)
from hapticbridge.study.maps.palette import THEORY_COLOUR
from hapticbridge.study.maps.stability_map import Finding, Point, StabilityMap, computed
from hapticbridge.study.maps.verdicts import (
    MISSING,
    draw_verdicts,
    verdict_legend,
    verdict_numbers,
)
from hapticbridge.study.table import Table

LENGTH = (5e-3, 0.5)
"""Range of L in m, even in its logarithm."""

CONTACT_STIFFNESS = (10.0, 1e6)
"""Range of K_c in N/m, even in its logarithm: its limit at both ends of ``LENGTH`` lies within."""

ROTATIONAL_STIFFNESS = (0.1, 10.0)
"""Range of K_r in N m/rad, even in its logarithm, about the bound of 3 N m/rad."""

LIMITS_AMONG = 60
"""One limit is searched for every so many cells; a search takes about a dozen runs."""

METHODS_SHOWN = ("direct", "implicit")

BOUND = float(maximum_stiffness(DEVICE_DAMPING, PERIOD, ROTATIONAL_DAMPING))
"""The largest K_r in N m/rad by (6): 2 (b_θ − B_r)/T."""


def points(count: int) -> Sequence[Point]:
    """Returns a grid of length and stiffness for both methods, about ``count`` in all, and limits.

    ``stiffness`` is K_c in N/m for ``direct`` and K_r in N m/rad for ``implicit``. The limits are
    searched over L at given K_c for ``direct``, and over K_r at given L for ``implicit``.
    """
    side = max(2, round((count / 2) ** 0.5))
    lengths = np.geomspace(*LENGTH, side)
    ranges = {"direct": CONTACT_STIFFNESS, "implicit": ROTATIONAL_STIFFNESS}
    cells: list[Point] = [
        {"what": "cell", "method": name, "length": float(length), "stiffness": float(stiffness)}
        for name in METHODS_SHOWN
        for length in lengths
        for stiffness in np.geomspace(*ranges[name], side)
    ]
    many = max(3, count // (2 * LIMITS_AMONG))
    searched = np.geomspace(*LENGTH, many)
    direct: list[Point] = [
        {"what": "limit", "method": "direct", "length": 0.0, "stiffness": float(stiffness)}
        for stiffness in contact_stiffness_limit(searched[::-1])
    ]
    behind: list[Point] = [
        {"what": "limit", "method": "implicit", "length": float(length), "stiffness": 0.0}
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


def read(table: Table) -> Finding:
    """Draws contact or coupling stiffness over the length, with the limits on top.

    Raises:
        StudyError: No point was computed at all.
    """
    table = computed(table, "geometry")
    limits = table.select(table["what"] == "limit")
    direct = limits.select(limits["method"] == "direct")
    behind = limits.select(limits["method"] == "implicit")
    boundary = {
        "period": PERIOD,
        "device_rotational_damping": DEVICE_DAMPING,
        "direct": _of_direct(direct),
        "implicit": _of_implicit(behind),
    }
    return Finding(_draw(table, direct, behind), _paragraph(boundary), boundary)


def _of_direct(limits: Table) -> dict[str, Any]:
    """Compares the longest pegs that were found, each at its K_c, with the printed limit."""
    predicted, measured = length_limit(limits["stiffness"]), limits.numbers("limit")
    return {
        "contact_stiffness": limits["stiffness"].tolist(),
        "measured_length": measured.tolist(),
        "predicted_length": predicted.tolist(),
        "largest_deviation": agreement(measured, predicted),
    }


def _of_implicit(limits: Table) -> dict[str, Any]:
    """Compares the largest K_r that were found, each at its length, with (6) and each other."""
    measured = limits.numbers("limit")
    # 0 and infinity: nothing or everything that was searched is stable, which is no limit
    known = measured[np.isfinite(measured) & (measured > 0)]
    return {
        "coupling_rotational_damping": ROTATIONAL_DAMPING,
        "length": limits["length"].tolist(),
        "measured_rotational_stiffness": measured.tolist(),
        "predicted_6": BOUND,
        "largest_deviation": agreement(measured, BOUND),
        "smallest": float(known.min()) if known.size else None,
        "largest": float(known.max()) if known.size else None,
        "largest_over_smallest": float(known.max() / known.min()) if known.size else None,
    }


def _paragraph(boundary: Mapping[str, Any]) -> str:
    direct, behind = boundary["direct"], boundary["implicit"]
    contact, length = direct["contact_stiffness"], direct["measured_length"]
    if contact:
        soft, stiff = int(np.argmin(contact)), int(np.argmax(contact))
        said = (
            f"Rendered directly, a peg is stable up to {1e3 * length[soft]:.3g} mm with contacts "
            f"of {contact[soft]:.3g} N/m and up to {1e3 * length[stiff]:.3g} mm with "
            f"{contact[stiff]:.3g} N/m: {per_cent(direct['largest_deviation'])} of "
            "L = 2 √(b_θ/(T K_c)). "
        )
    else:
        said = f"Rendered directly, {MISSING}. "
    if behind["largest"] is None:
        nothing = "no limit was found" if behind["length"] else MISSING
        return f"{said}Behind the coupling, {nothing}."
    return said + (
        f"Behind the coupling the largest K_r lies between {behind['smallest']:.4g} and "
        f"{behind['largest']:.4g} N m/rad over all lengths, "
        f"{per_cent(behind['largest_deviation'])} of the {BOUND:.3g} N m/rad of eq. (6), which "
        "does not know L."
    )


def _draw(table: Table, direct: Table, behind: Table) -> Figure:
    figure = new_figure(8, 4.6)
    left, right = figure.subplots(1, 2, sharex=True)
    _draw_cells(left, table, "direct")
    _draw_cells(right, table, "implicit")
    lengths = np.geomspace(*LENGTH, 100)
    measured = {"marker": "o", "ls": "", "color": "black", "ms": 4, "mfc": "white"}
    left.plot(1e3 * lengths, contact_stiffness_limit(lengths), color="black", lw=1.8)
    left.plot(1e3 * direct.numbers("limit"), direct["stiffness"], **measured)
    right.axhline(BOUND, color=THEORY_COLOUR, lw=1.8, ls="--")
    right.plot(1e3 * behind["length"], behind.numbers("limit"), **measured)
    left.set_title("direct: no coupling", fontsize="medium")
    right.set_title("implicit: behind the coupling", fontsize="medium")
    left.set_ylabel("contact stiffness K_c (N/m)")
    right.set_ylabel("coupling stiffness K_r (N m/rad)")
    left.set_ylim(*CONTACT_STIFFNESS)
    right.set_ylim(*ROTATIONAL_STIFFNESS)
    for axes in (left, right):
        axes.set_xlabel("length of the peg L (mm)")
        axes.set_xlim(1e3 * LENGTH[0], 1e3 * LENGTH[1])
    figure.suptitle(
        f"A peg that fills its hole, handle midway, b_θ = {1e3 * DEVICE_DAMPING:g} mN m s/rad "
        f"at {1 / PERIOD:g} Hz,\nworst hand in rotation; B_r = "
        f"{1e3 * ROTATIONAL_DAMPING:g} mN m s/rad in the coupling",
        fontsize="medium",
    )
    verdict_legend(
        figure,
        [
            ("L = 2 √(b_θ/(T K_c))", "black", "-"),
            ("(6): K_r = 2 (b_θ − B_r)/T", THEORY_COLOUR, "--"),
            ("measured limit", "black", "o"),
        ],
    )
    return figure


def _draw_cells(axes: Axes, table: Table, name: str) -> None:
    cells = table.select((table["what"] == "cell") & (table["method"] == name))
    verdict = verdict_numbers(cells.numbers("stable") == 1, cells.texts("environment"))
    length = 1e3 * cells["length"]
    draw_verdicts(axes, length, cells["stiffness"], verdict, log_x=True, log_y=True)


GEOMETRY = StabilityMap(
    name="geometry",
    about="length of a peg against the stiffness of its contacts, rendered directly, and against "
    "that of the coupling in front of it",
    default_points=3600,
    points=points,
    evaluate=evaluate,
    read=read,
)
