"""Map ``contact``: energy that contacts create, by MuJoCo's settings and by rigid contacts."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from hapticbridge.lab.maps import base, contact_rigs
from hapticbridge.lab.maps.base import PERIOD, Point, Sentences
from hapticbridge.lab.maps.contact_rigs import (
    COMPARED_RIGS,
    FRICTIONS,
    MASSES,
    RIGID,
    RIGS,
    SCENE,
    STIFFNESSES,
    TREATMENTS,
    WORST,
    Case,
    Treatment,
    run_case,
    run_cases,
    worst_peg,
)
from hapticbridge.lab.maps.twins import UNGUARDED_OPTIONS, Run, Twins
from hapticbridge.plotting import new_figure
from hapticbridge.scene.contacts import (
    HEAVY_SLACK_STEPS,
    SLACK_STEPS,
    STRICT_STEPS,
    ContactNumbers,
    contact_numbers,
)
from hapticbridge.sweep import Table

LINES = (
    ("strict", "-", f"rule: strict above (τ = {STRICT_STEPS:g} T or more)"),
    ("relaxed", "--", f"within slack above (τ = {SLACK_STEPS:g} T)"),
    ("heavy", ":", f"the same from 0.1 kg (τ = {HEAVY_SLACK_STEPS:g} T)"),
)
"""Regions of the rule: name, line style and words."""


def is_in(region: str, numbers: ContactNumbers) -> bool:
    """Returns True if the rule places a setting in a region; in ``abrupt`` it promises nothing."""
    if region == "strict":
        return numbers.grade == "strict"
    if region == "relaxed":
        return numbers.light_grade != "active"
    return (numbers.grade == "active") == (region == "abrupt")


def verdicts(table: Table) -> NDArray[np.int64]:
    """Returns the worst verdict of each row as an index in ``VERDICTS``."""
    return np.where(table["active"] > 0, 2, np.where(table["within_slack"] > 0, 1, 0))


def agreement(table: Table) -> dict[str, Any]:
    """Compares the rule with the measurement on the peg's grid, in counts."""
    selected = _grid_of(table, "peg")
    numbers = [
        contact_numbers((s * PERIOD, d), contact_rigs.SHIPPED_SOLIMP, PERIOD)
        for s, d in zip(selected["steps"], selected["dampratio"], strict=True)
    ]
    measured = verdicts(selected)
    regions = {
        name: np.array([is_in(name, n) for n in numbers], dtype=bool)
        for name in ("strict", "relaxed", "abrupt")
    }
    return {
        name: {
            "cells": int(cells.sum()),
            **{
                verdict.replace(" ", "_"): int((measured[cells] == place).sum())
                for place, verdict in enumerate(base.VERDICTS[:3])
            },
        }
        for name, cells in regions.items()
    }


def _grid_of(table: Table, rig: str) -> Table:
    return table.select((table["rig"] == rig) & (table["treatment"] == ""))


def totals(selected: Table) -> dict[str, Any]:
    """Sums runs by verdict, with the largest of the other quantities and the median depth."""
    counts = ("runs", "strict", "within_slack", "active")
    worst = ("created", "slack_share", "peak_force", "largest_depth")
    return {
        **{name: int(selected[name].sum()) for name in counts},
        **{name: float(selected[name].max()) for name in worst},
        "median_depth": float(np.median(selected["median_depth"])),
    }


def compared(table: Table) -> list[dict[str, Any]]:
    """Returns the totals of each treatment, over all rigs and on each; ``rig`` is then empty."""
    rows = []
    for name, rig in itertools.product(TREATMENTS, ("", *COMPARED_RIGS)):
        is_selected = table["treatment"] == name
        if rig:
            is_selected &= table["rig"] == rig
        if is_selected.any():
            rows.append({"treatment": name, "rig": rig, **totals(table.select(is_selected))})
    return rows


HANDS = {True: (0, 1), False: (4, 5)}
"""Hands on shipped scenes, the own one first, and on the other rigs."""


