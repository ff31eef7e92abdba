"""What a chart leaves in its folder: pictures, page, table and JSON."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, select_autoescape
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from hapticbridge.errors import StudyError
from hapticbridge.files import finite_or_null
from hapticbridge.lab.chart.chart import Chart, Measurement, Order
from hapticbridge.lab.chart.setting import who
from hapticbridge.lab.chart.workload import Panel, Verdict
from hapticbridge.lab.folder import prepared_folder
from hapticbridge.plotting import new_figure, write_picture
from hapticbridge.run_description import versions

RATE = 1000.0
"""Hz that is asked for."""

JND = 1.0
"""Error in just noticeable differences that is allowed."""

SHARE = 0.5
"""Share of a core that the simulation may take; the rest is for the device and for waking up."""

ALIKE = 0.05
"""Relative difference of two errors that decides nothing, no unit: where they differ by more, so do
the two digits that are said of them."""

ALONE = " No other time step bears this out, so it may be luck."

TOLERANCE = 1e-9
"""Relative: 1/(1 ms) is 1000 Hz but for rounding."""


def recommended(points: Sequence[Measurement]) -> Measurement | None:
    """Returns the point to use, None where there is none.

    Of the points at ``RATE`` or above, with an error below ``JND`` here and at every smaller step,
    a passive environment, a solver that runs to its tolerance, at most ``SHARE`` of a core, an
    error that can be compared with others' (``Measurement.is_comparable``) and no hazard on a real
    device (``Method.hazard``): those that a second step bears out, if there are any; of them the
    cheapest; of those whose spread of cost meets its own, the most accurate; and where errors are
    the same within ``ALIKE``, one with the usual contacts.
    """
    fit = [each for each in points if _is_fast(each) and not _objections(each, points)]
    if not fit:
        return None
    fit = [each for each in fit if is_borne_out(each, points)] or fit
    cheapest = min(fit, key=lambda each: each.cost.median)
    alike = [each for each in fit if each.cost.low <= cheapest.cost.high]
    least = min(each.score.felt for each in alike)
    best = [each for each in alike if each.score.felt <= (1 + ALIKE) * least]
    return min(best, key=lambda each: (not each.is_usual, each.score.felt, each.cost.median))


def recommendation(points: Sequence[Measurement], machine: str, *, is_truth: bool = True) -> str:
    """Says what to use and why nothing better, or which point is nearest and what is wrong with it.

    Args:
        points: Of one panel.
        machine: In words.
        is_truth: Whether errors are counted from the truth (``Panel.is_truth``); if not, it says
            that they are only the distance from each method's own limit.
    """
    best = recommended(points)
    goal = f"For {RATE / 1000:g} kHz on this machine ({machine}) and an error below one JND"
    if not is_truth:
        goal += " (counted from the method's own limit at small steps, not from the truth)"
    if best is not None:
        alone = "" if is_borne_out(best, points) else ALONE
        return (
            f"{goal}, use {best.setting.label}: {_numbers(best)}.{alone}"
            f"{_passed_over(best, points)}"
        )
    fast = [each for each in points if _is_fast(each) and np.isfinite(each.score.felt)]
    if not fast:
        return f"{goal}, nothing was tried that runs at this rate."
    nearest = min(fast, key=lambda each: (len(_objections(each, points)), each.score.felt))
    return (
        f"{goal}, no point does it all. Nearest is {nearest.setting.label}: {_numbers(nearest)}; "
        f"but {' and '.join(_objections(nearest, points))}."
    )


def is_borne_out(each: Measurement, points: Sequence[Measurement]) -> bool:
    """Returns whether another time step, all else alike, has an error below ``JND`` as well.

    What was tried at one step alone may be right by luck.
    """

    def settings_but_steps(point: Measurement) -> tuple[object, ...]:
        setting = point.setting
        return setting.method.name, setting.engine, setting.contact, setting.iterations

    return any(
        other.score.felt < JND
        and other.setting.timestep != each.setting.timestep
        and settings_but_steps(other) == settings_but_steps(each)
        for other in points
    )


def _is_fast(each: Measurement) -> bool:
    return each.setting.period * RATE <= 1 + TOLERANCE


def steady_error(each: Measurement, points: Sequence[Measurement]) -> float:
    """Returns the largest error in JND at this and at every smaller step, all else alike.

    An error that grows again when the step shrinks was small by luck.
    """
    setting = each.setting
    alike = [
        other.score.felt
        for other in points
        if (other is each or other.setting.period < setting.period)
        and replace(other.setting, period=setting.period) == setting
    ]
    return max(alike, default=each.score.felt)


def _objections(each: Measurement, points: Sequence[Measurement]) -> list[str]:
    """Returns what speaks against a point, in words."""
    found = []
    steady = steady_error(each, points)
    if not each.score.felt < JND:
        found.append(f"its error is {each.score.felt:.2g} JND")
    elif not steady < JND:
        found.append(f"its error grows to {steady:.2g} JND at a smaller step, so it is luck")
    if not each.is_comparable:
        found.append(
            f"its own limit lies {each.limit_apart:.2g} JND from what most methods converge to"
        )
    if each.setting.iterations is not None:
        found.append("its solver is cut short")
    if not each.is_sound:
        created = each.score.created
        more = f" ({created:.2g} J created)" if created > 0 and np.isfinite(created) else ""
        found.append(f"its environment is {each.score.verdict}{more}")
    if each.cost.median > SHARE:
        found.append(f"it takes {100 * each.cost.median:.0f} % of a core")
    if each.setting.method.hazard:
        found.append("it may kick on a real device")
    return found


def _passed_over(best: Measurement, points: Sequence[Measurement]) -> str:
    """Says why the most accurate of the points that cost no more and err less was not taken.

    As on the front, a weld and a tool that is where the handle is are left out: they render another
    coupling, and a small distance from their own limit would be no merit.
    """
    better = [
        each
        for each in points
        if _is_fast(each)
        and each.setting.method.has_law
        and each.cost.median <= best.cost.median
        and (1 + ALIKE) * each.score.felt < best.score.felt
        and _objections(each, points)
    ]
    if not better:
        return ""
    other = min(better, key=lambda each: each.score.felt)
    return (
        f" {other.setting.label} would cost no more and err less ({other.score.felt:.2g} JND), but "
        f"{' and '.join(_objections(other, points))}."
    )


def _numbers(each: Measurement) -> str:
    tick = 1e6 * each.cost.median * each.setting.period
    return (
        f"an error of {each.score.felt:.2g} JND at {tick:.3g} µs a tick, "
        f"{100 * each.cost.median:.2g} % of a core"
    )


FIGURE_WIDTH, FIGURE_HEIGHT = 8.0, 5.6
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
    figure = new_figure(FIGURE_WIDTH, FIGURE_HEIGHT * len(panels))
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


PAGE_WIDTH, PAGE_HEIGHT = 860, 420
"""Of a panel's picture in pixels."""

