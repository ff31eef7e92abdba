"""How the map ``rate`` is drawn: even ticks above, jitter and lost ticks below."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from hapticbridge.picture import new_figure
from hapticbridge.study.maps.palette import THEORY_COLOUR
from hapticbridge.study.maps.rate_runs import (
    DAMPING,
    DELAYS,
    DEVICE_DAMPING,
    HANDS,
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


def draw(boundary: Mapping[str, Any]) -> Figure:
    """Draws what ``rate.read`` found."""
    figure = new_figure(8, 7.6)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.25, 1))
    _draw_delays(figure.add_subplot(grid[0, :]), boundary["by_delay"])
    first = figure.add_subplot(grid[1, 0])
    panels = (first, figure.add_subplot(grid[1, 1], sharey=first))
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
        f"Largest stable K on a wall: behind the coupling is a tool of {1e-3 * WALL_MASS:g} t\n"
        f"method 'implicit', device damping b = {DEVICE_DAMPING:g} N s/m",
        fontsize="medium",
    )
    figure.legend(
        handles=handles,
        title=f"lower panels: T = {1e3 * UNEVEN_PERIOD:g} ms, B = 0",
        title_fontsize="small",
        loc="outside lower center",
        ncols=2,
        fontsize="small",
        frameon=False,
    )
    return figure


def _draw_delays(axes: Axes, by_delay: Mapping[str, Any]) -> None:
    # one hue, darker the later: a delay is a quantity, and verdicts own the other colours
    shade = matplotlib.colormaps["Blues_r"]
    for delay, mine in by_delay.items():
        colour, period = shade(0.65 * int(delay) / (DELAYS - 1)), 1e3 * np.array(mine["period"])
        samples = "sample" if delay == "1" else "samples"
        label = f"bound, delay of {delay} {samples}"
        axes.loglog(period, mine["predicted"], color=colour, label=label)
        axes.plot(period, _drawable(mine["measured"]), "o", color=colour, mfc="white", ms=5)
    if by_delay:
        axes.plot([], [], "o", color="black", mfc="white", label="measured: worst hand")
        axes.legend(fontsize="small")
    else:
        say_missing(axes)
    axes.set_xlabel("period T (ms)")
    ticks = (0.1, 0.2, 0.5, 1, 2, 5)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel("largest stable K (N/m)")
    axes.set_title(f"even ticks, B = {DAMPING:g} N s/m", fontsize="medium")
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
