"""Map ``rate``: how stiff a wall may be at each period, delay, jitter and share of lost ticks.

At even ticks for ``implicit``, ``compensated`` and ``lossless`` at the same B asked for, each
against the bound for the B' that its law uses.
"""

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
    METHODS_SHOWN,
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
    """Compares the largest K with theory: by method, period and delay; by jitter; by lost ticks.

    A method, a delay or a hand without a computed point is left out, and the paragraph says so.

    Raises:
        StudyError: No point was computed at all.
    """
    table = computed(table, "rate")
    boundary = {
        "device_damping": DEVICE_DAMPING,
        "damping": DAMPING,
        "methods": {name: _by_delay(name, table) for name in METHODS_SHOWN},
        "uneven": {what: _uneven(table.select(table["what"] == what)) for what in UNEVEN},
    }
    return Finding(draw(boundary), _paragraph(boundary), boundary)


def _by_delay(name: str, table: Table) -> dict[str, Any]:
    rows = table.select((table["what"] == "delay") & (table["method"] == name))
    found: dict[str, Any] = {}
    for delay in np.unique(rows["delay"]):
        mine = rows.select(rows["delay"] == delay)
        period, limit = mine["period"], mine.numbers("limit")
        predicted = np.array([wall_limit(name, float(t), int(delay)) for t in period])
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
    said = [_of_even(boundary["methods"])]
    said += [_of_method(name, mine) for name, mine in boundary["methods"].items()]
    said += [_of_uneven(what, mine) for what, mine in boundary["uneven"].items()]
    return ". ".join(said) + "."


def _of_even(methods: Mapping[str, Mapping[str, Any]]) -> str:
    delays = [mine for by_delay in methods.values() for mine in by_delay.values()]
    if not delays:
        return f"Even ticks: {MISSING}"
    known = [mine["worst_ratio_error"] for mine in delays if mine["worst_ratio_error"] is not None]
    periods = [1e3 * period for mine in delays for period in mine["period"]]
    return (
        f"At even ticks, T = {min(periods):.3g} to {max(periods):.3g} ms and {DAMPING:g} N s/m "
        "asked for, the worst hand turns the wall unstable "
        f"{per_cent(max(known, default=None))} of the bound for its method and delay. Wall, b, B "
        "and worst hand have no time but T: with K T kept, the runs at all periods are one loop "
        "to another scale. With a delay a damper helps on a wall, so that B′ taken off costs "
        "stiffness there"
    )


def _of_method(name: str, by_delay: Mapping[str, Any]) -> str:
    left_out = [str(delay) for delay in range(DELAYS) if str(delay) not in by_delay]
    if len(left_out) == DELAYS:
        return f"'{name}' at even ticks: {MISSING}"
    at_each = [
        f"{100 * share:.0f} %" + (f" at {delay}" if delay != "0" else " without a delay")
        for delay, mine in by_delay.items()
        if (share := _share(mine)) is not None
    ]
    text = f"'{name}' bears, of K = 2b/T, {', '.join(at_each) or 'nothing that was found'}"
    slope = by_delay.get("0", {}).get("slope")
    if slope is not None:
        text += f"; without a delay K was found to go with T to the power {slope:.3f}"
    if left_out:
        text += f"; delay of {', '.join(left_out)} samples: {MISSING}"
    return text


def _share(mine: Mapping[str, Any]) -> float | None:
    """Returns the mean over the periods of K T/(2b); None where no K was found."""
    share = np.array(mine["measured"]) * np.array(mine["period"]) / (2 * DEVICE_DAMPING)
    known = share[np.isfinite(share) & (share > 0)]
    return float(known.mean()) if known.size else None


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
    about="largest stiffness of a wall against period and delay by method, and against jitter and "
    "lost ticks",
    default_points=110,
    points=points,
    evaluate=evaluate,
    read=read,
)
