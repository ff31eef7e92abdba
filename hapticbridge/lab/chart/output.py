"""Output of a chart: recommendation, pictures, table and JSON."""

from __future__ import annotations

import csv
import io
import json
import math
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from hapticbridge.errors import StudyError
from hapticbridge.files import finite_or_null, prepared_folder, writing
from hapticbridge.lab.chart.chart import Chart, Measurement, Order
from hapticbridge.lab.chart.score import PASSIVE, Panel, Verdict
from hapticbridge.lab.chart.setting import OWN, Setting, simulator_name
from hapticbridge.plotting import new_figure, write_picture
from hapticbridge.run.description import versions
from hapticbridge.run.options import DEFAULT_OPTIONS

RATE = 1000.0
"""Rate of the loop in Hz that a recommendation is for: that of most devices."""

DEFAULT = Setting(DEFAULT_OPTIONS.rendering_method, 1.0 / DEFAULT_OPTIONS.loop_rate)
"""Setting of ``hapticbridge run`` without options."""

JND = 1.0
"""Largest error in just noticeable differences."""

SHARE = 0.5
"""Share of a core for the simulation; the rest is for the device and for waking up."""

SPARE = 0.01
"""Share of a core that a cheaper point must save to be preferred: 10 µs of a tick at 1 kHz, which
is less than a wake-up is late. With a smaller share, cost decides where no user can notice it."""

ALIKE = 0.05
"""Relative difference of two errors that is irrelevant, no unit. A larger one changes the two
digits that are printed."""

IMPERCEPTIBLE = 0.1
"""Difference of two errors in JND that is not felt: a tenth of the least that is."""

ALONE = "no other time step bears this out, so it may be luck"

TOLERANCE = 1e-9
"""Relative tolerance of the rate: 1/(1 ms) is 1000 Hz but for rounding."""


def recommended(points: Sequence[Measurement]) -> Measurement | None:
    """Returns the recommended point, None if there is none.

    Candidates run at ``RATE``, with an error below ``JND`` here and at every smaller step, a
    passive environment and a solver that runs to its tolerance. They take at most ``SHARE`` of a
    core. Their error can be compared with others' (``Measurement.is_comparable``), and the method
    has no hazard on a real device (``Method.hazard``).

    Points that a second step confirms come first, if there are any. Of those that take at most
    ``SPARE`` of a core more than the cheapest, the most accurate is chosen. Among errors that agree
    within ``ALIKE`` or ``IMPERCEPTIBLE``, the default of the product is preferred, then a point
    with the usual contacts, then the cheapest.
    """
    fit = [each for each in points if _is_at_rate(each) and not _objections(each, points)]
    if not fit:
        return None
    fit = [each for each in fit if is_borne_out(each, points)] or fit
    cheapest = min(fit, key=lambda each: each.cost.median)
    alike = [each for each in fit if each.cost.low <= cheapest.cost.high + SPARE]
    least = min(each.score.jnd for each in alike)
    worst = max((1 + ALIKE) * least, least + IMPERCEPTIBLE)
    best = [each for each in alike if each.score.jnd <= worst]
    return min(
        best,
        key=lambda each: (
            not _is_default(each.setting),
            not each.is_usual,
            each.cost.median,
        ),
    )


def _is_default(setting: Setting) -> bool:
    """Returns True for the default at any rate of the scene, which the product chooses itself."""
    return replace(setting, scene_ticks=0) == DEFAULT


def recommendation(points: Sequence[Measurement]) -> str:
    """States the recommended point and how to get it, or the nearest one and its faults."""
    best, rate = recommended(points), f"{RATE / 1000:g} kHz"
    if best is not None:
        alone = "" if is_borne_out(best, points) else f"; {ALONE}"
        return f"for {rate}: {_numbers(best)}; {_way_to(best.setting)}{alone}"
    tried = [each for each in points if _is_at_rate(each) and np.isfinite(each.score.jnd)]
    if not tried:
        return f"for {rate}: nothing was tried that runs at this rate"
    nearest = min(tried, key=lambda each: (len(_objections(each, points)), each.score.jnd))
    faults = ", ".join(_objections(nearest, points))
    return f"for {rate}: none; nearest {_numbers(nearest)}: {faults}"


