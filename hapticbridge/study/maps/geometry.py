"""Map ``geometry``: how long a peg may be, rendered directly and through the coupling.

The peg touches both walls of its hole throughout, where ``lossless`` is in its implicit form: what
tells the methods behind the coupling apart is the B' that their law uses, with (6) in B'.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hapticbridge.study.maps.bisection import agreement, per_cent
from hapticbridge.study.maps.fitting_peg import (
    DEVICE_DAMPING,
    PERIOD,
    ROTATIONAL_DAMPING,
    length_limit,
)
from hapticbridge.study.maps.geometry_picture import draw
from hapticbridge.study.maps.geometry_runs import BEHIND, BOUNDS, METHODS_SHOWN, evaluate, points
from hapticbridge.study.maps.stability_map import Finding, StabilityMap, computed
from hapticbridge.study.maps.verdicts import MISSING
from hapticbridge.study.table import Table


def read(table: Table) -> Finding:
    """Draws contact or coupling stiffness over the length, with the limits on top.

    Raises:
        StudyError: No point was computed at all.
    """
    table = computed(table, "geometry")
    limits = table.select(table["what"] == "limit")
    of_method = {name: limits.select(limits["method"] == name) for name in METHODS_SHOWN}
    boundary = {
        "period": PERIOD,
        "device_rotational_damping": DEVICE_DAMPING,
        "direct": _of_direct(of_method["direct"]),
        **{name: _behind(name, of_method[name]) for name in BEHIND},
    }
    return Finding(draw(table, of_method), _paragraph(boundary), boundary)


def _of_direct(limits: Table) -> dict[str, Any]:
    """Compares the longest pegs that were found, each at its K_c, with the printed limit."""
    predicted, measured = length_limit(limits["stiffness"]), limits.numbers("limit")
    return {
        "contact_stiffness": limits["stiffness"].tolist(),
        "measured_length": measured.tolist(),
        "predicted_length": predicted.tolist(),
        "largest_deviation": agreement(measured, predicted),
    }


def _behind(name: str, limits: Table) -> dict[str, Any]:
    """Compares the largest K_r that were found, each at its length, with (6) and each other."""
    measured = limits.numbers("limit")
    # 0 and infinity: nothing or everything that was searched is stable, which is no limit
    known = measured[np.isfinite(measured) & (measured > 0)]
    return {
        "coupling_rotational_damping": ROTATIONAL_DAMPING,
        "length": limits["length"].tolist(),
        "measured_rotational_stiffness": measured.tolist(),
        "predicted_6": BOUNDS[name],
        "largest_deviation": agreement(measured, BOUNDS[name]),
        "smallest": float(known.min()) if known.size else None,
        "largest": float(known.max()) if known.size else None,
        "largest_over_smallest": float(known.max() / known.min()) if known.size else None,
    }


def _paragraph(boundary: Mapping[str, Any]) -> str:
    direct = boundary["direct"]
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
    behind = "; ".join(_said_of(name, boundary[name]) for name in BEHIND)
    return f"{said}Behind the coupling the largest K_r: {behind}. Eq. (6) does not know L."


def _said_of(name: str, mine: Mapping[str, Any]) -> str:
    if mine["largest"] is None:
        return f"'{name}', {'no limit was found' if mine['length'] else MISSING}"
    return (
        f"'{name}', between {mine['smallest']:.4g} and {mine['largest']:.4g} N m/rad over all "
        f"lengths, {per_cent(mine['largest_deviation'])} of the {mine['predicted_6']:.3g} N m/rad "
        "of eq. (6)"
    )


GEOMETRY = StabilityMap(
    name="geometry",
    about="length of a peg against the stiffness of its contacts, rendered directly, and against "
    "that of the coupling in front of it, by method",
    default_points=3600,
    points=points,
    evaluate=evaluate,
    read=read,
)
