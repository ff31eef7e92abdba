"""How the map ``device`` is drawn: regions over β and σ, and the friction a damper needs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hapticbridge.plotting import new_figure
from hapticbridge.study.maps.bound_of_method import law_in_words
from hapticbridge.study.maps.device_runs import (
    DAMPED,
    DEVICE_MASS,
    METHODS_SHOWN,
    PERIOD,
    RANGE,
    REGIONS,
    RESOLUTION,
    STIFFNESS,
)
from hapticbridge.study.maps.palette import METHOD_COLOURS
from hapticbridge.study.maps.verdicts import COLOURS as VERDICT_COLOURS
from hapticbridge.study.maps.verdicts import say_missing
from hapticbridge.study.table import Table

COLOURS = (VERDICT_COLOURS[0], "#8fb8de", VERDICT_COLOURS[1], VERDICT_COLOURS[3])
"""Of the regions: those of the verdicts from strict to unstable, and one that no verdict has for
what depends on the knock."""

MARKERS = {"shaken": "o", "pressed": "s"}

WORDS = {"shaken": "shaken across a step", "pressed": "pressed, comes to rest"}
"""What a marker stands for."""

SIZES = (7.0, 5.5, 3.5)
"""Of the methods' markers in points, and three times their lines' widths: where ``compensated`` and
``lossless`` use no damper they lie on each other, and all must be seen."""


def draw(cells: Table, friction: Mapping[str, Any]) -> Figure:
    """Draws the regions, and beside them the friction that was found at each damper."""
    figure = new_figure(8, 5.4)
    left, right = figure.subplots(1, 2, width_ratios=(1.1, 1))
    _draw_regions(left, cells)
    _draw_friction(right, friction)
    figure.suptitle(
        f"Encoder steps of Δ = {1e6 * RESOLUTION:g} µm against dry friction f_c: a device of\n"
        f"{1e3 * DEVICE_MASS:g} g pressed on a wall, K = {STIFFNESS:g} N/m, {1 / PERIOD:g} Hz",
        fontsize="medium",
    )
    figure.legend(
        handles=[
            *(Patch(facecolor=c, label=r) for r, c in zip(REGIONS, COLOURS, strict=True)),
            Line2D([], [], color="black", label="β = ½, σ = ½ (Diolaiti)"),
        ],
        title="measured (colours) and predicted (lines)",
        title_fontsize="small",
        fontsize="small",
        loc="outside lower center",
        ncols=5,
        columnspacing=1.2,
        frameon=False,
    )
    return figure


def _draw_regions(axes: Axes, cells: Table) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    if len(cells):
        number = np.array([REGIONS.index(name) for name in cells["region"]])
        beta, sigma = np.unique(cells["beta"]), np.unique(cells["sigma"])
        grid = np.full((sigma.size, beta.size), np.nan)
        grid[np.searchsorted(sigma, cells["sigma"]), np.searchsorted(beta, cells["beta"])] = number
        axes.pcolormesh(
            beta, sigma, grid, cmap=ListedColormap(COLOURS), vmin=-0.5, vmax=3.5, shading="nearest"
        )
        for place, name in {
            (1.0, 1.0): REGIONS[0],
            (0.22, 1.0): REGIONS[1],
            (1.0, 0.22): REGIONS[2],
            (0.22, 0.22): REGIONS[3],
        }.items():
            axes.text(*place, f"theory:\n{name}", ha="center", va="center", fontsize="small")
    else:
        say_missing(axes)
    axes.axvline(0.5, color="black", lw=1.8)
    axes.axhline(0.5, color="black", lw=1.8)
    axes.set_xlim(*RANGE)
    axes.set_ylim(*RANGE)
    ticks = (0.1, 0.2, 0.5, 1.0, 2.0)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel("damping of the device, β = b/(K T)")
    axes.set_ylabel("friction of the device, σ = f_c/(K Δ)")
    axes.set_title("B = 0: pressed, and knocked; one law", fontsize="medium")


def _draw_friction(axes: Axes, found: Mapping[str, Any]) -> None:
    axes.set_xlabel("coupling damping B asked for (N s/m)")
    axes.set_ylabel("friction needed, f_c/(K Δ)")
    axes.set_title(f"with a damper, b = {DAMPED:g} N s/m", fontsize="medium")
    if not found:
        say_missing(axes)
        return
    for name, size in zip(METHODS_SHOWN, SIZES, strict=True):
        if name in found:
            mine, colour = found[name], METHOD_COLOURS[name]
            style: dict[str, Any] = {"color": colour, "mfc": "white", "ls": "", "ms": size}
            axes.plot(
                mine["damping"],
                mine["predicted"],
                color=colour,
                lw=size / 3,
                label=f"{name}: {law_in_words(name)}",
            )
            for what, marker in MARKERS.items():
                axes.plot(mine["damping"], mine[what], marker, **style)
    for what, marker in MARKERS.items():
        axes.plot([], [], marker, color="black", mfc="white", label=f"measured: {WORDS[what]}")
    # room above for the names
    axes.set_ylim(0, 1.75 * max(max(mine["predicted"]) for mine in found.values()))
    lines = Line2D([], [], ls="", label="lines: f_c = K Δ/2 + B′ Δ/T")
    axes.legend(
        handles=[lines, *axes.get_legend_handles_labels()[0]], fontsize="small", loc="upper left"
    )