def _way_to(setting: Setting) -> str:
    """Returns the options of 'hapticbridge run' that choose a setting."""
    rate = f"--scene-rate {1 / setting.scene_period:g}" if setting.scene_ticks else ""
    if _is_default(setting):
        return "the default of 'hapticbridge run'" + (f" with {rate}" if rate else "")
    if setting.engine != OWN or setting.iterations is not None:
        return "'hapticbridge run' does not offer it"
    options = [f"--method {setting.method.name}"]
    options += [f"--substeps {setting.substeps}"] if setting.substeps > 1 else []
    options += [rate] if rate else []
    options += ["--contact scene"] if setting.contact_name != DEFAULT.contact_name else []
    return " ".join(options)


def _default_of(points: Sequence[Measurement]) -> Measurement | None:
    return next((each for each in points if each.setting == DEFAULT), None)


def ahead_of_default(points: Sequence[Measurement]) -> list[Measurement]:
    """Returns the points at ``RATE`` that beat the default, cheapest first.

    They are sound, comparable, and render the requested coupling (``Chart.front``), cost no more
    and err less than the default by more than ``ALIKE``.
    """
    default = _default_of(points)
    if default is None:
        return []
    beaten = [
        each
        for each in points
        if _is_at_rate(each)
        and each.is_sound
        and each.is_comparable
        and each.setting.method.has_law
        and each.cost.median <= default.cost.high
        and each.score.jnd * (1 + ALIKE) < default.score.jnd
    ]
    return sorted(beaten, key=lambda each: each.cost.median)


def standing(points: Sequence[Measurement]) -> str:
    """States the numbers of the default at ``RATE``, and the best point that is ahead of it."""
    default = _default_of(points)
    if default is None:
        return ""
    words = f"default: {_numbers(default)}"
    if _objections(default, points):
        words += f": {', '.join(_objections(default, points))}"
    ahead = ahead_of_default(points)
    if not ahead:
        return f"{words}; on the front"
    best = min(ahead, key=lambda each: each.score.jnd)
    hazard = best.setting.method.hazard
    return f"{words}; ahead of it: {_numbers(best)}" + (f", but {hazard}" if hazard else "")


def is_borne_out(each: Measurement, points: Sequence[Measurement]) -> bool:
    """Returns True if another time step, all else equal, has an error below ``JND`` too.

    A setting tried at one step alone may be right by luck.
    """

    def settings_but_steps(point: Measurement) -> tuple[object, ...]:
        setting = point.setting
        return setting.method.name, setting.engine, setting.contact_name, setting.iterations

    return any(
        other.score.jnd < JND
        and other.setting.timestep != each.setting.timestep
        and settings_but_steps(other) == settings_but_steps(each)
        for other in points
    )


def _is_at_rate(each: Measurement) -> bool:
    return abs(each.setting.period * RATE - 1) <= TOLERANCE


def steady_error(each: Measurement, points: Sequence[Measurement]) -> float:
    """Returns the largest error in JND at this and at every smaller step, all else equal.

    An error that grows again when the step shrinks was small by luck.
    """
    setting = each.setting
    alike = [
        other.score.jnd
        for other in points
        if (other is each or other.setting.period < setting.period)
        and replace(other.setting, period=setting.period) == setting
    ]
    return max(alike, default=each.score.jnd)


def _objections(each: Measurement, points: Sequence[Measurement]) -> list[str]:
    """Returns the faults of a point in words."""
    found = []
    steady = steady_error(each, points)
    if not each.score.jnd < JND:
        found.append(f"its error is {each.score.jnd:.2g} JND")
    elif not steady < JND:
        found.append(f"its error grows to {steady:.2g} JND at a smaller step, so it is luck")
    if not each.is_comparable:
        found.append(f"its own limit lies {each.limit_apart:.2g} JND from that of rigid contacts")
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
    elif not each.setting.method.is_rigid:
        found.append("MuJoCo's contacts may create energy in another motion")
    return found


def _numbers(each: Measurement) -> str:
    tick = 1e6 * each.cost.median * each.setting.period
    return (
        f"{each.setting.label} ({each.score.jnd:.2g} JND, {tick:.3g} µs a tick, "
        f"{100 * each.cost.median:.2g} % of a core)"
    )


FIGURE_WIDTH, FIGURE_HEIGHT = 8.0, 5.6
"""Size in inches: 800 pixels wide, one panel each."""

FLOOR = 1e-4
"""Error in JND below which all points are drawn at the lower edge: the difference is
imperceptible."""

CEILING = 1e3
"""Error in JND above which points are drawn at the upper edge, with those that diverged."""

NARROW = 30.0
"""Ratio of the ends of an axis up to which more ticks than the powers of ten have labels, no
unit."""