LEFT, RIGHT, TOP, BOTTOM = 60, 12, 12, 46
"""Margins in pixels, for the axes' numbers and names."""

SHAPES: dict[Verdict, str] = {
    "strict": "disc",
    "within slack": "ring",
    "active": "triangle",
    "lost contact": "plus",
    "diverged": "cross",
    "failed": "wedge",
    "not metered": "square",
}
"""The drawn marks, as in the picture."""


@dataclass(frozen=True, slots=True)
class Spot:
    """A point on the page: where it is drawn in pixels, how, and what it says of itself."""

    x: float
    y: float
    shape: str
    colour: str
    name: str
    is_usual: bool
    is_comparable: bool
    told: str


@dataclass(frozen=True, slots=True)
class Tick:
    """A line across an axis, in pixels, with its number."""

    place: float
    label: str


@dataclass(frozen=True, slots=True)
class Scale:
    """A logarithmic axis.

    Attributes:
        low: Least value.
        high: Largest.
        start: Where ``low`` is, in pixels.
        end: Where ``high`` is.
    """

    low: float
    high: float
    start: float
    end: float

    def at(self, value: float) -> float:
        """Returns where a value is, in pixels."""
        share = math.log(value / self.low) / math.log(self.high / self.low)
        return round(self.start + share * (self.end - self.start), 1)

    def ticks(self) -> list[Tick]:
        """Returns a tick for every power of ten within the axis; on a short one 2 and 5 too."""
        first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        steps = (1, 2, 5) if self.high < NARROW * self.low else (1,)
        values = [step * 10.0**n for n in range(first, last + 1) for step in steps]
        return [Tick(self.at(v), f"{v:g}") for v in values if self.low <= v <= self.high]

    @classmethod
    def around(cls, values: list[float], start: float, end: float) -> Scale:
        """Returns an axis that holds values > 0 with some room."""
        low, high = min(values) / 1.5, max(values) * 1.5
        return cls(low, high, start, end)


@dataclass(frozen=True, slots=True)
class PanelPage:
    """What the page shows of a panel."""

    panel: Panel
    spots: list[Spot]
    lines: list[tuple[str, str, str]]
    front_line: str
    star: tuple[float, float] | None
    across: list[Tick]
    upwards: list[Tick]
    jnd: float
    recommendation: str
    front: list[dict[str, str]]
    orders: dict[str, Order]


