"""Map ``contact``: which settings of MuJoCo's contact create energy, and one that never did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hapticbridge.picture import new_figure
from hapticbridge.scene.contact_rule import contact_numbers
from hapticbridge.study.maps.contact_agreement import LINES, agreement, exceptions, is_in, verdicts
from hapticbridge.study.maps.contact_rigs import peg_runs, summary, until_active, wall_runs
from hapticbridge.study.maps.contact_search import SEARCH_MASSES, draw_search, search, searched
from hapticbridge.study.maps.contact_treatments import (
    PERIOD,
    SHIPPED,
    SHIPPED_SOLIMP,
    TREATMENTS,
    Treatment,
)
from hapticbridge.study.maps.stability_map import Finding, Point, StabilityMap
from hapticbridge.study.maps.verdicts import COLOURS, VERDICTS, draw_verdicts
from hapticbridge.study.table import Table

STEPS = (0.25, 20.0)
"""Range of timeconst/T, even in its logarithm."""

DAMPING_RATIO = (0.05, 12.8)
"""Range of dampratio, even in its logarithm; six times beyond the usual ones, for there it ends."""

PANELS = (
    ("wall", "implicit", (2000.0, 20_000.0), "one mass on a wall, discrete"),
    ("wall", "implicitfast", (2000.0, 20_000.0), "one mass on a wall, implicitfast"),
    ("peg", "implicit", (1000.0, 6000.0), "peg in the hole, discrete"),
)
"""Rig, method, K in N/m and title."""


def points(count: int) -> Sequence[Point]:
    """Returns timeconst by dampratio for every panel and K, and the search, ``count`` in all."""
    searches: list[Point] = [
        _point("search", name, "implicit", mass=mass)
        for name in TREATMENTS
        for mass in SEARCH_MASSES
    ]
    side = max(2, round((max(0, count - len(searches)) / 6) ** 0.5))
    grid = [
        _point(rig, "", method, stiffness=k, steps=float(s), dampratio=float(ratio))
        for rig, method, stiffness, _ in PANELS
        for k in stiffness
        for ratio in np.geomspace(*DAMPING_RATIO, side)
        for s in np.geomspace(*STEPS, side)
    ]
    return grid + searches


def _point(rig: str, name: str, method: str, **numbers: float) -> Point:
    zeros = {"stiffness": 0.0, "steps": 0.0, "dampratio": 0.0, "mass": 0.0}
    return {"rig": rig, "treatment": name, "method": method, **zeros, **numbers}


def evaluate(point: Point) -> Mapping[str, float | int]:
    """Runs a setting with light and heavy tools, with and without friction, and several hands.

    The worst run is the verdict of a cell, so its runs end with the first that is active.
    """
    if point["rig"] == "search":
        return search(str(point["treatment"]), float(point["mass"]))
    solref = float(point["steps"]) * PERIOD, float(point["dampratio"])
    treatment = Treatment(solref, method=str(point["method"]))
    runs = wall_runs if point["rig"] == "wall" else peg_runs
    return summary(until_active(runs(treatment, float(point["stiffness"]))))


def read(table: Table) -> Finding:
    """Draws verdicts over timeconst and dampratio with the rule on top, and the search below."""
    figure = new_figure(8, 13)
    halves = figure.subfigures(2, 1, squeeze=False, height_ratios=(1, 1.05))
    above, below = halves[:, 0]
    rows = above.add_gridspec(2, 3)
    for column, (rig, method, stiffness, title) in enumerate(PANELS):
        for row, k in enumerate(stiffness):
            axes = above.add_subplot(rows[row, column])
            _draw_panel(axes, table, rig, method, k)
            axes.set_title(f"{title}\nK = {k:g} N/m", fontsize="small")
            if row == 1:
                axes.set_xlabel("timeconst / T")
            if column == 0:
                axes.set_ylabel("dampratio")
    found = [searched(table, name) for name in TREATMENTS if np.any(table["treatment"] == name)]
    draw_search(below.add_subplot(below.add_gridspec(1, 2, width_ratios=(1, 1.22))[0]), found)
    below.suptitle(
        "The search on the peg: 30, 100 and 300 g, K = 1000 and 6000 N/m, friction 0 and 0.42,\n"
        "one recorded and two random hands",
        fontsize="small",
    )
    figure.suptitle(
        f"Contact settings (solref) at T = {1e3 * PERIOD:g} ms, impedance 0.9 to 0.95,\n"
        "elliptic cone: the worst run of each cell\nwall: 10, 50 and 200 g; "
        "peg: 30 and 100 g, friction 0 and 0.42, random hands",
        fontsize="medium",
    )
    _legend(figure, sorted(set(verdicts(table).tolist())))
    rule = agreement(table)
    return Finding(
        figure,
        _paragraph(table, found, rule),
        {"period": PERIOD, "rule": rule, "search": found, "exceptions": exceptions(table)},
    )


def _legend(figure: Figure, verdicts: Sequence[int]) -> None:
    handles: list[Artist] = [Patch(facecolor=COLOURS[v], label=VERDICTS[v]) for v in verdicts]
    handles += [Line2D([], [], color="black", ls=style, label=words) for _, style, words in LINES]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=3, fontsize="small", frameon=False
    )


def _draw_panel(axes: Axes, table: Table, rig: str, method: str, stiffness: float) -> None:
    is_mine = (table["rig"] == rig) & (table["method"] == method)
    mine = table.select(is_mine & (table["stiffness"] == stiffness))
    draw_verdicts(axes, mine["steps"], mine["dampratio"], verdicts(mine), log_x=True, log_y=True)
    steps, ratio = np.meshgrid(np.geomspace(*STEPS, 160), np.geomspace(*DAMPING_RATIO, 160))
    numbers = [
        contact_numbers((s * PERIOD, d), SHIPPED_SOLIMP, PERIOD)
        for s, d in zip(steps.flat, ratio.flat, strict=True)
    ]
    lines: dict[str, Any] = {"linewidths": 1.5, "colors": "black"}
    for name, style, _ in LINES:
        is_above = np.reshape([is_in(name, n) for n in numbers], steps.shape)
        axes.contour(steps, ratio, is_above, levels=[0.5], linestyles=style, **lines)
    axes.plot(2.0, 1.0, "o", color="black", mfc="white", ms=5)
    axes.annotate(
        "as shipped",
        (2.0, 1.0),
        xytext=(-6, -30),
        textcoords="offset points",
        size=7,
        ha="center",
        arrowprops={"arrowstyle": "-", "lw": 0.6},
    )
    axes.set_xlim(*STEPS)
    axes.set_ylim(*DAMPING_RATIO)


def _paragraph(
    table: Table, found: Sequence[Mapping[str, Any]], rule: Mapping[str, Mapping[str, int]]
) -> str:
    strict = [one for one in found if one["strict"] == one["runs"]]
    at_rate = [one for one in strict if TREATMENTS[one["treatment"]].substeps == 1]
    if at_rate:
        best = min(at_rate, key=lambda one: one["median_depth"])
        verdict = (
            f"{len(at_rate)} of {len(found)} treatments are strict on the peg in every run with "
            f"one step a tick; least deep is '{best['treatment']}', median "
            f"{1e3 * best['median_depth']:.2f} mm and at most {1e3 * best['largest_depth']:.2f} "
            f"mm, {best['static_depth']:.2g} times as deep as shipped under a steady force; it "
            f"takes {1e3 * best['relaxation']:.3g} ms to come back after a push"
        )
    else:
        verdict = f"none of {len(found)} treatments is strict on the peg in every run"
    finer = [one for one in strict if TREATMENTS[one["treatment"]].substeps > 1]
    if finer:
        best = min(finer, key=lambda one: one["median_depth"])
        verdict += (
            f"; with substeps '{best['treatment']}' is too, at {1e3 * best['median_depth']:.2f} mm"
        )
    shipped = "".join(
        f" The setting as shipped is strict in {one['strict']} of {one['runs']} runs and uses up "
        f"to {one['slack_share']:.2f} of the slack, at {1e3 * one['median_depth']:.2f} and at most "
        f"{1e3 * one['largest_depth']:.2f} mm."
        for one in found
        if one["treatment"] == SHIPPED
    )
    fast = table.select((table["rig"] == "wall") & (table["method"] == "implicitfast"))
    inside, sure, below = (rule[name] for name in ("relaxed", "strict", "abrupt"))
    worse = exceptions(table)
    holds = sure["strict"] == sure["cells"] and not inside["active"] and not worse
    return (
        f"The rule {'held' if holds else 'did not hold everywhere'}: on the peg's grid "
        f"{sure['strict']} of {sure['cells']} settings that it calls strict were "
        f"so in every run, {inside['cells'] - inside['active']} of {inside['cells']} that it has "
        f"within the slack for 30 g stayed there, and {below['active']} of {below['cells']} for "
        f"which it promises nothing did not; in the search {len(worse)} rows were worse than it "
        f"says. Under 'implicitfast' a mass on a wall creates "
        f"energy at {100 * float(np.mean(verdicts(fast) > 0)) if len(fast) else 0:.0f} % of the "
        f"settings. The search: {verdict}.{shipped}"
    )


CONTACT = StabilityMap(
    name="contact",
    about="settings of MuJoCo's contact: energy that they create on a wall and in a hole, and the "
    "search for one that creates none",
    default_points=315,
    points=points,
    evaluate=evaluate,
    read=read,
)