def cases_of(rig: str) -> list[Case]:
    """Returns the cases in which a treatment is compared on a rig."""
    is_shipped = RIGS[rig].is_shipped
    masses, frictions = ((0.1,), (0.4,)) if is_shipped else (MASSES, FRICTIONS)
    stiffnesses = STIFFNESSES[:1] if is_shipped else STIFFNESSES
    combinations = itertools.product(stiffnesses, masses, frictions, HANDS[is_shipped])
    return [Case(rig, *values) for values in combinations]


STEPS = (0.25, 20.0)
"""Range of timeconst/T, even in its logarithm."""

DAMPING_RATIO = (0.05, 12.8)
"""Range of dampratio, even in its logarithm; it extends to six times the usual values."""

PANELS = (
    ("wall", "implicit", (2000.0, 20_000.0), "one mass on a wall, discrete"),
    ("wall", "implicitfast", (2000.0, 20_000.0), "one mass on a wall, implicitfast"),
    ("peg", "implicit", (1000.0, 6000.0), "peg in the hole, discrete"),
)
"""Panels: rig, method, K in N/m and title."""

GRID_CASES = {
    "wall": tuple(itertools.product((0.01, 0.05, 0.2), (0.0,), (-1, -2))),
    "peg": tuple(itertools.product((0.03, 0.1), (0.0, 0.4), (5, 4))),
}
"""Cases of a cell by rig, tool mass in kg, friction and hand, the most often active first."""

CONTOUR = 160
"""Points along each axis from which the rule's lines are drawn; more make them smoother."""

Array = NDArray[np.float64]


def draw(table: Table, boundary: Mapping[str, Any]) -> Figure:
    """Draws verdicts over timeconst and dampratio with the rule, and the comparison below."""
    figure = new_figure(8, 14)
    parts = figure.subfigures(2, 1, squeeze=False, height_ratios=(1, 0.95))
    above, below = parts[:, 0]
    rows = above.add_gridspec(2, 3)
    for column, (rig, method, stiffness, title) in enumerate(PANELS):
        for row, k in enumerate(stiffness):
            axes = above.add_subplot(rows[row, column])
            _draw_panel(axes, _grid_of(table, rig), method, k)
            axes.set_title(f"{title}\nK = {k:g} N/m", fontsize="small")
            if row == 1:
                axes.set_xlabel("timeconst / T")
            if column == 0:
                axes.set_ylabel("dampratio")
    panels = below.subplots(2, 2, height_ratios=(1, 1.6))
    _draw_bars(panels[0, 0], [one for one in boundary["compared"] if not one["rig"]])
    _draw_energy(panels[0, 1])
    _draw_depths(panels[1, 0], boundary["compared"], "median_depth", "median penetration in µm")
    _draw_depths(panels[1, 1], boundary["compared"], "largest_depth", "largest penetration in µm")
    masses, stiffnesses, frictions = (
        " and ".join(f"{value:g}" for value in values)
        for values in (np.multiply(1e3, MASSES), STIFFNESSES, FRICTIONS)
    )
    below.suptitle(
        f"{len(COMPARED_RIGS)} rigs in random hands: {masses} g, K = {stiffnesses} N/m, "
        f"friction {frictions};\nshipped scenes as they are",
        fontsize="small",
    )
    figure.suptitle(
        f"Contact settings (solref) at T = {1e3 * PERIOD:g} ms, impedance 0.9 to 0.95,\n"
        "elliptic cone: the worst run of each cell\nwall: 10, 50 and 200 g; "
        "peg: 30 and 100 g, friction 0 and 0.4, random hands",
        fontsize="medium",
    )
    _legend(figure, sorted(set(verdicts(table).tolist())))
    return figure


