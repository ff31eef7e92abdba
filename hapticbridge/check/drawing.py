"""Plot of a scene's cost."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from hapticbridge.check.cost import BRIDGE, TICK_SHARE, Cost
from hapticbridge.picture import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FREE, _CONTACT, _LINE = "tab:blue", "tab:orange", "0.3"
_LEAST_SHARE = 0.01  # of the tick; smaller stages are not drawn


def _known(seconds: float) -> float:
    return seconds if math.isfinite(seconds) else 0.0


def draw_cost(cost: Cost, title: str) -> Figure:
    """Draws the stages of a tick and its growth with constraint rows."""
    figure = new_figure(8.0, 4.4)
    figure.suptitle(f"{title} (rate: p99 within {100 * TICK_SHARE:g} % of the period)")
    stages, growth = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    whole = max(_known(cost.free.median), _known(cost.contact.median))
    drawn = {
        name: times
        for name, times in cost.stages.items()
        if name == BRIDGE or max(map(_known, times)) >= _LEAST_SHARE * whole
    }
    places = range(len(drawn))
    kinds = ((0, "out of contact", cost.free, _FREE), (1, "in contact", cost.contact, _CONTACT))
    for k, label, spread, colour in kinds:
        if spread.ticks:
            stages.barh(
                [place + 0.2 * (2 * k - 1) for place in places],
                [1e6 * times[k] for times in drawn.values()],
                height=0.38,
                color=colour,
                label=f"{label}: {1e6 * spread.median:.3g} µs, p99 {1e6 * spread.p99:.3g} µs",
            )
    stages.set_yticks(list(places), list(drawn))
    stages.invert_yaxis()
    stages.set_xlabel("median time per tick in µs")
    stages.set_title("where it goes", fontsize="medium")
    figure.legend(fontsize="small", loc="outside lower left", ncols=2)

    steps = cost.by_rows.steps
    growth.plot(
        [rows for rows, _, _ in steps],
        [1e6 * seconds for _, _, seconds in steps],
        "o",
        color=_LINE,
        label="median of a tick",
    )
    base, per_one = cost.by_rows.base, cost.by_rows.per_one
    if base is not None and per_one is not None:
        ends = [steps[0][0], steps[-1][0]]
        growth.plot(
            ends,
            [1e6 * (base + per_one * rows) for rows in ends],
            color=_LINE,
            label=f"{1e6 * base:.3g} µs + {1e6 * per_one:.2g} µs per row",
        )
    growth.set_xlabel("constraint rows in the tick")
    growth.set_ylabel("median time per tick in µs")
    growth.set_ylim(0.0, 1.15e6 * max(seconds for _, _, seconds in steps))
    rate = math.floor(cost.highest_rate)
    growth.set_title(f"how it grows; up to {rate:,} Hz", fontsize="medium")
    growth.legend(fontsize="small", loc="lower right")
    return figure
