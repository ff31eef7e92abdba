"""Map ``contact``: energy that settings of MuJoCo's contact create, by rendering method."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import mujoco
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.lab.maps import base, contact_rigs
from hapticbridge.lab.maps.base import Point, Sentences
from hapticbridge.lab.maps.contact_rigs import PERIOD, TREATMENTS, ContactRun, Treatment, peg_runs
from hapticbridge.lab.methods import METHODS
from hapticbridge.plotting import new_figure
from hapticbridge.scene.contacts import (
    HEAVY_SLACK_STEPS,
    SLACK_STEPS,
    STRICT_STEPS,
    ContactNumbers,
    contact_numbers,
)
from hapticbridge.sweep.results import Table

HEAVY = 0.1
"""Tool mass in kg from which the rule's line for heavier tools applies."""

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
    selected = table.select(table["rig"] == "peg")
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


def exceptions(table: Table) -> list[dict[str, Any]]:
    """Returns the search results worse than the rule, by treatment and tool mass in kg."""
    found = []
    for name, treatment in TREATMENTS.items():
        selected = table.select(table["treatment"] == name)
        for mass, verdict in zip(
            selected["mass"].tolist(), verdicts(selected).tolist(), strict=True
        ):
            numbers = treatment.numbers
            grade = numbers.grade if mass >= HEAVY else numbers.light_grade
            if treatment.is_ruled and verdict > base.VERDICTS.index(grade):
                worse = {"treatment": name, "mass": mass, "rule": grade}
                found.append({**worse, "measured": base.VERDICTS[verdict]})
    return found


def draw_bars(axes: Axes, found: Sequence[Mapping[str, Any]], names: Sequence[str]) -> None:
    """Draws one bar for each entry: its runs by verdict."""
    if not found:
        base.say_missing(axes)
        return
    left = np.zeros(len(found))
    for verdict, colour in zip(base.VERDICTS[:3], base.COLOURS[:3], strict=True):
        width = np.array([one[verdict.replace(" ", "_")] for one in found])
        axes.barh(names, width, left=left, color=colour, height=0.8)
        left = left + width
    axes.invert_yaxis()
    axes.set_xlabel("runs by verdict")


SEARCH_MASSES = (0.03, 0.1, 0.3)
"""Tool masses in kg."""

SEARCH_STIFFNESS = (1000.0, 6000.0)
"""Stiffnesses K in N/m."""

SEARCH_HANDS = (0, 1, 2)
"""Hands: the recorded one and two seeds."""

FRICTION = (0.0, 0.42)


def search(name: str, mass: float) -> dict[str, float | int]:
    """Runs a peg of a mass in kg in one treatment, by K, friction and hand."""
    cases = list(itertools.product([mass], FRICTION, SEARCH_HANDS))
    treatment = TREATMENTS[name]
    return contact_rigs.summary(
        [run for k in SEARCH_STIFFNESS for run in peg_runs(treatment, k, cases)]
    )


def totals(selected: Table) -> dict[str, Any]:
    """Sums runs by verdict, with the largest of the other quantities and the median depth."""
    counts = ("runs", "strict", "within_slack", "active")
    worst = ("created", "slack_share", "peak_force", "largest_depth")
    return {
        **{name: int(selected[name].sum()) for name in counts},
        **{name: float(selected[name].max()) for name in worst},
        "median_depth": float(np.median(selected["median_depth"])),
    }


def searched(table: Table, name: str) -> dict[str, Any]:
    """Returns the totals of one treatment over all tools."""
    treatment = TREATMENTS[name]
    return {
        "treatment": name,
        "relaxation": treatment.relaxation,
        "static_depth": treatment.static_depth,
        **totals(table.select(table["treatment"] == name)),
    }


COMPARED = ("implicit", "compensated", "lossless")
"""Methods that are passive behind the coupling. They differ away from contact, and in the damping
of their law. The hands here therefore make and break contact."""

HANDS = 20
"""Rigs. At the mouth the first hand is the recorded one, the others are seeds."""

FELT_DAMPING = 1.25
"""Ratio B/(K T), without unit. Above 1, every method keeps some damping in its law (B > K T)."""

MOUTH = 0.0275
"""Height of the peg's centre at the start in m, with 2.5 mm of the peg in the hole. The recorded
hand is there when its part begins, and a random hand passes in and out there."""

