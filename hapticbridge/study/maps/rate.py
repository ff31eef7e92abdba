"""Map ``rate``: how stiff a wall may be at each period, delay, jitter and share of lost ticks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.study.maps.bisection import agreement, per_cent
from hapticbridge.study.maps.rate_picture import draw
from hapticbridge.study.maps.rate_runs import (
    DAMPING,
    DELAYS,
    DEVICE_DAMPING,
    HANDS,
    UNEVEN,
    evaluate,
    points,
    uneven_bound,
    wall_limit,
)
from hapticbridge.study.maps.stability_map import Finding, StabilityMap, computed
from hapticbridge.study.maps.verdicts import MISSING
from hapticbridge.study.table import Table

WORDS = {"jitter": "Ticks late by up to a share of T", "drops": "A share of all ticks lost"}
"""How the paragraph begins on uneven ticks."""

LINES = ("mean", "balanced", "longest")
"""Periods of ``unevenness`` with which the measurement at uneven ticks is compared."""


def read(table: Table) -> Finding:
    """Compares the largest K with theory, by period and delay, by jitter, and by lost ticks.

    A delay or a hand of which no point was computed is left out, and the paragraph says so.

    Raises:
        StudyError: No point was computed at all.
    """
    table = computed(table, "rate")
    boundary = {
        "device_damping": DEVICE_DAMPING,
        "damping": DAMPING,
        "by_delay": _by_delay(table.select(table["what"] == "delay")),
        "uneven": {what: _uneven(table.select(table["what"] == what)) for what in UNEVEN},
    }
    return Finding(draw(boundary), _paragraph(boundary), boundary)


def _by_delay(rows: Table) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for delay in np.unique(rows["delay"]):
        mine = rows.select(rows["delay"] == delay)
        period, limit = mine["period"], mine.numbers("limit")
        predicted = np.array([wall_limit(float(t), int(delay)) for t in period])
        found[str(int(delay))] = {
            "period": period.tolist(),
            "measured": limit.tolist(),
            "predicted": predicted.tolist(),
            "worst_ratio_error": agreement(limit, predicted),
            "slope": _slope(period, limit),
        }
    return found


def _slope(period: NDArray[np.float64], limit: NDArray[np.float64]) -> float | None:
    """Returns the power of T with which K goes; None where fewer than two K are known."""
    is_known = np.isfinite(limit) & (limit > 0)
    if is_known.sum() < 2:
        return None
    return float(np.polyfit(np.log(period[is_known]), np.log(limit[is_known]), 1)[0])


def _uneven(rows: Table) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in HANDS:
        mine = rows.select(rows["hand"] == name)
        if len(mine):
            found[name] = {
                "share": mine["share"].tolist(),
                "measured": mine.numbers("limit").tolist(),
                **{f"at_{line}": uneven_bound(mine.numbers(line)).tolist() for line in LINES},
            }
    return found


def _paragraph(boundary: Mapping[str, Any]) -> str:
    said = [_of_delays(boundary["by_delay"])]
    said += [_of_uneven(what, mine) for what, mine in boundary["uneven"].items()]
    return ". ".join(said) + "."


def _of_delays(by_delay: Mapping[str, Any]) -> str:
    left_out = [str(delay) for delay in range(DELAYS) if str(delay) not in by_delay]
    if len(left_out) == DELAYS:
        return f"Even ticks: {MISSING}"
    errors = [mine["worst_ratio_error"] for mine in by_delay.values()]
    known = [error for error in errors if error is not None]
    periods = [1e3 * period for mine in by_delay.values() for period in mine["period"]]
    text = (
        f"At even ticks, T = {min(periods):.3g} to {max(periods):.3g} ms, the worst hand turns the "
        f"wall unstable {per_cent(max(known, default=None))} of the bound for its delay. Wall, b, "
        "B and worst hand have no time but T: with K T kept, the runs at all periods are one loop "
        "to another scale"
    )
    slope = by_delay.get("0", {}).get("slope")
    if slope is not None:
        text += f", and without a delay K was found to go with T to the power {slope:.3f}"
    if left_out:
        text += f". Delay of {', '.join(left_out)} samples: {MISSING}"
    return text


def _of_uneven(what: str, mine: Mapping[str, Any]) -> str:
    free, held = mine.get("no hand"), mine.get("ordinary hand")
    said = []
    if free is None:
        said.append(f"no hand: {MISSING}")
    else:
        first, last = free["measured"][0], free["measured"][-1]
        is_known = 0 < first < np.inf and last < np.inf
        kept = f"keeps {100 * last / first:.0f} % of its stiffness" if is_known else "bears"
        said.append(
            f"at {free['share'][-1]:g} a free device {kept} ({last:.0f} N/m), against "
            f"2b ΣT/ΣT² = {free['at_balanced'][-1]:.0f} by the balance of energy, "
            f"{free['at_mean'][-1]:.0f} at the mean interval and {free['at_longest'][-1]:.0f} at "
            "the longest, which is enough for any hand"
        )
    if held is None:
        said.append(f"ordinary hand: {MISSING}")
    else:
        said.append(f"an ordinary hand is stable up to {held['measured'][-1]:.0f} N/m")
    return f"{WORDS[what]}: {'; '.join(said)}"


RATE = StabilityMap(
    name="rate",
    about="largest stiffness of a wall against period and delay, and against jitter and lost ticks",
    default_points=100,
    points=points,
    evaluate=evaluate,
    read=read,
)
