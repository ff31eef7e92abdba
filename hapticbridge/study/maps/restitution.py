"""Map ``restitution``: a rod after one contact of MuJoCo's, against three laws of impact.

No rendering method plays a part: the rod has no handle and no coupling, and what its contact does
is MuJoCo's alone, by integrator and contact setting.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hapticbridge.study.maps.falling_rod import (
    APPROACH,
    INERTIA,
    LENGTH,
    MASS,
    SETTINGS,
    TIP,
    drop,
    restitution_of,
)
from hapticbridge.study.maps.restitution_picture import COLOURS, SLIDE, Summary, draw
from hapticbridge.study.maps.stability_map import Finding, Point, StabilityMap, computed
from hapticbridge.study.maps.verdicts import MISSING
from hapticbridge.study.table import Table
from hapticbridge.theory.impact import ImpactBody, Law, resolve_impact

RESTITUTION_LAWS: tuple[Law, ...] = ("newton", "poisson", "stronge")

FRICTIONS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Coulomb's μ, without unit."""

LEAD = 0.2
"""Share by which a law must be nearer to MuJoCo than the second to be named the nearest, without
unit; with less, laws that a soft contact cannot tell apart would be named by chance."""


def points(count: int) -> Sequence[Point]:
    """Returns every contact setting, friction and slide at angles that make about ``count``."""
    angles = np.linspace(0.05, 1.52, max(2, round(count / (len(SETTINGS) * len(FRICTIONS) * 3))))
    return [
        {"setting": name, "friction": friction, "slide": slide, "angle": float(angle)}
        for name in SETTINGS
        for friction in FRICTIONS
        for slide in (-SLIDE, 0.0, SLIDE)
        for angle in angles
    ]


def evaluate(point: Point) -> Mapping[str, float | int]:
    """Drops a rod on MuJoCo's floor, and resolves the same impact by each law.

    The laws get the e of the contact setting: that of a rod that falls upright without friction,
    where they agree.
    """
    name = str(point["setting"])
    angle, friction, slide = (float(point[key]) for key in ("angle", "friction", "slide"))
    found = drop(name, angle, friction, slide)
    restitution = restitution_of(name)
    results: dict[str, float | int] = {
        "energy_change": found.energy_change,
        "restitution": restitution,
        "own_restitution": found.velocity[1] / APPROACH,
        "first_gain": found.first_gain,
        "steps": found.steps,
        "inelastic": _by_law("poisson", angle, friction, slide, 0.0),
    }
    return results | {
        law: _by_law(law, angle, friction, slide, restitution) for law in RESTITUTION_LAWS
    }


def _by_law(law: Law, angle: float, friction: float, slide: float, restitution: float) -> float:
    arm = [-LENGTH / 2 * np.cos(angle), -LENGTH / 2 * np.sin(angle) - TIP]
    rod = ImpactBody(MASS, INERTIA, arm)
    velocity = [slide, -APPROACH]
    return float(resolve_impact(rod, velocity, friction, restitution, law).energy_change)


def read(table: Table) -> Finding:
    """Draws the energy over the angle, and how far each law is from MuJoCo.

    Raises:
        StudyError: No point was computed at all.
    """
    table = computed(table, "restitution")
    groups = {name: table.select(table["setting"] == name) for name in SETTINGS}
    by_setting = {name: _summary(mine) for name, mine in groups.items() if len(mine)}
    return Finding(draw(table, by_setting), _paragraph(by_setting), {"settings": by_setting})


def _summary(mine: Table) -> Summary:
    measured = mine["energy_change"]
    distances = {law: float(np.sqrt(np.mean((measured - mine[law]) ** 2))) for law in COLOURS}
    return {
        "restitution": float(mine["restitution"][0]),
        "rms_distance_to_law": distances,
        "nearest_law": _nearest(distances),
        "largest_energy_change": float(measured.max()),
        "largest_by_newton": float(mine["newton"].max()),
        "share_that_gained": float(np.mean(mine["first_gain"] >= 0)),
        "at_the_largest": {
            key: float(mine[key][measured.argmax()]) for key in ("angle", "friction", "slide")
        },
        "largest_own_restitution": float(mine["own_restitution"].max()),
    }


def _nearest(distances: Mapping[str, float]) -> str | None:
    """Returns the law that leads the second by more than ``LEAD``; None where none does."""
    first, second = sorted(distances, key=distances.__getitem__)[:2]
    return first if distances[first] < (1 - LEAD) * distances[second] else None


def _paragraph(by_setting: Mapping[str, Summary]) -> str:
    missing = [f"'{name}'" for name in SETTINGS if name not in by_setting]
    said = f"With {', '.join(missing)} {MISSING}. " if missing else ""
    nearest = [row["nearest_law"] for row in by_setting.values()]
    counts = {law: nearest.count(law) for law in dict.fromkeys(nearest)}
    names = {None: "none", "inelastic": "the inelastic one"}
    likeness = ", ".join(
        f"{names.get(law) or str(law).capitalize()} in {count}"
        for law, count in sorted(counts.items(), key=lambda pair: -pair[1])
    )
    gains = [
        f"'{name}' up to {row['largest_energy_change']:+.2g} J"
        for name, row in by_setting.items()
        if row["largest_energy_change"] > 0
    ]
    if "scenes" in by_setting:
        said += _of_the_scenes(by_setting["scenes"])
    own = max(by_setting, key=lambda name: by_setting[name]["largest_own_restitution"])
    by_newton = max(by_setting, key=lambda name: by_setting[name]["largest_by_newton"])
    said += (
        f"Of the {len(by_setting)} settings the law that is nearest by more than {100 * LEAD:.0f} "
        f"% is {likeness}. The largest e of a slanted rod is "
        f"{by_setting[own]['largest_own_restitution']:.2g}, with '{own}', whose upright rod has "
        f"{by_setting[own]['restitution']:.2g}; Newton's law changes the energy by "
        f"{by_setting[by_newton]['largest_by_newton']:+.2g} J at most, with '{by_newton}'. "
    )
    if gains:
        return f"{said}Kinetic energy is created with {', '.join(gains)}."
    return f"{said}No setting created kinetic energy."


def _of_the_scenes(usual: Summary) -> str:
    distances = usual["rms_distance_to_law"]
    return (
        f"With the contact of the scenes a rod that falls upright comes back with e = "
        f"{usual['restitution']:.2g}, and at any angle and friction its energy changes by "
        f"{usual['largest_energy_change']:+.2g} J at most. Laws of impact with that e are "
        f"{1e3 * min(distances[law] for law in RESTITUTION_LAWS):.2g} to "
        f"{1e3 * max(distances[law] for law in RESTITUTION_LAWS):.2g} mJ away (RMS), e = 0 "
        f"{1e3 * distances['inelastic']:.2g} mJ. "
    )


RESTITUTION = StabilityMap(
    name="restitution",
    about="energy of a rod after one contact of MuJoCo's, against the laws of Newton, Poisson and "
    "Stronge",
    default_points=4200,
    points=points,
    evaluate=evaluate,
    read=read,
)
