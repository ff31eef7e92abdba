"""How the map ``contact`` is drawn: verdicts by setting above, the search below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from hapticbridge.plotting import new_figure
from hapticbridge.scene.contacts import contact_numbers
from hapticbridge.study.maps.contact_agreement import LINES, is_in, verdicts
from hapticbridge.study.maps.contact_methods import HANDS, draw_methods
from hapticbridge.study.maps.contact_search import draw_search
from hapticbridge.study.maps.contact_treatments import PERIOD, SHIPPED_SOLIMP
from hapticbridge.study.maps.verdicts import COLOURS, VERDICTS, draw_verdicts
from hapticbridge.study.table import Table

STEPS = (0.25, 20.0)
"""Range of timeconst/T, even in its logarithm."""

DAMPING_RATIO = (0.05, 12.8)
"""Range of dampratio, even in its logarithm; six times beyond the usual ones, for there it ends."""

PANELS = (
    ("wall", "implicit", (2000.0, 20_000.0), "one mass on a wall, discrete"),
    ("wall", "implicitfast", (2000.0, 20_000.0), "one mass on a wall, implicitfast"),
    ("peg", "implicit", (1000.0, 6000.0), "peg in the hole, discrete"),
)
"""Rig, method, K in N/m and title."""

BESIDE = (1.0, 1.22)
"""Width of bars and of the columns beside them, as a ratio."""

CONTOUR = 160
"""Points along each axis from which the rule's lines are drawn; more make them smoother."""

Array = NDArray[np.float64]


def draw(
    table: Table, found: Sequence[Mapping[str, Any]], methods: Sequence[Mapping[str, Any]]
) -> Figure:
    """Draws verdicts over timeconst and dampratio with the rule on top, methods and search below.

    Args:
        table: Of the map.
        found: What each treatment of the search came to.
        methods: What each method came to on each rig.
    """
    figure = new_figure(8, 16)
    parts = figure.subfigures(3, 1, squeeze=False, height_ratios=(1, 0.4, 1.05))
    above, between, below = parts[:, 0]
    rows = above.add_gridspec(2, 3)
    for column, (rig, method, stiffness, title) in enumerate(PANELS):
        for row, k in enumerate(stiffness):
            axes = above.add_subplot(rows[row, column])
            _draw_panel(axes, table, rig, method, k)
            axes.set_title(f"{title}\nK = {k:g} N/m", fontsize="small")
            if row == 1:
                axes.set_xlabel("timeconst / T")
            if column == 0:
                axes.set_ylabel("dampratio")
    draw_methods(between.add_subplot(between.add_gridspec(1, 2, width_ratios=BESIDE)[0]), methods)
    between.suptitle(
        f"The methods on the contact as shipped, {HANDS} hands each: taps on a wall, and in and "
        "out of the hole's mouth;\ntools and K as below, B = 1.25 K T felt",
        fontsize="small",
    )
    draw_search(below.add_subplot(below.add_gridspec(1, 2, width_ratios=BESIDE)[0]), found)
    below.suptitle(
        "The search on the peg: 30, 100 and 300 g, K = 1000 and 6000 N/m, friction 0 and 0.42,\n"
        "one recorded and two random hands",
        fontsize="small",
    )
    figure.suptitle(
        f"Contact settings (solref) at T = {1e3 * PERIOD:g} ms, impedance 0.9 to 0.95,\n"
        "elliptic cone: the worst run of each cell\nwall: 10, 50 and 200 g; "
        "peg: 30 and 100 g, friction 0 and 0.42, random hands",
        fontsize="medium",
    )
    _legend(figure, sorted(set(verdicts(table).tolist())))
    return figure


def _legend(figure: Figure, verdicts: Sequence[int]) -> None:
    handles: list[Artist] = [Patch(facecolor=COLOURS[v], label=VERDICTS[v]) for v in verdicts]
    handles += [Line2D([], [], color="black", ls=style, label=words) for _, style, words in LINES]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=3, fontsize="small", frameon=False
    )


def _draw_panel(axes: Axes, table: Table, rig: str, method: str, stiffness: float) -> None:
    is_mine = (table["rig"] == rig) & (table["method"] == method)
    mine = table.select(is_mine & (table["stiffness"] == stiffness))
    draw_verdicts(axes, mine["steps"], mine["dampratio"], verdicts(mine), log_x=True, log_y=True)
    steps, ratio, regions = _rule()
    for (_, style, _), is_above in zip(LINES, regions, strict=True):
        axes.contour(
            steps, ratio, is_above, levels=[0.5], linestyles=style, linewidths=1.5, colors="black"
        )
    axes.plot(2.0, 1.0, "o", color="black", mfc="white", ms=5)
    axes.annotate(
        "as shipped",
        (2.0, 1.0),
        xytext=(-6, -30),
        textcoords="offset points",
        size=7,
        ha="center",
        arrowprops={"arrowstyle": "-", "lw": 0.6},
    )
    axes.set_xlim(*STEPS)
    axes.set_ylim(*DAMPING_RATIO)


@cache
def _rule() -> tuple[Array, Array, list[Array]]:
    """Returns timeconst/T, dampratio, and where each line's region of the rule is.

    The regions have a row a dampratio. Kept, because every panel shows the same.
    """
    steps, ratio = (np.geomspace(*ends, CONTOUR) for ends in (STEPS, DAMPING_RATIO))
    numbers = [
        [contact_numbers((s * PERIOD, d), SHIPPED_SOLIMP, PERIOD) for s in steps] for d in ratio
    ]
    regions = [
        np.array([[is_in(name, one) for one in row] for row in numbers], dtype=np.float64)
        for name, _, _ in LINES
    ]
    return steps, ratio, regions