RIGS = ("taps", "mouth")

Case = tuple[float, float, float, int]
"""Cases: K in N/m, tool mass in kg, friction and hand."""


def method_points() -> list[tuple[str, str, float]]:
    """Returns rig, method and tool mass in kg of every comparison."""
    return list(itertools.product(RIGS, COMPARED, SEARCH_MASSES))


def cases_of(rig: str, mass: float) -> list[Case]:
    """Returns the cases for each method on a rig with a tool mass in kg."""
    friction = FRICTION if rig == "mouth" else (0.0,)
    return list(itertools.product(SEARCH_STIFFNESS, [mass], friction, range(HANDS)))


def compared(rig: str, method: str, mass: float) -> dict[str, float | int]:
    """Runs a tool of a mass in kg on a rig by a method, by K, friction and hand."""
    return contact_rigs.summary(list(method_runs(rig, method, cases_of(rig, mass))))


def method_runs(
    rig: str, method: str, cases: Iterable[Case], *, same_law: bool = False
) -> Iterator[ContactRun]:
    """Runs a method through cases; ``taps`` are on a wall, ``mouth`` is in and out of a hole.

    Args:
        rig: One of ``RIGS``.
        method: Name of the method.
        cases: Cases to run.
        same_law: True requests the coupling for which the method's law has the K and B' of
            ``lossless``, and thus needs the same device. By default the requested K and B are equal
            for all methods.
    """
    treatment = Treatment(method=method)
    for stiffness, mass, friction, hand in cases:
        damping, turning = (
            FELT_DAMPING * stiffness * PERIOD,
            contact_rigs.PEG_ROTATION[0] * stiffness,
        )
        requested = Coupling(stiffness, damping, turning, FELT_DAMPING * turning * PERIOD)
        coupling = requested
        if same_law:
            law = METHODS["lossless"].law_coupling(requested, PERIOD)
            coupling = METHODS[method].requested_coupling(law, PERIOD)
        if rig == "taps":
            loop = base.loop_in("virtual_wall", "contact")
            path, holder = contact_rigs.random_taps(hand)
        else:
            loop = base.loop_in("peg_in_hole", "mouth", _start_at_mouth)
            path, holder = contact_rigs.recorded() if hand == 0 else contact_rigs.random_push(hand)
        treatment.apply(loop.scene.model, friction)
        contact_rigs.set_mass(loop, "tool" if rig == "taps" else "peg", mass)
        device = contact_rigs.firm_device(requested, path, holder)
        records, run = contact_rigs.run_once(
            loop, device, coupling, treatment, contact_rigs.ticks_of(device)
        )
        yield replace(
            run, depth=contact_rigs.deepest(loop, records) if rig == "mouth" else _behind(records)
        )


def _start_at_mouth(model: mujoco.MjModel) -> None:
    model.key_qpos[0, 2] = MOUTH


def _behind(records: NDArray[np.void]) -> float:
    # the face is 10 mm from where the tool's surface starts
    return max(0.0, float(records["tool_position"][:, 0].max()) - 0.01)


def methods_found(table: Table) -> list[dict[str, Any]]:
    """Returns the totals of each method on each rig over all tools."""
    found = []
    for rig, method in itertools.product(RIGS, COMPARED):
        selected = table.select((table["rig"] == rig) & (table["method"] == method))
        if len(selected):
            found.append({"rig": rig, "method": method, **totals(selected)})
    return found


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

CONTOUR = 160
"""Points along each axis from which the rule's lines are drawn; more make them smoother."""

Array = NDArray[np.float64]


def draw(table: Table, boundary: Mapping[str, Any]) -> Figure:
    """Draws verdicts over timeconst and dampratio with the rule, and methods and search below."""
    figure = new_figure(8, 16)
    parts = figure.subfigures(3, 1, squeeze=False, height_ratios=(1, 0.4, 1.05))
    above, between, below = parts[:, 0]
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
    methods, search = boundary["methods"], boundary["search"]
    draw_bars(between.subplots(), methods, [f"{one['method']}, {one['rig']}" for one in methods])
    between.suptitle(
        f"The methods on the contact as shipped, {HANDS} hands each: taps on a wall, and in and "
        "out of the hole's mouth;\ntools and K as below, B = 1.25 K T felt",
        fontsize="small",
    )
    draw_bars(below.subplots(), search, [one["treatment"] for one in search])
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
    return figure


