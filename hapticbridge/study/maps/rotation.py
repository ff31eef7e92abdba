"""Map ``rotation``: how fast a tool may spin, and what happens where the angle passes π."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hapticbridge.picture import new_figure
from hapticbridge.study.maps.spinning_tool import coupling_of, speed_of_cut, spin, sudden
from hapticbridge.study.maps.stability_map import Finding, Point, StabilityMap
from hapticbridge.study.maps.tumbling import (
    INERTIA,
    PERIOD,
    TICKS,
    cut_speed,
    free_creation,
    gyroscopic_speed,
)
from hapticbridge.study.maps.verdicts import MISSING, draw_verdicts, verdict_legend, verdict_numbers
from hapticbridge.study.table import Table

SOFT, HARD = 2.0, 20.0
"""K_r in N m/rad: that of the simulated device, and one ten times stiffer."""

METHODS_SHOWN = ("implicit", "implicitfast", "explicit", "weld")

SPEED = (0.0, 200.0)
ANGLE = (0.0, 3.1)
"""Ranges in rad/s and rad: the angle ends short of the cut."""

SLOWEST = 2.0
"""In rad/s, where the lines over the logarithm of the speed begin."""

TOLD_AT = 50.0
"""Speed in rad/s at which the paragraph says what is created: eight turns a second."""

LINES = (
    ("implicit", 0.0, "translation only", "#1a5fb4"),
    ("implicit", SOFT, f"implicit, K_r = {SOFT:g}", "black"),
    ("implicit", HARD, f"implicit, K_r = {HARD:g}", "#7f7f7f"),
    ("implicitfast", SOFT, f"implicitfast, K_r = {SOFT:g}", "#f0a868"),
    ("explicit", SOFT, f"explicit, K_r = {SOFT:g}", "#c0504d"),
)
"""Method, K_r, label and colour of what is drawn over the speed."""

TELLING = (1e-4, 0.05)
"""Share of the kinetic energy within which creation is compared with theory: above rounding, and
below what changes the motion."""


def points(count: int) -> Sequence[Point]:
    """Returns a grid of speed and angle for each method, and lines over the speed."""
    side = max(2, round((0.85 * count / len(METHODS_SHOWN)) ** 0.5))
    many = max(4, round(0.15 * count / (len(LINES) + len(METHODS_SHOWN))))
    cells = [
        _point("cell", method, SOFT, speed, angle)
        for method in METHODS_SHOWN
        for angle in np.linspace(*ANGLE, side)
        for speed in np.linspace(*SPEED, side)
    ]
    lines = [
        _point("line", method, stiffness, speed)
        for method, stiffness, _, _ in LINES
        for speed in np.geomspace(SLOWEST, SPEED[1], many)
    ]
    cuts = [
        _point("cut", method, SOFT, speed)
        for method in METHODS_SHOWN
        for speed in np.linspace(SLOWEST, SPEED[1], many)
    ]
    return [*cells, *lines, *cuts, _point("limit", "implicit", SOFT, 0.0)]


def _point(what: str, method: str, stiffness: float, speed: float, angle: float = 0.0) -> Point:
    return {
        "what": what,
        "method": method,
        "rotational_stiffness": float(stiffness),
        "speed": float(speed),
        "angle": float(angle),
    }


def evaluate(point: Point) -> Mapping[str, float | int | str]:
    """Spins a handle for 1 s, or searches for the speed at which the angle passes π.

    In a ``cell`` or on a ``line`` the tool spins with the handle from the start, in a ``cut`` it is
    at rest.
    """
    method, stiffness = str(point["method"]), float(point["rotational_stiffness"])
    if point["what"] == "limit":
        return {"limit": speed_of_cut(method, stiffness)}
    speed, angle = float(point["speed"]), float(point["angle"])
    coupling = coupling_of(stiffness)
    if point["what"] == "cut":
        found = sudden(method, stiffness, speed)
    else:
        found = spin(method, coupling, speed, angle=angle)
    return {
        "ticks": found.ticks,
        "environment": found.environment,
        "created": found.created,
        "slack_share": found.slack_share,
        "first_active": found.first_active,
        "largest_angle": found.largest_angle,
        "crossed": found.crossed,
        "torque_jump": found.torque_jump,
    }


def read(table: Table) -> Finding:
    """Draws verdicts over speed and angle, creation over speed, and the jump at the cut."""
    figure = new_figure(8, 8.4)
    panels = figure.subplots(3, 2, gridspec_kw={"height_ratios": [1, 1, 1.4]})
    for axes, method in zip(panels[:2].ravel(), METHODS_SHOWN, strict=True):
        _draw_cells(axes, table, method)
    for axes in panels[1]:
        axes.set_xlabel("speed (rad/s)")
    for axes in panels[:2, 0]:
        axes.set_ylabel("angle at the start (rad)")
    _draw_creation(panels[2, 0], table)
    _draw_cut(panels[2, 1], table)
    figure.suptitle(
        f"A free tool of {1e3 * INERTIA[0]:.3g}, {1e3 * INERTIA[1]:.3g}, "
        f"{1e3 * INERTIA[2]:.3g} g m² behind a handle that spins for 1 s at "
        f"{1 / PERIOD:g} Hz;\nabove and right: K_r = {SOFT:g} N m/rad",
        fontsize="medium",
    )
    verdict_legend(
        figure,
        [
            ("angle passed π", "black", "o"),
            ("gyroscopic torque = π K_r", "#1a5fb4", "--"),
        ],
    )
    boundary = _boundary(table)
    return Finding(figure, _paragraph(boundary), boundary)


def _draw_cells(axes: Axes, table: Table, method: str) -> None:
    cells = table.select((table["what"] == "cell") & (table["method"] == method))
    verdict = verdict_numbers(cells["ticks"] == TICKS, cells["environment"])
    draw_verdicts(axes, cells["speed"], cells["angle"], verdict)
    passed = cells.select(cells["crossed"] >= 0)
    axes.plot(passed["speed"], passed["angle"], "o", color="black", ms=2, mfc="white", mew=0.5)
    axes.axvline(gyroscopic_speed(SOFT), color="#1a5fb4", ls="--", lw=1.5)
    axes.set_title(method, fontsize="medium")


def _draw_creation(axes: Axes, table: Table) -> None:
    lines = table.select(table["what"] == "line")
    for method, stiffness, label, colour in LINES:
        mine = lines.select(
            (lines["method"] == method) & (lines["rotational_stiffness"] == stiffness)
        )
        shown = np.maximum(mine["created"], 1e-12)
        axes.loglog(mine["speed"], shown, "o-", color=colour, ms=3, lw=1, label=label)
        if stiffness == 0:
            predicted = [max(free_creation(float(speed)), 1e-12) for speed in mine["speed"]]
            axes.loglog(
                mine["speed"], predicted, color="#1a5fb4", ls=":", lw=3, label="½T²|ω×Iω|²/I"
            )
    axes.set_ylim(1e-13, 1e4)  # room for the names below the curves
    axes.set_xlabel("speed (rad/s)")
    axes.set_ylabel("energy created (J)")
    axes.legend(fontsize="x-small", loc="lower right")


def _draw_cut(axes: Axes, table: Table) -> None:
    cuts = table.select(table["what"] == "cut")
    colours = ("black", "#f0a868", "#c0504d", "#2e8b57")
    widths = (5, 3, 1, 1)  # three of the four lie on each other
    for method, colour, width in zip(METHODS_SHOWN, colours, widths, strict=True):
        mine = cuts.select(cuts["method"] == method)
        axes.plot(
            mine["speed"], mine["torque_jump"], "o-", color=colour, ms=3, lw=width, label=method
        )
    axes.axvline(cut_speed(SOFT), color="#7f7f7f", ls="--", lw=1.2, label="ω = π √(K_r/I)")
    axes.axhline(2 * np.pi * SOFT, color="#7f7f7f", ls=":", lw=1.2, label="2π K_r")
    axes.set_ylim(0, 3 * np.pi * SOFT)
    axes.set_xlabel("speed of a sudden turn (rad/s)")
    axes.set_ylabel("largest jump of torque\nin a tick (N m)")
    axes.legend(fontsize="x-small", loc="lower right")


def _boundary(table: Table) -> dict[str, Any]:
    cells = table.select(table["what"] == "cell")
    lines = table.select(table["what"] == "line")
    free = lines.select(lines["rotational_stiffness"] == 0)
    predicted = np.array([free_creation(float(speed)) for speed in free["speed"]])
    kinetic = 0.5 * INERTIA[1] * free["speed"] ** 2
    share = predicted / kinetic
    told = (share > TELLING[0]) & (share < TELLING[1])
    ratio = free["created"][told] / predicted[told]
    cuts = table.select((table["what"] == "cut") & (table["method"] == "implicit"))
    passed = cuts.select(cuts["crossed"] >= 0)
    limit = table.select(table["what"] == "limit").numbers("limit")
    return {
        "period": PERIOD,
        "rotational_stiffness": SOFT,
        "gyroscopic_speed": gyroscopic_speed(SOFT),
        "fastest_passive": {name: _fastest(cells, name) for name in METHODS_SHOWN},
        "share_strict_below": {name: _strict_share(cells, name) for name in METHODS_SHOWN},
        "first_passed": {name: _first_passed(cells, name) for name in METHODS_SHOWN},
        "translation_only": {
            "speed": free["speed"].tolist(),
            "created": free["created"].tolist(),
            "predicted": predicted.tolist(),
            "grows_up_to": _grows_up_to(free),
            "compared_up_to": float(free["speed"][told].max()) if told.any() else None,
            "largest_deviation": float(np.abs(ratio - 1).max()) if ratio.size else None,
        },
        "cut": {
            "speed_measured": float(limit[0]) if limit.size else None,
            "speed_predicted": cut_speed(SOFT),
            "torque_jump": float(passed["torque_jump"].max()) if len(passed) else None,
            "torque_jump_predicted": 2 * np.pi * SOFT,
            "created": float(passed["created"].max()) if len(passed) else None,
        },
    }


def _grows_up_to(free: Table) -> float | None:
    """Returns the speed in rad/s up to which more is created at every faster point."""
    if not len(free):
        return None
    falls = np.flatnonzero(np.diff(free["created"]) <= 0)
    return float(free["speed"][falls[0] if falls.size else -1])


def _first_passed(cells: Table, method: str) -> float | None:
    """Returns the slowest speed in rad/s at which the angle passed π in a run; None for none."""
    mine = cells.select((cells["method"] == method) & (cells["crossed"] >= 0))
    return float(mine["speed"].min()) if len(mine) else None


def _fastest(cells: Table, method: str) -> float | None:
    """Returns the speed in rad/s up to which a method is passive at every angle; None for none."""
    mine = cells.select(cells["method"] == method)
    is_good = (mine["environment"] != "active") & (mine["ticks"] == TICKS)
    bad = mine["speed"][~is_good].min(initial=np.inf)
    # at rest nothing moves and nothing can be created: that is no speed
    good = mine["speed"][(mine["speed"] < bad) & (mine["speed"] > 0)]
    return float(good.max()) if good.size else None


def _strict_share(cells: Table, method: str) -> float | None:
    """Returns the share of strict runs below ``gyroscopic_speed``."""
    rows = (cells["method"] == method) & (cells["speed"] < gyroscopic_speed(SOFT))
    return float(np.mean(cells["environment"][rows] == "strict")) if rows.any() else None


def _paragraph(boundary: Mapping[str, Any]) -> str:
    said = [_of_method(name, boundary) for name in METHODS_SHOWN]
    free, cut = boundary["translation_only"], boundary["cut"]
    if free["speed"]:
        usual = int(np.argmin(np.abs(np.asarray(free["speed"]) - TOLD_AT)))
        text = (
            f"Coupled in translation alone, the tool creates {free['created'][usual]:.2g} J in 1 s "
            f"at {free['speed'][usual]:.3g} rad/s, and more the faster up to "
            f"{free['grows_up_to']:.3g} rad/s"
        )
        if free["largest_deviation"] is not None:
            text += (
                f"; up to {free['compared_up_to']:.3g} rad/s, where that is little next to its "
                f"own energy, it is ½T²|ω × Iω|²/I a step "
                f"within {100 * free['largest_deviation']:.2g} %"
            )
        said.append(text)
    if cut["speed_measured"] is not None:
        said.append(
            f"A sudden turn passes the cut at π at {cut['speed_measured']:.4g} rad/s, predicted "
            f"{cut['speed_predicted']:.4g} rad/s"
        )
    if cut["torque_jump"] is not None:
        said.append(
            f"Behind the cut the torque of 'implicit' flips by {cut['torque_jump']:.3g} N m within "
            f"a tick, and it creates {cut['created']:.2g} J at most"
        )
    return f"With K_r = {SOFT:g} N m/rad: " + ". ".join(said) + "."


def _of_method(name: str, boundary: Mapping[str, Any]) -> str:
    fastest, strict = boundary["fastest_passive"][name], boundary["share_strict_below"][name]
    passed = boundary["first_passed"][name]
    if strict is None:
        return f"'{name}': {MISSING}"
    if fastest is None:
        text = f"'{name}' is passive at every angle at no speed shown"
    else:
        text = f"'{name}' is passive, strictly or within its slack, at every angle up to "
        text += f"{fastest:.3g} rad/s"
    text += (
        f", strict in {100 * strict:.0f} % of its runs below {boundary['gyroscopic_speed']:.3g} "
        "rad/s, where the gyroscopic torque reaches what the spring gives at π"
        if name == METHODS_SHOWN[0]
        else f", strict in {100 * strict:.0f} %"
    )
    if passed is None:
        return f"{text}; its angle passes π in no run"
    return f"{text}; its angle first passes π at {passed:.3g} rad/s"


ROTATION = StabilityMap(
    name="rotation",
    about="angular speed of the tool and angle between handle and tool, to the cut at π",
    default_points=1500,
    points=points,
    evaluate=evaluate,
    read=read,
)
