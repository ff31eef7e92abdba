"""Map ``contact``: which settings of MuJoCo's contact, and which methods, create energy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hapticbridge.study.maps.contact_agreement import agreement, exceptions, verdicts
from hapticbridge.study.maps.contact_methods import (
    RIGS,
    compared,
    method_points,
    methods_found,
    of_methods,
)
from hapticbridge.study.maps.contact_picture import DAMPING_RATIO, PANELS, STEPS, draw
from hapticbridge.study.maps.contact_rigs import peg_runs, summary, until_active, wall_runs
from hapticbridge.study.maps.contact_search import SEARCH_MASSES, search, searched
from hapticbridge.study.maps.contact_treatments import PERIOD, SHIPPED, TREATMENTS, Treatment
from hapticbridge.study.maps.stability_map import Finding, Point, StabilityMap, computed
from hapticbridge.study.maps.verdicts import MISSING
from hapticbridge.study.table import Table


def points(count: int) -> Sequence[Point]:
    """Returns timeconst by dampratio a panel and K, search and methods, ``count`` in all."""
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

    The worst run is the verdict of a cell, so its runs end with the first that is active.
    """
    if point["rig"] == "search":
        return search(str(point["treatment"]), float(point["mass"]))
    if point["rig"] in RIGS:
        return compared(str(point["rig"]), str(point["method"]), float(point["mass"]))
    solref = float(point["steps"]) * PERIOD, float(point["dampratio"])
    treatment = Treatment(solref, method=str(point["method"]))
    runs = wall_runs if point["rig"] == "wall" else peg_runs
    return summary(until_active(runs(treatment, float(point["stiffness"]))))


def read(table: Table) -> Finding:
    """Draws verdicts over timeconst and dampratio with the rule on top, methods and search below.

    Raises:
        StudyError: No point was computed at all.
    """
    table = computed(table, "contact")
    found = [searched(table, name) for name in TREATMENTS if np.any(table["treatment"] == name)]
    methods = methods_found(table)
    rule, worse = agreement(table), exceptions(table)
    said = [_of_rule(rule, len(worse)), _of_fast(table), _of_search(found), _of_shipped(found)]
    said.append(of_methods(methods) or f"Of the methods {MISSING}.")
    return Finding(
        draw(table, found, methods),
        " ".join(filter(None, said)),
        {"period": PERIOD, "rule": rule, "search": found, "methods": methods, "exceptions": worse},
    )


def _of_rule(rule: Mapping[str, Mapping[str, int]], worse: int) -> str:
    inside, sure, below = (rule[name] for name in ("relaxed", "strict", "abrupt"))
    if not inside["cells"] + below["cells"]:
        return f"On the peg's grid {MISSING}."
    holds = sure["strict"] == sure["cells"] and not inside["active"] and not worse
    return (
        f"The rule {'held' if holds else 'did not hold everywhere'}: on the peg's grid "
        f"{sure['strict']} of {sure['cells']} settings that it calls strict were "
        f"so in every run, {inside['cells'] - inside['active']} of {inside['cells']} that it has "
        f"within the slack for 30 g stayed there, and {below['active']} of {below['cells']} for "
        f"which it promises nothing did not; in the search {worse} rows were worse than it says."
    )


def _of_fast(table: Table) -> str:
    fast = table.select((table["rig"] == "wall") & (table["method"] == "implicitfast"))
    if not len(fast):
        return f"On a wall under 'implicitfast' {MISSING}."
    share = 100 * float(np.mean(verdicts(fast) > 0))
    return f"Under 'implicitfast' a mass on a wall creates energy at {share:.0f} % of the settings."


def _of_search(found: Sequence[Mapping[str, Any]]) -> str:
    if not found:
        return f"In the search {MISSING}."
    strict = [one for one in found if one["strict"] == one["runs"]]
    at_rate = [one for one in strict if TREATMENTS[one["treatment"]].substeps == 1]
    if at_rate:
        best = min(at_rate, key=lambda one: one["median_depth"])
        text = (
            f"{len(at_rate)} of {len(found)} treatments are strict on the peg in every run with "
            f"one step a tick; least deep is '{best['treatment']}', median "
            f"{1e3 * best['median_depth']:.2f} mm and at most {1e3 * best['largest_depth']:.2f} "
            f"mm, {best['static_depth']:.2g} times as deep as shipped under a steady force; it "
            f"takes {1e3 * best['relaxation']:.3g} ms to come back after a push"
        )
    else:
        text = f"none of {len(found)} treatments is strict on the peg in every run"
    finer = [one for one in strict if TREATMENTS[one["treatment"]].substeps > 1]
    if finer:
        best = min(finer, key=lambda one: one["median_depth"])
        text += (
            f"; with substeps '{best['treatment']}' is too, at {1e3 * best['median_depth']:.2f} mm"
        )
    return f"The search: {text}."


def _of_shipped(found: Sequence[Mapping[str, Any]]) -> str:
    for one in found:
        if one["treatment"] == SHIPPED:
            return (
                f"The setting as shipped is strict in {one['strict']} of {one['runs']} runs and "
                f"uses up to {one['slack_share']:.2f} of the slack, at "
                f"{1e3 * one['median_depth']:.2f} and at most {1e3 * one['largest_depth']:.2f} mm."
            )
    return ""


CONTACT = StabilityMap(
    name="contact",
    about="settings of MuJoCo's contact: energy that they create on a wall and in a hole, and the "
    "search for one that creates none",
    default_points=333,
    points=points,
    evaluate=evaluate,
    read=read,
)
