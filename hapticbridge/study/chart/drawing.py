"""The picture of a chart: cost across, error upwards, the mark says what became of the run."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from hapticbridge.plotting import new_figure
from hapticbridge.study.chart.chart import Chart
from hapticbridge.study.chart.convergence import Order
from hapticbridge.study.chart.measurement import Measurement
from hapticbridge.study.chart.recommendation import JND, recommended
from hapticbridge.study.chart.score import Verdict
from hapticbridge.study.chart.setting import who
from hapticbridge.study.chart.workload import Panel

WIDTH, HEIGHT = 8.0, 5.6
"""In inches: 800 pixels wide, a panel each."""

FLOOR = 1e-4
"""Error in JND below which all points are drawn at the lower edge: nobody could tell."""

CEILING = 1e3
"""Error in JND above which they are drawn at the upper edge, with those that diverged."""

NARROW = 30.0
"""Ratio of the ends of an axis up to which more than the powers of ten are named, no unit."""

PALE = 0.2
"""Opacity of points that cannot be compared with those of other methods, no unit."""

UNTIMED = 1.0
"""Cost in s per s at which points are drawn where none was timed."""

MARKS: dict[Verdict, tuple[str, bool, str]] = {
    "strict": ("o", True, "passive"),
    "within slack": ("o", False, "passive within the slack"),
    "active": ("^", True, "created energy"),
    "lost contact": ("P", True, "lost contact"),
    "diverged": ("X", True, "diverged (at the upper edge)"),
    "failed": ("v", True, "the engine failed (at the upper edge)"),
    "not metered": ("s", True, "another engine: energy not metered"),
}
"""Mark, whether it is filled, and what it means."""

COLOURS = (
    "#1a5fb4", "#2e8b57", "#b3261e", "#e08a00", "#7b4fa6", "#008b8b", "#8c564b", "#d1578f",
    "#6b6b00", "#404040", "#4aa3ff", "#9bbb59", "#ff7f50", "#c71585",
    "#00c5a0", "#a0522d", "#5f6b8a", "#d4b000",
)  # fmt: skip


def colours_of(chart: Chart) -> dict[str, str]:
    """Returns a colour for every method and engine."""
    names = list(dict.fromkeys(who(each.setting) for each in chart.measurements))
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}


def drawn_error(each: Measurement) -> float:
    """Returns where a point is drawn, in JND: held within the picture's edges."""
    felt = each.score.felt
    return float(np.clip(felt, FLOOR, CEILING)) if np.isfinite(felt) else CEILING


def drawn_cost(each: Measurement, points: Sequence[Measurement]) -> float:
    """Returns where a point is drawn, in s per s: with the dearest where it was not timed.

    An engine that fails in its first step has no cost, and is on the chart all the same.
    """
    if math.isfinite(each.cost.median):
        return each.cost.median
    costs = (other.cost.median for other in points)
    return max((cost for cost in costs if math.isfinite(cost)), default=UNTIMED)


def draw_chart(chart: Chart) -> Figure:
    """Draws every panel of a chart."""
    panels = chart.workload.panels
    figure = new_figure(WIDTH, HEIGHT * len(panels))
    colours = colours_of(chart)
    for axes, panel in zip(np.atleast_1d(figure.subplots(len(panels), 1)), panels, strict=True):
        _draw_panel(axes, chart, panel, colours)
    figure.suptitle(
        f"{chart.workload.name}: {chart.workload.about}\n{chart.machine}",
        fontsize="small",
        parse_math=False,
    )
    return figure


