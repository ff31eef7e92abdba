"""Map ``tool_mass``: how light a tool each method can render, and how heavy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hapticbridge.study.maps.bisection import agreement, per_cent
from hapticbridge.study.maps.bound_of_method import needed_by_6
from hapticbridge.study.maps.stability_map import Finding, StabilityMap, computed
from hapticbridge.study.maps.tool_mass_picture import draw
from hapticbridge.study.maps.tool_mass_runs import (
    DAMPING,
    DEVICE_DAMPING,
    PERIOD,
    SEARCHES,
    THEORIES,
    evaluate,
    is_stable,
    of_method,
    points,
    predicted_limit,
)
from hapticbridge.study.maps.verdicts import MISSING
from hapticbridge.study.table import Table


def read(table: Table) -> Finding:
    """Counts what failed by method, and compares the limits in mass with theory.

    A method of which no point was computed is left out, and the paragraph says so.

    Raises:
        StudyError: No point was computed at all.
    """
    table = computed(table, "tool_mass")
    methods: dict[str, dict[str, Any]] = {}
    for name in THEORIES:
        cells = of_method(table, "cell", name)
        methods[name] = _counts(name, cells) if len(cells) else {}
        for what in SEARCHES:
            rows = of_method(table, what, name)
            if len(rows):
                methods[name][what] = _compare(name, rows, is_held=what == "held still")
    boundary = {
        "period": PERIOD,
        "device_damping": DEVICE_DAMPING,
        "damping": DAMPING,
        "methods": methods,
    }
    return Finding(draw(table), _paragraph(methods), boundary)


def _counts(name: str, cells: Table) -> dict[str, Any]:
    """Returns how many tools of the grid were unstable, and what the stable ones created."""
    stable = is_stable(cells)
    is_below = needed_by_6(name, cells["stiffness"], DAMPING, PERIOD) < DEVICE_DAMPING
    return {
        "points": len(cells),
        "unstable_held_still": int((cells.numbers("stable_held_still") != 1).sum()),
        "points_below_6": int(is_below.sum()),
        "unstable_below_6": int((is_below & ~stable).sum()),
        "most_created": float(cells.numbers("created")[stable].max(initial=0.0)),
    }


def _compare(name: str, rows: Table, *, is_held: bool) -> dict[str, Any]:
    """Returns the limits that were found beside theory's; None where there is none."""
    predicted = [predicted_limit(name, float(k), is_held=is_held) for k in rows["stiffness"]]
    theory = np.array([p["limit"] for p in predicted], dtype=np.float64)
    limit = rows.numbers("limit")
    ends = ("stable_if_light", "stable_if_heavy")
    is_same = [
        np.array([p[end] for p in predicted], dtype=bool) == (rows.numbers(end) == 1)
        for end in ends
    ]
    return {
        "stiffness": rows["stiffness"].tolist(),
        "measured_mass": [float(m) if np.isfinite(m) else None for m in limit],
        "predicted_mass": [float(m) if np.isfinite(m) else None for m in theory],
        "worst_ratio_error": agreement(limit, theory),
        "disagreements": int((~(is_same[0] & is_same[1])).sum()),
    }


def _paragraph(methods: Mapping[str, Mapping[str, Any]]) -> str:
    said = [_of_method(name, mine) for name, mine in methods.items()]
    compared = [mine[what] for mine in methods.values() for what in SEARCHES if what in mine]
    if compared:
        known = [each["worst_ratio_error"] for each in compared]
        worst = max((error for error in known if error is not None), default=None)
        searches = sum(len(each["stiffness"]) for each in compared)
        astray = sum(each["disagreements"] for each in compared)
        said.append(
            f"Measured limits in mass agree with theory {per_cent(worst)}; whether there is a "
            f"limit at all, theory and measurement disagree on in {astray} of {searches} searches"
        )
    return ". ".join(said) + "."


def _of_method(name: str, mine: Mapping[str, Any]) -> str:
    if not mine:
        return f"'{name}': {MISSING}"
    if "points" not in mine:
        said = f"'{name}': {MISSING} on the grid"
    else:
        unstable = mine["unstable_held_still"]
        held = f"unstable at {unstable} of" if unstable else "stable at all"
        said = (
            f"'{name}': held still, a tool is {held} {mine['points']} points of the grid; below "
            f"(6), held still or in its worst hand, it is unstable at {mine['unstable_below_6']} "
            f"of {mine['points_below_6']}; where stable, it creates at most "
            f"{mine['most_created']:.2g} J"
        )
    for what in SEARCHES:
        if what not in mine:
            said += f"; {what}, limits: {MISSING}"
    limits = mine.get("held still", {}).get("measured_mass", [])
    found = [mass for mass in limits if mass is not None]
    if found:
        said += (
            f". Held still, stability changes with the mass at {len(found)} of the {len(limits)} "
            f"stiffnesses that were searched: at {1e3 * min(found):.3g} to "
            f"{1e3 * max(found):.3g} g"
        )
    return said


TOOL_MASS = StabilityMap(
    name="tool_mass",
    about="mass of the tool, 1 g to 10 kg, against stiffness of the coupling, by method",
    default_points=1000,
    points=points,
    evaluate=evaluate,
    read=read,
)
