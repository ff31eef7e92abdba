"""The picture, the table and the words of cost against work."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hapticbridge.check.cost import TICK_SHARE
from hapticbridge.errors import StudyError
from hapticbridge.picture import new_figure, write_picture
from hapticbridge.study.chart.tick_times import USUAL
from hapticbridge.study.chart.work import Work, WorkChart
from hapticbridge.study.chart.work_scenes import FAMILIES, Family

RATE = 1000.0
"""Hz that a paragraph asks for."""

COLOURS = ("#1a5fb4", "#e08a00", "#2e8b57", "#b3261e")


def draw_work(chart: WorkChart) -> Figure:
    """Draws the tick's time over the count, a panel for each way to grow."""
    figure = new_figure(8, 7)
    panels = figure.subplots(2, 2)
    for axes, family in zip(panels.ravel(), FAMILIES, strict=True):
        _draw_family(axes, chart, family)
    figure.suptitle(f"Processor time of a tick at 1 kHz\n{chart.machine}", fontsize="medium")
    return figure


def _draw_family(axes: Axes, chart: WorkChart, family: Family) -> None:
    axes.set_xlabel(f"{family.unit}: {family.about}", fontsize="x-small")
    if not chart.variants(family):
        axes.set_title("not measured", fontsize="small")
        return
    for variant, colour in zip(chart.variants(family), COLOURS, strict=False):
        points = chart.of(family, variant)
        sizes = [each.size for each in points]
        exponent = chart.exponent(family, variant)
        told = variant.name if math.isnan(exponent) else f"{variant.name}: n^{exponent:.2f}"
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
    axes.legend(fontsize="x-small", loc="lower right")


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
            f"{_grows(chart.exponent(family, USUAL))}; {most}"
        )
        said += [_against(chart, family, last)] if len(chart.variants(family)) > 1 else []
    return ". ".join(each[0].upper() + each[1:] for each in said if each) + "."


def _grows(exponent: float) -> str:
    return "" if math.isnan(exponent) else f" (growing as n^{exponent:.2f})"


def _against(chart: WorkChart, family: Family, last: Work) -> str:
    """Says what islands and sleep are worth at the largest size."""
    found = {
        variant.name: chart.of(family, variant)[-1].time.median
        for variant in chart.variants(family)
    }
    names = list(found)
    if len(names) < 4:
        return ""
    islands, sleep = found[names[1]] / found[names[0]], found[names[2]] / found[names[3]]
    return (
        f"without islands a tick with {last.size} {family.unit} takes {islands:.2f} times as long, "
        f"and sleep, which a bridge refuses, would make MuJoCo's step {sleep:.3g} times as fast"
    )


def write_work(chart: WorkChart, folder: Path) -> tuple[dict[str, Path], dict[str, Any]]:
    """Writes ``work.png``, ``.csv`` and ``.json``.

    Returns:
        Paths by ending, and what is in the JSON file.

    Raises:
        HapticBridgeError: A file cannot be written.
    """
    paths = {ending: folder / f"work.{ending}" for ending in ("png", "csv", "json")}
    rows = [_row(each) | {"machine": chart.machine} for each in chart.points]
    table = io.StringIO()
    writer = csv.DictWriter(table, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    exponents = {
        family.name: {
            variant.name: None if math.isnan(p := chart.exponent(family, variant)) else p
            for variant in chart.variants(family)
        }
        for family in FAMILIES
    }
    said = {
        "machine": chart.machine,
        "paragraph": paragraph(chart),
        "exponents": exponents,
        "points": rows,
    }
    texts: Mapping[str, str] = {
        "csv": table.getvalue(),
        "json": json.dumps(said, indent=2, allow_nan=False) + "\n",
    }
    for ending, text in texts.items():
        try:
            paths[ending].write_text(text, encoding="utf-8", newline="")
        except OSError as error:
            raise StudyError(f"cannot write '{paths[ending]}': {error.strerror}") from None
    write_picture(draw_work(chart), paths["png"])
    return paths, said


def _row(each: Work) -> dict[str, object]:
    row = asdict(each)
    spread = row.pop("time")
    return row | {f"time_{name}": value for name, value in spread.items()}
