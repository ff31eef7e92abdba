"""How the map ``rate`` is drawn: even ticks above, a panel a method; uneven ones below."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from hapticbridge.plotting import new_figure
from hapticbridge.study.maps.bound_of_method import law_in_words
from hapticbridge.study.maps.palette import THEORY_COLOUR
from hapticbridge.study.maps.rate_runs import (
    DAMPING,
    DELAYS,
    DEVICE_DAMPING,
    HANDS,
    METHODS_SHOWN,
    UNEVEN_PERIOD,
    WALL_MASS,
)
from hapticbridge.study.maps.verdicts import say_missing

STYLES = {
    "at_mean": ("K = 2b/T, T the mean interval", ":"),
    "at_balanced": ("K = 2b ΣT/ΣT²: balance of energy", "--"),
    "at_longest": ("K = 2b/T, T the longest: enough for any hand", "-"),
}
"""Label and line of each bound at uneven ticks."""

AXES = {
    "jitter": "ticks late by up to (share of T)",
    "drops": "ticks lost (share of all)",
}

MARKERS = dict(zip(HANDS, "os", strict=True))

SHOWN = (15.0, 7e4)
"""Range of K in N/m at even ticks: all bounds at b, and room for the names below them."""


def draw(boundary: Mapping[str, Any]) -> Figure:
    """Draws what ``rate.read`` found."""
    figure = new_figure(8, 8.4)
    grid = figure.add_gridspec(2, 6, height_ratios=(1.25, 1))
    above: list[Axes] = []
    for place, (name, by_delay) in enumerate(boundary["methods"].items()):
        where = grid[0, 2 * place : 2 * place + 2]
        axes = figure.add_subplot(where, sharey=above[0] if above else None)
        _draw_delays(axes, name, by_delay)
        axes.tick_params(labelleft=not above)
        above.append(axes)
    above[0].set_ylabel("largest stable K (N/m)")
    first = figure.add_subplot(grid[1, :3])
    panels = (first, figure.add_subplot(grid[1, 3:], sharey=first))
    for axes, (what, words) in zip(panels, AXES.items(), strict=True):
        _draw_uneven(axes, boundary["uneven"][what], words)
    first.set_ylabel("largest stable K (N/m)")
    handles = [
        first.plot([], [], marker, color="black", mfc="white", label=f"measured: {name}")[0]
        for name, marker in MARKERS.items()
    ]
    handles += [
        first.plot([], [], style, color=THEORY_COLOUR, label=label)[0]
        for label, style in STYLES.values()
    ]
    figure.suptitle(
        f"Largest stable K on a wall: behind the coupling is a tool of {1e-3 * WALL_MASS:g} t, "
        f"device damping b = {DEVICE_DAMPING:g} N s/m\n"
        f"above: even ticks, B = {DAMPING:g} N s/m asked for, the law uses B′ (0 at least);\n"
        "circles: measured with the worst hand",
        fontsize="medium",
    )
    names = ", ".join(METHODS_SHOWN)
    figure.legend(
        handles=handles,
        title=f"below: T = {1e3 * UNEVEN_PERIOD:g} ms, B = 0, for which {names} have one law",
        title_fontsize="small",
        loc="outside lower center",
        ncols=2,
        fontsize="small",
        frameon=False,
    )
    return figure


def _draw_delays(axes: Axes, name: str, by_delay: Mapping[str, Any]) -> None:
    # one hue, lighter the later: a delay is a quantity, and verdicts own the other colours
    shade = matplotlib.colormaps["Blues_r"]
    axes.set_xscale("log")
    axes.set_yscale("log")
    for delay, mine in by_delay.items():
        colour, period = shade(0.65 * int(delay) / (DELAYS - 1)), 1e3 * np.array(mine["period"])
        axes.plot(period, mine["predicted"], color=colour, label=delay)
        axes.plot(period, _drawable(mine["measured"]), "o", color=colour, mfc="white", ms=5)
    if by_delay:
        axes.legend(
            title="bound, delay in samples",
            title_fontsize="small",
            fontsize="small",
            ncols=3,
            loc="lower left",
            handlelength=1.2,
            columnspacing=1.0,
        )
    else:
        say_missing(axes)
    axes.set_ylim(*SHOWN)
    axes.set_title(f"{name}, {law_in_words(name)}", fontsize="medium")
    axes.set_xlabel("period T (ms)")
    ticks = (0.1, 0.3, 1, 3)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="both", alpha=0.25)


def _draw_uneven(axes: Axes, found: Mapping[str, Any], words: str) -> None:
    axes.set_yscale("log")
    for name, mine in found.items():
        axes.plot(
            mine["share"],
            _drawable(mine["measured"]),
            MARKERS[name],
            color="black",
            mfc="white",
            ms=5,
        )
    if found:
        lines = next(iter(found.values()))  # the ticks were the same for every hand
        for key, (_, style) in STYLES.items():
            axes.plot(lines["share"], lines[key], style, color=THEORY_COLOUR)
    else:
        say_missing(axes)
    axes.set_xlabel(words)
    axes.grid(visible=True, which="both", alpha=0.25)


def _drawable(values: list[float]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Returns values for a logarithmic axis, which has no place for 0 and infinity."""
    numbers = np.array(values, dtype=np.float64)
    return np.where(np.isfinite(numbers) & (numbers > 0), numbers, np.nan)