PALE = 0.2
"""Opacity, without unit, of points that cannot be compared with those of other methods."""

UNTIMED = 1.0
"""Cost in s per s at which points are drawn if no point was timed."""

MARKS: dict[Verdict, tuple[str, bool, str]] = {
    "strict": ("o", True, "passive"),
    "within slack": ("o", False, "passive within the slack"),
    "active": ("X", True, "NOT passive: created energy"),
    "lost contact": ("P", True, "lost contact"),
    "diverged": ("v", True, "diverged (at the upper edge)"),
    "failed": ("^", True, "the engine failed (at the upper edge)"),
    "not metered": ("s", True, "another engine: energy not metered"),
}
"""Marker, True if it is filled, and its meaning. Only passive points are round and have the colour
of their method; the others are ``WARNING``."""

WARNING = "#c00000"
"""Colour of points that are not passive."""


def colours_of(chart: Chart) -> dict[str, Any]:
    """Returns a colour for every method and engine."""
    names = list(dict.fromkeys(simulator_name(each.setting) for each in chart.measurements))
    return {name: colormaps["tab20"](i % 20) for i, name in enumerate(names)}


def drawn_error(each: Measurement) -> float:
    """Returns the ordinate of a point in JND, clipped to the picture's edges."""
    jnd = each.score.jnd
    return float(np.clip(jnd, FLOOR, CEILING)) if np.isfinite(jnd) else CEILING


def drawn_cost(each: Measurement, points: Sequence[Measurement]) -> float:
    """Returns the abscissa of a point in s per s; without a time the largest cost.

    An engine that fails in its first step has no cost, and stays on the chart.
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


def _draw_panel(axes: Axes, chart: Chart, panel: Panel, colours: dict[str, Any]) -> None:
    points, orders = chart.points_of(panel), chart.orders(panel)
    for name, colour in colours.items():
        selected = [each for each in points if simulator_name(each.setting) == name]
        if not selected:
            continue
        axes.plot([], [], "-", color=colour, lw=2, label=_named(name, selected, orders.get(name)))
        line = [each for each in selected if each.is_usual]
        for pair in pairwise(line):
            axes.plot(
                [drawn_cost(each, points) for each in pair],
                [drawn_error(each) for each in pair],
                "-" if all(each.is_sound for each in pair) else ":",
                color=colour,
                lw=0.8,
                alpha=0.6,
            )
        for each in selected:
            _draw_point(axes, each, drawn_cost(each, points), colour)
    _draw_front(axes, chart.front(panel))
    best = recommended(points)
    if best is not None:
        axes.plot(
            best.cost.median, drawn_error(best), "*", ms=13, mfc="none", mec="black", mew=1.3,
            label=f"recommended for 1 kHz: {simulator_name(best.setting)}", zorder=5,
        )  # fmt: skip
        for label in _passed_over(best, chart.front(panel), points):
            axes.plot([], [], " ", label=label)
    axes.axhline(JND, color="black", ls="--", lw=0.9)
    axes.annotate(
        "one just noticeable difference", (0.995, JND), xycoords=("axes fraction", "data"),
        ha="right", va="bottom", fontsize="x-small",
    )  # fmt: skip
    axes.set(xscale="log", yscale="log")
    axes.yaxis.set_major_formatter("{x:g}")
    low, high = axes.get_ylim()
    axes.yaxis.set_minor_formatter("{x:g}" if high < NARROW * low else NullFormatter())
    axes.set(
        xlabel="cost: processor seconds per simulated second (1 = real time on one core)",
        ylabel="error (just noticeable differences)",
    )
    kind = "error against" if panel.is_truth else "NOT the truth: difference from"
    title = "\n".join([panel.title, *textwrap.wrap(f"{kind} {panel.reference}", 92)])
    axes.set_title(title, fontsize="small", parse_math=False)
    axes.grid(visible=True, which="major", alpha=0.3)
    if not all(each.is_usual for each in points):
        label = "small: substeps, contacts, solver"
        axes.plot([], [], "o", color="grey", ms=3.5, label=label)
    for verdict in dict.fromkeys(each.score.verdict for each in points):
        mark, is_filled, label = MARKS[verdict]
        grey = "grey" if verdict in PASSIVE else WARNING
        axes.plot([], [], mark, color=grey, mfc=grey if is_filled else "white", ms=6, label=label)
    for label in _explained(points, orders.values()):
        axes.plot([], [], " ", label=label)
    axes.legend(fontsize="x-small", loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def _passed_over(
    best: Measurement, front: Sequence[Measurement], points: Sequence[Measurement]
) -> list[str]:
    """Returns why a method on the front is not recommended, one legend each."""
    reasons: dict[str, str] = {}
    for each in front:
        found = _objections(each, points) if _is_at_rate(each) else []
        if found and simulator_name(each.setting) != simulator_name(best.setting):
            reasons.setdefault(simulator_name(each.setting), found[-1])
    return [
        textwrap.fill(f"not {name}: {reason}", 34, subsequent_indent="  ")
        for name, reason in reasons.items()
    ]


def _named(name: str, points: Sequence[Measurement], order: Order | None) -> str:
    """Returns a method's legend: its order, and its limit if that differs."""
    remarks = [order.words] if order is not None and order.words else []
    if not all(each.is_comparable for each in points):
        remarks.append(f"limit {points[0].limit_apart:.2g} off")
    return f"{name} ({', '.join(remarks)})" if remarks else name


