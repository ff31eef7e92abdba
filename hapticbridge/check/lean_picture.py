"""Plot of cost against felt error."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hapticbridge.check.lean import Lean
from hapticbridge.check.trial import (
    CREATES,
    IS_FELT,
    MAY_GO,
    NOT_BORNE,
    SAVES_NOTHING,
    WARNS,
    Trial,
)
from hapticbridge.picture import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

_COLOURS = {
    MAY_GO: "#26a269",
    SAVES_NOTHING: "#5e5c64",
    IS_FELT: "#c01c28",
    CREATES: "#c64600",
    WARNS: "#986a44",
    NOT_BORNE: "#813d9c",
}
_MARKERS = {MAY_GO: "o", SAVES_NOTHING: "s", IS_FELT: "^", CREATES: "X", WARNS: "P", NOT_BORNE: "v"}
_PATH = "#1a5fb4"

LINEAR = 0.01
"""Felt error in JND below which the axis is linear, so that zero can be shown."""

LINE = 0.19
"""Height of a name in inches: 8 points and a gap."""

NAMES = 1.04
"""Left edge of the column of names, in widths of the axes."""


def draw_lean(lean: Lean, name: str) -> Figure:
    """Draws cost against felt error of every version that was tried."""
    points = [(trial.name, trial, "") for trial in lean.alone if trial.felt is not None]
    steps = [(f"{k + 1}: {t.name}", t, "path") for k, t in enumerate(lean.together)]
    points += steps
    figure = new_figure(8.0, max(4.2, 1.3 + LINE * len(points)))
    axes = figure.add_subplot()
    axes.set_yscale("symlog", linthresh=LINEAR)
    felt = [_felt(trial) for _, trial, _ in points]
    axes.set_ylim(-0.35 * LINEAR, 2.5 * max([lean.judge.budget, *felt]))
    costs = [100.0 * _cost(trial) for _, trial, _ in points]
    axes.set_xlim(0.0, 1.06 * max([104.0, *costs]))
    axes.axhline(lean.judge.budget, color="black", linewidth=1.0, linestyle="--")
    axes.axvline(100.0, color="0.8", linewidth=1.0, zorder=0)
    _draw_path(axes, lean)
    for _, trial, kind in points:
        if not kind:
            axes.plot(
                100.0 * _cost(trial),
                _felt(trial),
                _MARKERS[trial.verdict],
                color=_COLOURS[trial.verdict],
                markersize=6,
                alpha=0.8,
            )
    _write_names(axes, points)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlabel("cost (processor time, % of the scene as it is)")
    axes.set_ylabel("felt error (just noticeable differences)")
    axes.set_title(f"{name}: what could go without being felt", loc="left", fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(
        handles=_legend(points, lean),
        loc="outside lower center",
        ncols=3,
        fontsize=8,
        frameon=False,
    )
    return figure


def _felt(trial: Trial) -> float:
    return 0.0 if trial.felt is None else trial.felt.felt


def _cost(trial: Trial) -> float:
    return 1.0 if trial.cost is None else trial.cost


def _draw_path(axes: Axes, lean: Lean) -> None:
    x = [100.0, *(100.0 * _cost(trial) for trial in lean.together)]
    y = [0.0, *(_felt(trial) for trial in lean.together)]
    axes.plot(x, y, "-", color=_PATH, linewidth=1.5, zorder=1)
    axes.plot(x, y, "D", color=_PATH, markersize=6, zorder=3)


def _write_names(axes: Axes, points: list[tuple[str, Trial, str]]) -> None:
    """Writes the names in a column beside the axes, each with a line to its point.

    Names at the points would overlap, because many points coincide.
    """
    order = sorted(points, key=lambda point: (_felt(point[1]), -_cost(point[1])))
    heights = np.linspace(0.0, 1.0, len(order)) if len(order) > 1 else np.array([0.5])
    for height, (name, trial, kind) in zip(heights, order, strict=True):
        colour = _PATH if kind else _COLOURS[trial.verdict]
        axes.annotate(
            name,
            xy=(100.0 * _cost(trial), _felt(trial)),
            xytext=(NAMES, float(height)),
            textcoords="axes fraction",
            fontsize=8,
            color=colour,
            va="center",
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.5, "alpha": 0.5},
        )


def _legend(points: list[tuple[str, Trial, str]], lean: Lean) -> list[Line2D]:
    from matplotlib.lines import Line2D  # noqa: PLC0415 - for a picture alone

    verdicts = list(dict.fromkeys(trial.verdict for _, trial, kind in points if not kind))
    handles = [
        Line2D(
            [],
            [],
            marker=_MARKERS[verdict],
            color=_COLOURS[verdict],
            linestyle="",
            label=f"alone: {verdict}",
        )
        for verdict in verdicts
    ]
    if lean.together:
        handles.append(Line2D([], [], marker="D", color=_PATH, label="taken together, in order"))
    budget = f"budget: {lean.judge.budget:g} JND"
    return [*handles, Line2D([], [], color="black", linestyle="--", label=budget)]
