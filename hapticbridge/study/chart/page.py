"""The page of a chart: one file with its pictures, to be pointed at, and its tables."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

from jinja2 import Environment, PackageLoader, select_autoescape

from hapticbridge.study.chart.chart import Chart
from hapticbridge.study.chart.convergence import Order
from hapticbridge.study.chart.drawing import (
    CEILING,
    FLOOR,
    MARKS,
    NARROW,
    colours_of,
    drawn_cost,
    drawn_error,
)
from hapticbridge.study.chart.measurement import Measurement
from hapticbridge.study.chart.recommendation import JND, recommendation, recommended
from hapticbridge.study.chart.score import Verdict
from hapticbridge.study.chart.setting import who
from hapticbridge.study.chart.workload import Panel

WIDTH, HEIGHT = 860, 420
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
    across = Scale.around(list(costs.values()), LEFT, WIDTH - RIGHT)
    upwards = Scale.around([JND, *map(drawn_error, points)], HEIGHT - BOTTOM, TOP)

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
        size=(WIDTH, HEIGHT),
        margins=(LEFT, RIGHT, TOP, BOTTOM),
        edges=(FLOOR, CEILING),
        pale=not all(each.is_comparable for each in chart.measurements),
    )