def _legend(figure: Figure, verdicts: Sequence[int]) -> None:
    handles: list[Artist] = [
        Patch(facecolor=base.COLOURS[v], label=base.VERDICTS[v]) for v in verdicts
    ]
    handles += [Line2D([], [], color="black", ls=style, label=words) for _, style, words in LINES]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=3, fontsize="small", frameon=False
    )


def _draw_panel(axes: Axes, table: Table, rig: str, method: str, stiffness: float) -> None:
    is_selected = (table["rig"] == rig) & (table["method"] == method)
    selected = table.select(is_selected & (table["stiffness"] == stiffness))
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


DEFAULT_POINTS = 333
"""Approximate number of points by default."""


def points(count: int) -> Sequence[Point]:
    """Returns timeconst by dampratio per panel and K, search and methods, ``count`` in all."""
    searches: list[Point] = [
        _point("search", name, "implicit", mass=mass)
        for name in TREATMENTS
        for mass in SEARCH_MASSES
    ]
    searches += [_point(rig, "", method, mass=mass) for rig, method, mass in method_points()]
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

    The worst run gives the verdict of a cell, so its runs end with the first active one.
    """
    if point["rig"] == "search":
        return search(str(point["treatment"]), float(point["mass"]))
    if point["rig"] in RIGS:
        return compared(str(point["rig"]), str(point["method"]), float(point["mass"]))
    solref = float(point["steps"]) * PERIOD, float(point["dampratio"])
    treatment = Treatment(solref, method=str(point["method"]))
    runs = contact_rigs.wall_runs if point["rig"] == "wall" else peg_runs
    return contact_rigs.summary(
        contact_rigs.until_active(runs(treatment, float(point["stiffness"])))
    )


def summarize(table: Table) -> dict[str, Any]:
    """Compares the rule with the grid and the search, and sums treatments and methods."""
    fast = table.select((table["rig"] == "wall") & (table["method"] == "implicitfast"))
    return {
        "period": PERIOD,
        "rule": agreement(table),
        "active_share_of_implicitfast": float(np.mean(verdicts(fast) > 0)) if len(fast) else None,
        "search": [searched(table, name) for name in TREATMENTS if name in table["treatment"]],
        "methods": methods_found(table),
        "exceptions": exceptions(table),
    }


def sentences(boundary: Mapping[str, Any]) -> Sentences:
    """States the agreement with the rule, and the verdicts of treatments and methods."""
    if boundary["rule"]["relaxed"]["cells"] + boundary["rule"]["abrupt"]["cells"]:
        yield (
            "On the peg's grid {strict[strict]} of {strict[cells]} settings that the rule calls "
            "strict were so in every run, {relaxed[active]} of {relaxed[cells]} that it has within "
            "the slack for 30 g were active, and so were {abrupt[active]} of {abrupt[cells]} for "
            "which it promises nothing; in the search {worse} rows were worse than it says",
            boundary["rule"] | {"worse": len(boundary["exceptions"])},
        )
    yield (
        "Under 'implicitfast' a mass on a wall creates energy at "
        "{active_share_of_implicitfast:.0%} of the settings",
        boundary,
    )
    search = boundary["search"]
    strict = [one for one in search if one["strict"] == one["runs"]]
    strict = [one for one in strict if TREATMENTS[one["treatment"]].substeps == 1]
    best: Mapping[str, Any] = min(strict, key=lambda one: float(one["median_depth"]), default={})
    yield (
        "{count} treatments of the search are strict on the peg in every run with one step a tick; "
        "least deep is '{treatment}', median {median_depth:.2g} m, {static_depth:.2g} times as "
        "deep as shipped under a steady force",
        {**best, "count": len(strict)},
    )
    yield (
        "The setting as shipped is strict in {strict} of {runs} runs and uses up to "
        "{slack_share:.2f} of the slack",
        next((one for one in search if one["treatment"] == contact_rigs.SHIPPED), {}),
    )
    for one in boundary["methods"]:
        yield (
            "'{method}', {rig}: strict in {strict} of {runs} runs, active in {active}, creates "
            "{created:.2g} J at most",
            one,
        )
