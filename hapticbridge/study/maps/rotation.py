"""Map ``rotation``: how fast a tool may spin, and what happens where the angle passes π."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hapticbridge.study.maps.rotation_picture import draw
from hapticbridge.study.maps.rotation_runs import METHODS_SHOWN, SOFT, evaluate, points
from hapticbridge.study.maps.stability_map import Finding, StabilityMap, computed
from hapticbridge.study.maps.tumbling import (
    INERTIA,
    PERIOD,
    TICKS,
    cut_speed,
    free_creation,
    gyroscopic_speed,
)
from hapticbridge.study.maps.verdicts import MISSING
from hapticbridge.study.table import Table

TOLD_AT = 50.0
"""Speed in rad/s at which the paragraph says what is created: eight turns a second."""

TELLING = (1e-4, 0.05)
"""Share of the kinetic energy within which creation is compared with theory: above rounding, and
below what changes the motion."""


def read(table: Table) -> Finding:
    """Draws verdicts over speed and angle, creation over speed, and the jump at the cut.

    Raises:
        StudyError: No point was computed at all.
    """
    table = computed(table, "rotation")
    boundary = _boundary(table)
    return Finding(draw(table), _paragraph(boundary), boundary)


def _boundary(table: Table) -> dict[str, Any]:
    cells = table.select(table["what"] == "cell")
    free = table.select((table["what"] == "line") & (table["rotational_stiffness"] == 0))
    predicted = np.array([free_creation(float(speed)) for speed in free["speed"]])
    kinetic = 0.5 * INERTIA[1] * free["speed"] ** 2
    share = predicted / kinetic
    told = (share > TELLING[0]) & (share < TELLING[1])
    created = free.numbers("created")
    ratio = created[told] / predicted[told]
    cuts = table.select(table["what"] == "cut")
    mine = cuts.select(cuts["method"] == "implicit")
    passed = mine.select(mine.numbers("crossed") >= 0)
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
            "created": created.tolist(),
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
            "largest_torque_jump": {name: _largest_jump(cuts, name) for name in METHODS_SHOWN},
            "created": float(passed["created"].max()) if len(passed) else None,
        },
    }


def _largest_jump(cuts: Table, method: str) -> float | None:
    """Returns the largest jump of torque of a method in N m; None where nothing was run."""
    jump = cuts.select(cuts["method"] == method).numbers("torque_jump")
    return float(jump.max()) if jump.size else None


def _grows_up_to(free: Table) -> float | None:
    """Returns the speed in rad/s up to which more is created at every faster point."""
    if not len(free):
        return None
    falls = np.flatnonzero(np.diff(free.numbers("created")) <= 0)
    return float(free["speed"][falls[0] if falls.size else -1])


def _first_passed(cells: Table, method: str) -> float | None:
    """Returns the slowest speed in rad/s at which the angle passed π in a run; None for none."""
    mine = cells.select((cells["method"] == method) & (cells.numbers("crossed") >= 0))
    return float(mine["speed"].min()) if len(mine) else None


def _fastest(cells: Table, method: str) -> float | None:
    """Returns the speed in rad/s up to which a method is passive at every angle; None for none."""
    mine = cells.select(cells["method"] == method)
    is_good = (mine.texts("environment") != "active") & (mine.numbers("ticks") == TICKS)
    bad = mine["speed"][~is_good].min(initial=np.inf)
    # at rest nothing moves and nothing can be created: that is no speed
    good = mine["speed"][(mine["speed"] < bad) & (mine["speed"] > 0)]
    return float(good.max()) if good.size else None


def _strict_share(cells: Table, method: str) -> float | None:
    """Returns the share of strict runs below ``gyroscopic_speed``."""
    rows = (cells["method"] == method) & (cells["speed"] < gyroscopic_speed(SOFT))
    return float(np.mean(cells.texts("environment")[rows] == "strict")) if rows.any() else None


def _paragraph(boundary: Mapping[str, Any]) -> str:
    said = [_of_method(name, boundary) for name in METHODS_SHOWN]
    said += [_of_translation(boundary["translation_only"]), *_of_cut(boundary["cut"])]
    return f"With K_r = {SOFT:g} N m/rad: " + ". ".join(said) + "."


def _of_translation(free: Mapping[str, Any]) -> str:
    if not free["speed"]:
        return f"In translation alone {MISSING}"
    usual = int(np.argmin(np.abs(np.asarray(free["speed"]) - TOLD_AT)))
    text = (
        f"Coupled in translation alone, the tool creates {free['created'][usual]:.2g} J in 1 s "
        f"at {free['speed'][usual]:.3g} rad/s, and more the faster up to "
        f"{free['grows_up_to']:.3g} rad/s"
    )
    if free["largest_deviation"] is None:
        return text
    return (
        f"{text}; up to {free['compared_up_to']:.3g} rad/s, where that is little next to its "
        f"own energy, it is ½T²|ω × Iω|²/I a step within {100 * free['largest_deviation']:.2g} %"
    )


def _of_cut(cut: Mapping[str, Any]) -> list[str]:
    said = []
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
    jumps = cut["largest_torque_jump"]
    if all(jump is None for jump in jumps.values()):
        said.append(f"Of sudden turns {MISSING}")
    if (jumps["weld"] or 0.0) > cut["torque_jump_predicted"]:
        said.append(
            "The gains of a 'weld' are those of the translation; where its angle passes π its "
            f"torque jumps by up to {jumps['weld']:.1g} N m"
        )
    return said


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