def panel_page(chart: Chart, panel: Panel) -> PanelPage:
    """Lays a panel out."""
    points, colours = chart.of(panel), colours_of(chart)
    costs = {id(each): drawn_cost(each, points) for each in points}
    across = Scale.around(list(costs.values()), LEFT, PAGE_WIDTH - RIGHT)
    upwards = Scale.around([JND, *map(drawn_error, points)], PAGE_HEIGHT - BOTTOM, TOP)

    def place(each: Measurement) -> tuple[float, float]:
        return across.at(costs[id(each)]), upwards.at(drawn_error(each))

    def polyline(chosen: list[Measurement]) -> str:
        return " ".join(f"{x},{y}" for x, y in map(place, chosen))

    spots = [
        Spot(
            *place(each),
            shape=SHAPES[each.score.verdict],
            colour=colours[who(each.setting)],
            name=who(each.setting),
            is_usual=each.is_usual,
            is_comparable=each.is_comparable,
            told=described(each),
        )
        for each in points
    ]
    lines = [
        (name, colour, polyline([p for p in points if who(p.setting) == name and p.is_usual]))
        for name, colour in colours.items()
    ]
    front = chart.front(panel)
    stairs = [f"{x},{y}" for x, y in map(place, front[:1])]
    for before, after in pairwise(map(place, front)):
        stairs += [f"{after[0]},{before[1]}", f"{after[0]},{after[1]}"]
    best = recommended(points)
    return PanelPage(
        panel=panel,
        spots=spots,
        lines=lines,
        front_line=" ".join(stairs),
        star=None if best is None else place(best),
        across=across.ticks(),
        upwards=upwards.ticks(),
        jnd=upwards.at(JND),
        recommendation=recommendation(points, chart.machine, is_truth=panel.is_truth),
        front=[
            {
                "setting": each.setting.label,
                "cost": f"{each.cost.median:.3g} ({each.cost.low:.3g} to {each.cost.high:.3g})",
                "ratio": f"{each.cost.ratio:.3g} "
                f"({each.cost.ratio_low:.3g} to {each.cost.ratio_high:.3g})",
                "error": f"{each.score.felt:.3g}",
                "verdict": MARKS[each.score.verdict][2],
            }
            for each in front
        ],
        orders=chart.orders(panel),
    )


def described(each: Measurement) -> str:
    """Says everything of a point, a line each."""
    score, cost = each.score, each.cost
    said = [
        each.setting.label,
        f"error {score.felt:.3g} JND" if math.isfinite(score.felt) else score.reason or "no error",
    ]
    if math.isfinite(cost.median):
        said += [
            f"cost {cost.median:.3g} s per s ({cost.low:.3g} to {cost.high:.3g}), "
            f"{1e6 * cost.median * each.setting.period:.3g} µs a tick",
            f"{cost.ratio:.3g} times the baseline ({cost.ratio_low:.3g} to {cost.ratio_high:.3g})",
        ]
    else:
        said.append("not timed: it failed in its first step, and is drawn with the dearest point")
    numbers = (
        ("force", score.force_rms, 1.0, "N RMS"),
        ("force, peak", score.force_peak, 1.0, "N"),
        ("torque", score.torque_rms, 1e3, "mN m RMS"),
        ("position, peak", score.position_peak, 1e6, "µm"),
        ("angle, peak", score.angle_peak, 1e3, "mrad"),
        ("static stiffness", score.stiffness, 100.0, "%"),
        ("energy", score.energy, 1e3, "mJ"),
        ("created", score.created, 1e3, "mJ"),
    )
    said += [
        f"{name} {factor * value:.3g} {unit}"
        for name, value, factor, unit in numbers
        if math.isfinite(value)
    ]
    if not each.is_comparable:
        said.append(f"its own limit lies {each.limit_apart:.2g} JND from what most converge to")
    return "\n".join([*said, MARKS[score.verdict][2]])