def _explained(points: Sequence[Measurement], orders: Collection[Order]) -> list[str]:
    """Returns the legends of marks and edges that a panel contains."""
    facts = []
    if any(order.is_level for order in orders):
        facts.append("level: smaller steps gain nothing")
    if not all(each.is_comparable for each in points):
        facts.append(
            "pale: nearer to its own limit than that\n"
            "is to rigid contacts' (off, in JND):\nnot comparable"
        )
    if any(each.score.jnd < FLOOR for each in points):
        facts.append(f"at the lower edge: {FLOOR:g} JND or less")
    return facts


def _draw_point(axes: Axes, each: Measurement, place: float, colour: Any) -> None:
    mark, is_filled, _ = MARKS[each.score.verdict]
    colour = colour if each.is_sound else WARNING
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


PICTURES = ("png", "svg")
ENDINGS = (*PICTURES, "csv", "json")


@dataclass(frozen=True, slots=True)
class ChartFiles:
    """Paths by ending, and the content of the JSON file.

    Attributes:
        paths: Paths by ending, of ``ENDINGS``.
        facts: Content of the JSON file.
    """

    paths: Mapping[str, Path]
    facts: Mapping[str, Any]


def prepared_files(folder: Path, name: str) -> dict[str, Path]:
    """Makes the folder and proves that every file can be written, before anything is computed.

    Args:
        folder: Folder to write into.
        name: Name of the files, without ending.

    Raises:
        StudyError: A file cannot be written, or a scene of this name lies there, whose hand path is
            ``NAME.csv``.
    """
    if (folder / f"{name}.xml").exists():
        raise StudyError(
            f"'{folder}' holds the scene {name}.xml, and its hand path {name}.csv would be "
            "overwritten; name another folder"
        )
    files = {ending: f"{name}.{ending}" for ending in ENDINGS}
    prepared_folder(folder, files.values())
    return {ending: folder / file for ending, file in files.items()}


def write_chart(chart: Chart, paths: Mapping[str, Path]) -> ChartFiles:
    """Writes all files of a chart.

    Args:
        chart: The measurement.
        paths: Paths by ending, as ``prepared_files`` returned them.

    Raises:
        HapticBridgeError: A file cannot be written.
    """
    facts = summary_of(chart)
    texts = {
        "csv": table_of(chart),  # the table first: computing it took the time
        "json": json.dumps(facts, indent=2, allow_nan=False) + "\n",
    }
    for ending, text in texts.items():
        with writing(paths[ending], StudyError):
            paths[ending].write_text(text, encoding="utf-8", newline="")
    figure = draw_chart(chart)
    for ending in PICTURES:
        write_picture(figure, paths[ending])
    return ChartFiles(dict(paths), facts)


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
    text = io.StringIO()
    names = dict.fromkeys(name for row in rows for name in row)
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def summary_of(chart: Chart) -> dict[str, Any]:
    """Returns the content of the JSON file; numbers that are not finite become None."""
    panels = [
        {
            "panel": panel.key,
            "title": panel.title,
            "reference": panel.reference,
            "reference_is_truth": panel.is_truth,
            "recommendation": recommendation(chart.points_of(panel)),
            "standing": standing(chart.points_of(panel)),
            "front": [
                {
                    "setting": each.setting.label,
                    "cost": each.cost.median,
                    "error": each.score.jnd,
                    "verdict": each.score.verdict,
                    "hazard": each.setting.method.hazard,
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
    facts = {
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
    plain: dict[str, Any] = finite_or_null(facts)
    return plain
