"""How the map ``geometry`` is drawn: a panel a method, limits and bounds over verdicts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hapticbridge.plotting import new_figure
from hapticbridge.study.maps.bound_of_method import law_in_words
from hapticbridge.study.maps.fitting_peg import (
    DEVICE_DAMPING,
    PERIOD,
    ROTATIONAL_DAMPING,
    contact_stiffness_limit,
)
from hapticbridge.study.maps.geometry_runs import (
    BOUNDS,
    CONTACT_STIFFNESS,
    LENGTH,
    METHODS_SHOWN,
    ROTATIONAL_STIFFNESS,
)
from hapticbridge.study.maps.palette import THEORY_COLOUR
from hapticbridge.study.maps.verdicts import draw_verdicts, verdict_legend, verdict_numbers
from hapticbridge.study.table import Table


def draw(table: Table, limits: Mapping[str, Table]) -> Figure:
    """Draws contact stiffness over length, and that of the coupling, with the limits on top.

    Args:
        table: All rows that were computed.
        limits: The searches of each method.
    """
    figure = new_figure(8, 7.6)
    panels = figure.subplots(2, 2, sharex=True).ravel()
    for axes, name in zip(panels, METHODS_SHOWN, strict=True):
        _draw_cells(axes, table, name)
        mine = limits[name]
        if name == "direct":
            lengths = np.geomspace(*LENGTH, 100)
            axes.plot(1e3 * lengths, contact_stiffness_limit(lengths), color="black", lw=1.8)
            x, y = mine.numbers("limit"), mine["stiffness"]
            axes.set_title("direct: no coupling", fontsize="medium")
            axes.set_ylabel("contact stiffness K_c (N/m)")
            axes.set_ylim(*CONTACT_STIFFNESS)
        else:
            axes.axhline(BOUNDS[name], color=THEORY_COLOUR, lw=1.8, ls="--")
            x, y = mine["length"], mine.numbers("limit")
            axes.set_title(f"{name}, {law_in_words(name, '_r')}", fontsize="medium")
            axes.set_ylabel("coupling stiffness K_r (N m/rad)")
            axes.set_ylim(*ROTATIONAL_STIFFNESS)
        axes.plot(1e3 * x, y, "o", color="black", ms=4, mfc="white")
        axes.set_xlim(1e3 * LENGTH[0], 1e3 * LENGTH[1])
    for axes in panels[2:]:
        axes.set_xlabel("length of the peg L (mm)")
    figure.suptitle(
        f"A peg that fills its hole, handle midway, b_θ = {1e3 * DEVICE_DAMPING:g} mN m s/rad "
        f"at {1 / PERIOD:g} Hz, worst hand in rotation;\nbehind the coupling B_r = "
        f"{1e3 * ROTATIONAL_DAMPING:g} mN m s/rad is asked for, and the law uses B_r′ (0 at least)",
        fontsize="medium",
    )
    verdict_legend(
        figure,
        [
            ("L = 2 √(b_θ/(T K_c))", "black", "-"),
            ("(6): b_θ = K_r T/2 + B_r′", THEORY_COLOUR, "--"),
            ("measured limit", "black", "o"),
        ],
    )
    return figure


def _draw_cells(axes: Axes, table: Table, name: str) -> None:
    cells = table.select((table["what"] == "cell") & (table["method"] == name))
    verdict = verdict_numbers(cells.numbers("stable") == 1, cells.texts("environment"))
    length = 1e3 * cells["length"]
    draw_verdicts(axes, length, cells["stiffness"], verdict, log_x=True, log_y=True)