def _draw_bars(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    if not rows:
        base.say_missing(axes)
        return
    left = np.zeros(len(rows))
    names = [one["treatment"] for one in rows]
    for verdict, colour in zip(base.VERDICTS[:3], base.COLOURS[:3], strict=True):
        width = np.array([one[verdict.replace(" ", "_")] for one in rows])
        axes.barh(names, width, left=left, color=colour, height=0.8)
        left = left + width
    axes.invert_yaxis()
    axes.set_xlabel("runs by verdict")


def _draw_energy(axes: Axes) -> None:
    """Draws the energy that one run creates, with the settings as shipped and rigid."""
    for contact, treatment in (("scene", SCENE), ("rigid", RIGID)):
        energy = run_case(treatment, WORST, keep_records=True).records["environment_energy"]
        axes.plot(PERIOD * np.arange(len(energy)), 1e3 * energy, label=contact)
    axes.axhline(0.0, color="black", lw=0.6)
    axes.set(xlabel="time in s", ylabel="energy created in mJ")
    axes.set_title(f"{1e3 * WORST.mass:g} g peg, K = {WORST.stiffness:g} N/m", fontsize="small")
    axes.legend(fontsize="small")


def _draw_depths(axes: Axes, rows: Sequence[Mapping[str, Any]], quantity: str, words: str) -> None:
    depth = {(one["treatment"], one["rig"]): 1e6 * one[quantity] for one in rows}
    for place, treatment in enumerate(TREATMENTS):
        depths = [depth.get((treatment, rig), np.nan) for rig in COMPARED_RIGS]
        axes.plot(np.maximum(depths, 1e-4), COMPARED_RIGS, "osv^D"[place], ms=4, label=treatment)
    axes.set(xscale="log", xlabel=words)
    axes.invert_yaxis()
    if quantity == "largest_depth":
        axes.legend(fontsize="x-small", ncols=2, loc="upper right", bbox_to_anchor=(1.0, -0.2))


def _legend(figure: Figure, verdicts: Sequence[int]) -> None:
    handles: list[Artist] = [
        Patch(facecolor=base.COLOURS[v], label=base.VERDICTS[v]) for v in verdicts
    ]
    handles += [Line2D([], [], color="black", ls=style, label=words) for _, style, words in LINES]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=3, fontsize="small", frameon=False
    )


def _draw_panel(axes: Axes, table: Table, method: str, stiffness: float) -> None:
    selected = table.select((table["method"] == method) & (table["stiffness"] == stiffness))
    base.draw_verdicts(
        axes, selected["steps"], selected["dampratio"], verdicts(selected), log_x=True, log_y=True
    )
    steps, ratio, regions = _rule()
    for (_, style, _), is_above in zip(LINES, regions, strict=True):
        axes.contour(
            steps, ratio, is_above, levels=[0.5], linestyles=style, linewidths=1.5, colors="black"
        )
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
    axes.set(xlim=STEPS, ylim=DAMPING_RATIO)


@cache
def _rule() -> tuple[Array, Array, list[Array]]:
    """Returns timeconst/T, dampratio, and the region of each line of the rule.

    The regions have one row per dampratio. The result is cached, because every panel needs it.
    """
    steps, ratio = (np.geomspace(*ends, CONTOUR) for ends in (STEPS, DAMPING_RATIO))
    numbers = [
        [contact_numbers((s * PERIOD, d), contact_rigs.SHIPPED_SOLIMP, PERIOD) for s in steps]
        for d in ratio
    ]
    regions = [
        np.array([[is_in(name, one) for one in row] for row in numbers], dtype=np.float64)
        for name, _, _ in LINES
    ]
    return steps, ratio, regions


DEFAULT_POINTS = 250
"""Approximate number of points by default."""


