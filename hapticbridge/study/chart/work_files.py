"""The picture, the table and the words of cost against work."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hapticbridge.check.cost import TICK_SHARE
from hapticbridge.plotting import new_figure
from hapticbridge.study.chart.files import PICTURES, csv_text, write_files
from hapticbridge.study.chart.tick_times import USUAL, VARIANTS
from hapticbridge.study.chart.work import Growth, Work, WorkChart
from hapticbridge.study.chart.work_scenes import FAMILIES, Family

RATE = 1000.0
"""Hz that a paragraph asks for."""

WORK_ENDINGS = (*PICTURES, "csv", "json")
"""Of the files; there is no page."""

HOLDS = f"A rate is held where 99 of 100 ticks take at most {100 * TICK_SHARE:g} % of its period"
"""What the paragraph means by that."""

ROOM = 15.0
"""How far the axis of time goes beyond half of a tick, a ratio without unit: the legend stands
above the curves."""

COLOURS = ("#1a5fb4", "#e08a00", "#2e8b57", "#b3261e")


def draw_work(chart: WorkChart) -> Figure:
    """Draws the tick's time over the count, a panel for each way to grow."""
    figure = new_figure(8, 7)
    panels = figure.subplots(2, 2, sharey=True)
    for axes, family in zip(panels.ravel(), FAMILIES, strict=True):
        _draw_family(axes, chart, family)
    figure.suptitle(
        "Processor time of a tick at 1 kHz; n^p (least and largest p between two sizes)\n"
        f"{chart.machine}",
        fontsize="medium",
        parse_math=False,
    )
    return figure


def _draw_family(axes: Axes, chart: WorkChart, family: Family) -> None:
    axes.set_xlabel(f"{family.unit}: {family.about}", fontsize="x-small")
    if not chart.variants(family):
        axes.set_title("not measured", fontsize="small")
        return
    for variant, colour in zip(chart.variants(family), COLOURS, strict=False):
        points = chart.of(family, variant)
        sizes = [each.size for each in points]
        growth = chart.growth(family, variant)
        told = variant.name if growth is None else f"{variant.name}: {_power(growth)}"
        axes.plot(
            sizes, [1e6 * p.time.median for p in points], "o-", color=colour, ms=4, label=told
        )
        axes.plot(sizes, [1e6 * p.time.p99 for p in points], ":", color=colour, lw=1)
    axes.plot([], [], ":", color="grey", label="99th percentile")
    axes.axhline(1e6 * TICK_SHARE / RATE, color="black", ls="--", lw=0.9)
    axes.annotate(
        "half of a tick at 1 kHz", (0.02, 1e6 * TICK_SHARE / RATE), va="bottom",
        xycoords=("axes fraction", "data"), fontsize="x-small",
    )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylabel("processor time of a tick (µs)", fontsize="small")
    axes.grid(visible=True, alpha=0.3)
    low, high = axes.get_ylim()
    axes.set_ylim(low, max(high, ROOM * 1e6 * TICK_SHARE / RATE))
    axes.legend(fontsize="xx-small", loc="upper left")


def paragraph(chart: WorkChart) -> str:
    """Says how the cost grows, and how much fits into a tick at 1 kHz."""
    said = []
    for family in FAMILIES:
        points = chart.of(family, USUAL)
        if not points:
            continue
        fit = [each.size for each in points if each.rate >= RATE]
        last = points[-1]
        most = f"up to {max(fit)} hold 1 kHz" if fit else "none holds 1 kHz"
        said.append(
            f"{family.unit}: {1e6 * points[0].time.median:.3g} µs a tick for {points[0].size}, "
            f"{1e6 * last.time.median:.3g} µs for {last.size}"
            f"{_grows(chart.growth(family, USUAL))}; {most}"
        )
        said += [_against(chart, family, last)] if len(chart.variants(family)) > 1 else []
    told = [each[0].upper() + each[1:] for each in said if each]
    return ". ".join([*told, HOLDS]) + "."


def _grows(growth: Growth | None) -> str:
    return "" if growth is None else f" (growing as {_power(growth)} from {growth.start:g} on)"


def _power(growth: Growth) -> str:
    return f"n^{growth.exponent:.2f} ({growth.low:.2f} to {growth.high:.2f})"


def _against(chart: WorkChart, family: Family, last: Work) -> str:
    """Says what islands and sleep are worth at the largest size."""
    found = [chart.of(family, variant)[-1] for variant in chart.variants(family)]
    if len(found) < len(VARIANTS):
        return ""
    usual, undivided, bare, asleep = found
    return (
        f"without islands a tick with {last.size} {family.unit} takes {_ratio(undivided, usual)} "
        "times as long, and sleep, which a bridge refuses, would make MuJoCo's step "
        f"{_ratio(bare, asleep)} times as fast"
    )


def _ratio(slow: Work, fast: Work) -> str:
    """Returns a ratio of medians with the least and the largest that the rounds leave possible."""
    least, most = slow.low / fast.high, slow.high / fast.low
    return f"{slow.time.median / fast.time.median:.3g} ({least:.3g} to {most:.3g})"


def write_work(chart: WorkChart, paths: Mapping[str, Path]) -> dict[str, Any]:
    """Writes picture, table and JSON; returns what is in the JSON file.

    Args:
        chart: What was measured.
        paths: By ending, as ``prepared_files`` returned them.

    Raises:
        HapticBridgeError: A file cannot be written.
    """
    rows = [_row(each) | {"machine": chart.machine} for each in chart.points]
    growths = {
        family.name: {
            variant.name: None if growth is None else asdict(growth)
            for variant in chart.variants(family)
            for growth in (chart.growth(family, variant),)
        }
        for family in FAMILIES
    }
    said = {
        "machine": chart.machine,
        "paragraph": paragraph(chart),
        "growth": growths,
        "points": rows,
    }
    texts = {"csv": csv_text(rows), "json": json.dumps(said, indent=2, allow_nan=False) + "\n"}
    write_files(paths, texts, draw_work(chart))
    return said


def _row(each: Work) -> dict[str, object]:
    row = asdict(each)
    spread = row.pop("time")
    return row | {f"time_{name}": value for name, value in spread.items()}
