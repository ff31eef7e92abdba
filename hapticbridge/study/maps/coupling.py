"""Map ``coupling``: stiffness against damping at one device, for every method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hapticbridge.study.maps.bisection import agreement, per_cent
from hapticbridge.study.maps.bound_of_method import limit_by_6, needed_by_6
from hapticbridge.study.maps.coupling_picture import draw
from hapticbridge.study.maps.coupling_runs import (
    DEVICE_DAMPING,
    PERIOD,
    THEORIES,
    evaluate,
    of_method,
    points,
    verdicts_of,
)
from hapticbridge.study.maps.stability_map import Finding, StabilityMap, computed
from hapticbridge.study.maps.verdicts import MISSING, VERDICTS
from hapticbridge.study.table import Table


def read(table: Table) -> Finding:
    """Draws K against B by method, with the bounds on top, and compares the limits with (6).

    Raises:
        StudyError: No point was computed at all.
    """
    table = computed(table, "coupling")
    boundary = {
        name: _cells_below(name, of_method(table, "cell", name))
        | _limits(name, of_method(table, "limit", name))
        for name in THEORIES
    }
    return Finding(
        draw(table),
        _paragraph(boundary),
        {"period": PERIOD, "device_damping": DEVICE_DAMPING, "methods": boundary},
    )


def _cells_below(name: str, cells: Table) -> dict[str, Any]:
    """Counts what happened at a method's points below (6), where a device bears the coupling."""
    needed = needed_by_6(name, cells["stiffness"], cells["damping"], PERIOD)
    below = needed < DEVICE_DAMPING
    mine = cells.select(below)
    is_passive = verdicts_of(mine) <= VERDICTS.index("within slack")
    ports = mine.texts("fault_port")
    return {
        "passive_share_below_6": float(np.mean(is_passive)) if len(mine) else None,
        "runs_below_6": len(mine),
        "environment_faults_below_6": int((ports == "environment").sum()),
        "device_faults_below_6": int((ports == "device").sum()),
        "most_slack_used_below_6": float(mine.numbers("slack_share").max(initial=0.0)),
        "largest_tapping_force_below_6": float(mine.numbers("peak_force").max(initial=0.0)),
    }


def _limits(name: str, limits: Table) -> dict[str, Any]:
    """Compares the limits that were found on a wall with (6); empty where none was searched."""
    if not len(limits):
        return {}
    predicted = limit_by_6(name, DEVICE_DAMPING, PERIOD, limits["damping"])
    measured = limits.numbers("limit")
    return {
        "damping": limits["damping"].tolist(),
        "measured_on_wall": measured.tolist(),
        "predicted_6": predicted.tolist(),
        "largest_deviation": agreement(measured, predicted),
    }


def _paragraph(boundary: Mapping[str, Mapping[str, Any]]) -> str:
    if "largest_deviation" in boundary["implicit"]:
        worst = boundary["implicit"]["largest_deviation"]
        on_wall = (
            f"On a wall the worst hand turns 'implicit' unstable {per_cent(worst)} of "
            "K = 2 (b − B)/T, eq. (6)"
        )
    else:
        on_wall = f"On a wall, behind 'implicit', {MISSING}"
    said = [on_wall, *(_of_method(name, mine) for name, mine in boundary.items())]
    said.append(
        "B is the damping asked for; 'compensated' and 'lossless' use B − K T and B − K T/2, 0 "
        "at least, and (6) holds for what is used"
    )
    return ". ".join(said) + ". The table holds tick and port of every first fault."


def _of_method(name: str, mine: Mapping[str, Any]) -> str:
    if not mine["runs_below_6"]:
        return f"'{name}': {MISSING} below (6)"
    text = (
        f"'{name}' is stable and passive at {100 * mine['passive_share_below_6']:.0f} % of the "
        "points below (6)"
    )
    faults = [
        f"the {port} port at {mine[f'{port}_faults_below_6']}"
        for port in ("environment", "device")
        if mine[f"{port}_faults_below_6"]
    ]
    if faults:
        return (
            f"{text}; the hand that taps finds at fault {' and '.join(faults)} of "
            f"{mine['runs_below_6']}"
        )
    text += "; the hand that taps finds no port at fault"
    if mine["most_slack_used_below_6"] > 0:
        text += f" and {100 * mine['most_slack_used_below_6']:.0f} % of the slack used"
    return text


COUPLING = StabilityMap(
    name="coupling",
    about="stiffness against damping of the coupling at one device, for every method: stable and "
    "passive, or not",
    default_points=6000,
    points=points,
    evaluate=evaluate,
    read=read,
)