def points(count: int) -> Sequence[Point]:
    """Returns timeconst by dampratio per panel and K, and the comparison, ``count`` in all."""
    comparison: list[Point] = [
        {**_NUMBERS, "rig": rig, "treatment": name, "method": treatment.method}
        for rig in COMPARED_RIGS
        for name, treatment in TREATMENTS.items()
        if not RIGS[rig].is_shipped or treatment is SCENE or treatment.contact == "rigid"
    ]
    side = max(2, round((max(0, count - len(comparison)) / 6) ** 0.5))
    grid: list[Point] = [
        {
            "rig": rig,
            "treatment": "",
            "method": method,
            "stiffness": k,
            "steps": float(s),
            "dampratio": float(ratio),
        }
        for rig, method, stiffness, _ in PANELS
        for k in stiffness
        for ratio in np.geomspace(*DAMPING_RATIO, side)
        for s in np.geomspace(*STEPS, side)
    ]
    return grid + comparison


_NUMBERS = {"stiffness": 0.0, "steps": 0.0, "dampratio": 0.0}


def evaluate(point: Point) -> Mapping[str, float | int]:
    """Runs a setting with light and heavy tools, with and without friction, and several hands.

    The worst run gives the verdict of a cell, so its runs end with the first active one. The
    comparison counts, so that all its runs are made.
    """
    rig = str(point["rig"])
    if point["treatment"]:
        treatment = TREATMENTS[str(point["treatment"])]
        return contact_rigs.summary(list(run_cases(treatment, cases_of(rig))))
    solref = float(point["steps"]) * PERIOD, float(point["dampratio"])
    treatment = Treatment(method=str(point["method"]), solref=solref)
    cases = [Case(rig, float(point["stiffness"]), *values) for values in GRID_CASES[rig]]
    return contact_rigs.summary(contact_rigs.until_active(run_cases(treatment, cases)))


def summarize(table: Table) -> dict[str, Any]:
    """Compares the rule with the grid, and treatments on every rig."""
    fast = table.select((table["rig"] == "wall") & (table["method"] == "implicitfast"))
    return {
        "period": PERIOD,
        "rule": agreement(table),
        "active_share_of_implicitfast": float(np.mean(verdicts(fast) > 0)) if len(fast) else None,
        "compared": compared(table),
    }


def sentences(boundary: Mapping[str, Any]) -> Sentences:
    """States the verdicts of treatments, and the agreement with the rule."""
    for one in boundary["compared"]:
        if not one["rig"]:
            yield (
                "Contacts '{treatment}' are strict in {strict} of {runs} runs and active in "
                "{active}, create up to {created:.2g} J, use up to {slack_share:.2f} of the slack, "
                "and are {depth:.2g} µm deep in the median",
                {**one, "depth": 1e6 * one["median_depth"]},
            )
    if boundary["rule"]["relaxed"]["cells"] + boundary["rule"]["abrupt"]["cells"]:
        yield (
            "On the peg's grid {strict[strict]} of {strict[cells]} settings that the rule calls "
            "strict were so in every run, {relaxed[active]} of {relaxed[cells]} that it has within "
            "the slack for 30 g were active, and so were {abrupt[active]} of {abrupt[cells]} for "
            "which it promises nothing",
            boundary["rule"],
        )
    yield (
        "Under 'implicitfast' a mass on a wall creates energy at "
        "{active_share_of_implicitfast:.0%} of the settings",
        boundary,
    )


def twins() -> Twins:
    """Returns a light peg that jams in its hole, with MuJoCo's contacts and with rigid ones."""
    return Twins(
        shared=f"A peg of {1e3 * WORST.mass:g} g without friction jams in its hole, "
        f"K = {WORST.stiffness:g} N/m, solref {' '.join(f'{n:g}' for n in SCENE.solref)}",
        name="contact",
        values=(SCENE.contact, RIGID.contact),
        run=lambda contact: Run(
            scene=worst_peg,
            device=lambda: contact_rigs.device_of(WORST, worst_peg(), PERIOD),
            coupling=contact_rigs.coupling_of(WORST),
            options=replace(
                UNGUARDED_OPTIONS, method=SCENE.method, contact=contact, rate=1 / PERIOD
            ),
            duration=1.7,
        ),
    )