def _draw_panel(axes: Axes, chart: Chart, panel: Panel, colours: dict[str, str]) -> None:
    points, orders = chart.of(panel), chart.orders(panel)
    for name, colour in colours.items():
        mine = [each for each in points if who(each.setting) == name]
        if not mine:
            continue
        axes.plot([], [], "-", color=colour, lw=2, label=_named(name, mine, orders.get(name)))
        line = [each for each in mine if each.is_usual]
        axes.plot(
            [drawn_cost(each, points) for each in line],
            [drawn_error(each) for each in line],
            "-",
            color=colour,
            lw=0.8,
            alpha=0.6,
        )
        for each in mine:
            _draw_point(axes, each, drawn_cost(each, points), colour)
    _draw_front(axes, chart.front(panel))
    best = recommended(points)
    if best is not None:
        axes.plot(
            best.cost.median, drawn_error(best), "*", ms=13, mfc="none", mec="black", mew=1.3,
            label="recommended for 1 kHz", zorder=5,
        )  # fmt: skip
    axes.axhline(JND, color="black", ls="--", lw=0.9)
    axes.annotate(
        "one just noticeable difference", (0.995, JND), xycoords=("axes fraction", "data"),
        ha="right", va="bottom", fontsize="x-small",
    )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    low, high = axes.get_ylim()
    axes.yaxis.set_minor_formatter("{x:g}" if high < NARROW * low else NullFormatter())
    axes.set_xlabel("cost: processor seconds per simulated second (1 = real time on one core)")
    axes.set_ylabel("error (just noticeable differences)")
    kind = "error against" if panel.is_truth else "NOT the truth: difference from"
    title = f"{panel.title}\n{kind} {panel.reference}"
    axes.set_title(_wrapped(title), fontsize="small", parse_math=False)
    axes.grid(visible=True, which="major", alpha=0.3)
    if not all(each.is_usual for each in points):
        told = "small: substeps, contacts, solver"
        axes.plot([], [], "o", color="grey", ms=3.5, label=told)
    for verdict in dict.fromkeys(each.score.verdict for each in points):
        mark, is_filled, told = MARKS[verdict]
        axes.plot(
            [], [], mark, color="grey", mfc="grey" if is_filled else "white", ms=6, label=told
        )
    for told in _explained(points, orders.values()):
        axes.plot([], [], " ", label=told)
    axes.legend(fontsize="x-small", loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def _named(name: str, points: Sequence[Measurement], order: Order | None) -> str:
    """Returns a legend's words for a method: its order, and its limit where that is another."""
    told = [] if order is None else [order.words]
    if not all(each.is_comparable for each in points):
        told.append(f"limit {points[0].limit_apart:.2g} off")
    return f"{name} ({', '.join(told)})" if told else name


def _explained(points: Sequence[Measurement], orders: Collection[Order]) -> list[str]:
    """Returns what the words and edges of a panel mean, for those that it has."""
    said = []
    if any(order.is_level for order in orders):
        said.append("level: smaller steps gain nothing")
    if not all(order.is_settled for order in orders):
        said.append("order ?: not settled at these steps")
    if not all(each.is_comparable for each in points):
        said.append(
            "pale: nearer to its own limit than\n"
            "that is to most others' (off, in JND):\nnot comparable"
        )
    if any(each.score.felt < FLOOR for each in points):
        said.append(f"at the lower edge: {FLOOR:g} JND or less")
    return said


def _draw_point(axes: Axes, each: Measurement, place: float, colour: str) -> None:
    mark, is_filled, _ = MARKS[each.score.verdict]
    cost = each.cost
    axes.errorbar(
        place,
        drawn_error(each),
        xerr=np.nan_to_num([[cost.median - cost.low], [cost.high - cost.median]]),
        fmt=mark,
        color=colour,
        mfc=colour if is_filled else "white",
        ms=5.5 if each.is_usual else 3.5,
        elinewidth=0.6,
        alpha=0.9 if each.is_comparable else PALE,
    )


def _draw_front(axes: Axes, front: Sequence[Measurement]) -> None:
    if not front:
        return
    axes.step(
        [each.cost.median for each in front],
        [drawn_error(each) for each in front],
        where="post",
        color="black",
        lw=1.2,
        label="Pareto front (passive)",
    )


def _wrapped(text: str, width: int = 92) -> str:
    lines = []
    for paragraph in text.split("\n"):
        line = ""
        for word in paragraph.split():
            if line and len(line) + len(word) >= width:
                lines.append(line)
                line = word
            else:
                line = f"{line} {word}".strip()
        lines.append(line)
    return "\n".join(lines)
