"""How the map ``rotation`` is drawn: verdicts above, creation and the jump at the cut below."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hapticbridge.plotting import new_figure
from hapticbridge.study.maps.palette import METHOD_COLOURS, THEORY_COLOUR
from hapticbridge.study.maps.rotation_runs import HARD, LINES, METHODS_SHOWN, SOFT
from hapticbridge.study.maps.tumbling import (
    INERTIA,
    PERIOD,
    TICKS,
    cut_speed,
    free_creation,
    gyroscopic_speed,
)
from hapticbridge.study.maps.verdicts import (
    draw_verdicts,
    verdict_legend,
    verdict_numbers,
)
from hapticbridge.study.table import Table

STYLES = {0.0: "s:", SOFT: "o-", HARD: "^--"}
"""Marker and line by K_r in N m/rad."""

LEAST = 1e-12
"""Energy in J that stands for none on a logarithmic axis."""

HIGHEST = 5 * np.pi * SOFT
"""Upper end of the axis of torque in N m: the jump at the cut, and room for the names above it."""


def draw(table: Table) -> Figure:
    """Draws verdicts over speed and angle, creation over speed, and the jump at the cut."""
    figure = new_figure(8, 8.4)
    grid = figure.add_gridspec(3, 6, height_ratios=[1, 1, 1.4])
    for place, method in enumerate(METHODS_SHOWN):
        row, column = divmod(place, 3)
        axes = figure.add_subplot(grid[row, 2 * column : 2 * column + 2])
        _draw_cells(axes, table, method)
        if row == 1:
            axes.set_xlabel("speed (rad/s)")
        if column == 0:
            axes.set_ylabel("angle at the start (rad)")
    _draw_creation(figure.add_subplot(grid[2, :3]), table)
    _draw_cut(figure.add_subplot(grid[2, 3:]), table)
    figure.suptitle(
        f"A free tool of {1e3 * INERTIA[0]:.3g}, {1e3 * INERTIA[1]:.3g}, "
        f"{1e3 * INERTIA[2]:.3g} g m² behind a handle that spins for 1 s at "
        f"{1 / PERIOD:g} Hz;\nabove and right: K_r = {SOFT:g} N m/rad",
        fontsize="medium",
    )
    verdict_legend(
        figure,
        [
            ("angle passed π", "black", "o"),
            ("gyroscopic torque = π K_r", THEORY_COLOUR, "--"),
        ],
    )
    return figure


def _draw_cells(axes: Axes, table: Table, method: str) -> None:
    axes.set_title(method, fontsize="medium")
    cells = table.select((table["what"] == "cell") & (table["method"] == method))
    verdict = verdict_numbers(cells.numbers("ticks") == TICKS, cells.texts("environment"))
    draw_verdicts(axes, cells["speed"], cells["angle"], verdict)
    passed = cells.select(cells.numbers("crossed") >= 0)
    axes.plot(passed["speed"], passed["angle"], "o", color="black", ms=2, mfc="white", mew=0.5)
    axes.axvline(gyroscopic_speed(SOFT), color=THEORY_COLOUR, ls="--", lw=1.5)


def _draw_creation(axes: Axes, table: Table) -> None:
    lines = table.select(table["what"] == "line")
    for method, stiffness in LINES:
        mine = lines.select(
            (lines["method"] == method) & (lines["rotational_stiffness"] == stiffness)
        )
        if stiffness == 0:
            predicted = [max(free_creation(float(speed)), LEAST) for speed in mine["speed"]]
            axes.plot(
                mine["speed"],
                predicted,
                color=THEORY_COLOUR,
                lw=4,
                alpha=0.5,
                label=r"½T²|ω×Iω|²/I",
            )
        axes.plot(
            mine["speed"],
            np.maximum(mine.numbers("created"), LEAST),
            STYLES[stiffness],
            color=METHOD_COLOURS[method],
            ms=3,
            lw=1,
            label=f"{method}, K_r = {stiffness:g}" if stiffness else "translation only",
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(1e-4 * LEAST, 1e4)  # room for the names below the curves
    axes.set_xlabel("speed (rad/s)")
    axes.set_ylabel("energy created (J)")
    axes.legend(fontsize="x-small", loc="lower right", ncols=2, handlelength=1.5)


def _draw_cut(axes: Axes, table: Table) -> None:
    cuts = table.select(table["what"] == "cut")
    widths = (7, 5.5, 4, 2.5, 1, 1)  # all but the last lie on each other
    for method, width in zip(METHODS_SHOWN, widths, strict=True):
        mine = cuts.select(cuts["method"] == method)
        jump = mine.numbers("torque_jump")
        is_beyond = jump > HIGHEST
        colour = METHOD_COLOURS[method]
        label = method
        if is_beyond.any():
            # a line to there would seem to end at the edge: marks say that it does not
            axes.plot(
                mine["speed"][is_beyond],
                np.full(is_beyond.sum(), 0.97 * HIGHEST),
                "^",
                color=colour,
                ms=5,
            )
            label = f"{method} (▲ beyond: to {jump[is_beyond].max():.1g})"
        shown = np.where(is_beyond, np.nan, jump)
        axes.plot(mine["speed"], shown, "o-", color=colour, ms=3, lw=width, label=label)
    axes.axvline(cut_speed(SOFT), color=THEORY_COLOUR, ls="--", lw=1.2, label="ω = π √(K_r/I)")
    axes.axhline(2 * np.pi * SOFT, color=THEORY_COLOUR, ls=":", lw=1.2, label="2π K_r")
    axes.set_ylim(0, HIGHEST)
    axes.set_xlabel("speed of a sudden turn (rad/s)")
    axes.set_ylabel("largest jump of torque\nin a tick (N m)")
    axes.legend(fontsize="x-small", loc="upper right", bbox_to_anchor=(1.0, 0.95))