def chart_page(chart: Chart) -> str:
    """Returns the page: no file but itself, no network."""
    environment = Environment(
        loader=PackageLoader("hapticbridge", "templates"),
        autoescape=select_autoescape(),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    verdicts = dict.fromkeys(each.score.verdict for each in chart.measurements)
    return environment.get_template("chart.html").render(
        chart=chart,
        panels=[panel_page(chart, panel) for panel in chart.workload.panels],
        colours=colours_of(chart),
        marks=[(SHAPES[verdict], MARKS[verdict][2]) for verdict in verdicts],
        size=(PAGE_WIDTH, PAGE_HEIGHT),
        margins=(LEFT, RIGHT, TOP, BOTTOM),
        edges=(FLOOR, CEILING),
        pale=not all(each.is_comparable for each in chart.measurements),
    )


PICTURES = ("png", "svg")
ENDINGS = (*PICTURES, "csv", "json", "html")


@dataclass(frozen=True, slots=True)
class ChartFiles:
    """Paths by ending, and what the chart says.

    Attributes:
        paths: By ending, of ``ENDINGS``.
        said: What is in the JSON file.
    """

    paths: Mapping[str, Path]
    said: Mapping[str, Any]


def prepared_files(folder: Path, name: str, endings: Sequence[str] = ENDINGS) -> dict[str, Path]:
    """Makes the folder and proves that every file can be written, before anything is computed.

    Args:
        folder: To write into.
        name: Of the files, without ending.
        endings: Of the files.

    Raises:
        StudyError: It cannot, or a scene of this name lies there, whose hand path is ``NAME.csv``.
    """
    if (folder / f"{name}.xml").exists():
        raise StudyError(
            f"'{folder}' holds the scene {name}.xml, and its hand path {name}.csv would be "
            "overwritten; name another folder"
        )
    files = {ending: f"{name}.{ending}" for ending in endings}
    prepared_folder(folder, files.values())
    return {ending: folder / file for ending, file in files.items()}


def write_chart(chart: Chart, paths: Mapping[str, Path]) -> ChartFiles:
    """Writes everything.

    Args:
        chart: What was measured.
        paths: By ending, as ``prepared_files`` returned them.

    Raises:
        HapticBridgeError: A file cannot be written.
    """
    said = summary_of(chart)
    texts = {
        "csv": table_of(chart),  # first: it is what cost the time
        "json": json.dumps(said, indent=2, allow_nan=False) + "\n",
        "html": chart_page(chart),
    }
    write_files(paths, texts, draw_chart(chart))
    return ChartFiles(dict(paths), said)


def write_files(paths: Mapping[str, Path], texts: Mapping[str, str], figure: Figure) -> None:
    """Writes texts by ending, in their order, and then the picture as PNG and SVG.

    Raises:
        HapticBridgeError: A file cannot be written.
    """
    for ending, text in texts.items():
        try:
            paths[ending].write_text(text, encoding="utf-8", newline="")
        except OSError as error:
            raise StudyError(f"cannot write '{paths[ending]}': {error.strerror}") from None
    for ending in PICTURES:
        write_picture(figure, paths[ending])


def csv_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Returns rows as CSV with a header; a row that lacks a column leaves it empty."""
    text = io.StringIO()
    names = dict.fromkeys(name for row in rows for name in row)
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def table_of(chart: Chart) -> str:
    """Returns a CSV text: a row per point and panel, every setting in it."""
    fronts = {
        panel.key: {id(each) for each in chart.front(panel)} for panel in chart.workload.panels
    }
    rows = [
        each.cells(chart.workload.name, chart.workload.coupling)
        | {"on_front": int(id(each) in fronts[each.panel]), "machine": chart.machine}
        for each in chart.measurements
    ]
    return csv_text(rows)


def summary_of(chart: Chart) -> dict[str, Any]:
    """Returns what the chart says, for JSON: numbers that are not finite become None."""
    panels = [
        {
            "panel": panel.key,
            "title": panel.title,
            "reference": panel.reference,
            "reference_is_truth": panel.is_truth,
            "recommendation": recommendation(
                chart.of(panel), chart.machine, is_truth=panel.is_truth
            ),
            "front": [
                {
                    "setting": each.setting.label,
                    "cost": each.cost.median,
                    "error": each.score.felt,
                    "verdict": each.score.verdict,
                }
                for each in chart.front(panel)
            ],
            "convergence_orders": {
                name: asdict(order) | {"is_settled": order.is_settled}
                for name, order in chart.orders(panel).items()
            },
        }
        for panel in chart.workload.panels
    ]
    points = [
        each.cells(chart.workload.name, chart.workload.coupling) for each in chart.measurements
    ]
    said = {
        "workload": chart.workload.name,
        "about": chart.workload.about,
        "machine": chart.machine,
        "versions": versions(),
        "baseline": chart.baseline,
        "notes": list(chart.notes),
        "skipped": chart.skipped,
        "engines": {
            name: {
                "version": engine.version,
                "settings": {key: each._asdict() for key, each in engine.settings.items()},
            }
            for name, engine in chart.engines.items()
        },
        "panels": panels,
        "points": points,
    }
    found: dict[str, Any] = finite_or_null(said)
    return found
