"""Simplifications of a scene: edits that ``lean`` tries and judges."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco

from hapticbridge.check.draft import Draft
from hapticbridge.check.witness import Witness

OTHER_MOTIONS, PICTURE = "in this motion", "with the picture"
"""Losses of a simplification that a hand cannot notice in one motion."""


@dataclass(frozen=True, slots=True)
class Simplification:
    """One edit that reduces the model.

    Attributes:
        name: Short name, for tables.
        sentence: Description of the edit.
        edit: Changes a draft in place; returns False if there was nothing to change.
        loses: Loss that a hand in this motion cannot notice: ``OTHER_MOTIONS``, ``PICTURE`` or
            empty.
    """

    name: str
    sentence: str
    edit: Callable[[Draft], bool]
    loses: str = ""


ITERATIONS = (1, 2, 3, 5, 10, 20, 50)
"""Limits of solver iterations that are tried if a step took more."""

TOLERANCE, LINE_TOLERANCE = 1e-8, 1e-2
"""MuJoCo's default solver tolerances, in its scaled units."""

RATE_DIVISORS = {2: "half", 4: "a quarter of"}
"""Divisors of the rate and their names. A period above 4 ms is slower than any haptic device
requires."""


def solver_simplifications(seen: Witness) -> list[Simplification]:
    """Returns simplifications of the solver."""
    simpler = [
        Simplification(
            "usual tolerance",
            f"the solver stops at MuJoCo's usual tolerances ({TOLERANCE:g}, {LINE_TOLERANCE:g})",
            _relax_tolerance,
        )
    ]
    used = seen.solver_iterations
    return simpler + [_iterations(count, used) for count in ITERATIONS if count < used]


def _iterations(count: int, used: int) -> Simplification:
    def limit(draft: Draft) -> bool:
        option = draft.spec.option
        changed = option.iterations > count
        option.iterations = min(option.iterations, count)
        return bool(changed)

    name = f"{count} iteration{'s' * (count > 1)}"
    return Simplification(name, f"the solver stops after {count} of up to {used}", limit)


def _relax_tolerance(draft: Draft) -> bool:
    option = draft.spec.option
    changed = option.tolerance < TOLERANCE or option.ls_tolerance < LINE_TOLERANCE
    option.tolerance = max(option.tolerance, TOLERANCE)
    option.ls_tolerance = max(option.ls_tolerance, LINE_TOLERANCE)
    return bool(changed)


def rate_simplifications(draft: Draft) -> list[Simplification]:
    """Returns larger time steps: fewer substeps, and lower rates that the device must support."""
    substeps, period = draft.setting.substeps, draft.setting.period
    counts = sorted({1, max(substeps // 2, 1)} - {substeps})
    simpler = [_substeps(count, substeps) for count in counts]
    return simpler + [_rate(divisor, word, period) for divisor, word in RATE_DIVISORS.items()]


def _substeps(count: int, asked: int) -> Simplification:
    def lower(draft: Draft) -> bool:
        changed = draft.setting.substeps > count
        draft.setting = replace(draft.setting, substeps=min(draft.setting.substeps, count))
        return changed

    name = f"{count} substep{'s' * (count > 1)}"
    return Simplification(name, f"MuJoCo takes {count} of {asked} steps a tick", lower)


def _rate(divisor: int, word: str, period: float) -> Simplification:
    slower = divisor * period

    def lower(draft: Draft) -> bool:
        changed = draft.setting.period < slower
        draft.setting = replace(draft.setting, period=max(draft.setting.period, slower))
        return changed

    return Simplification(f"{word} the rate", f"the loop runs at {1 / slower:g} Hz", lower)


def contact_simplifications(seen: Witness) -> list[Simplification]:
    """Returns simplifications of contacts: friction, dimensions, elliptic cone, pairs."""
    return [
        _condim(1, "no friction", "contacts do not resist sliding (condim 1)"),
        _condim(3, "condim 3", "contacts resist sliding, not twisting or rolling"),
        _condim(4, "condim 4", "contacts resist sliding and twisting, not rolling"),
        Simplification(
            "pyramidal cone",
            "friction is limited by a pyramid in place of a cone",
            _make_pyramidal,
        ),
        Simplification(
            "idle geoms",
            "geoms that never came near anything do not collide",
            lambda draft: _drop_idle_geoms(draft.spec, seen),
            loses=OTHER_MOTIONS,
        ),
        Simplification(
            "idle pairs",
            "pairs of bodies that never came near each other are excluded",
            lambda draft: _exclude_idle_bodies(draft.spec, seen),
            loses=OTHER_MOTIONS,
        ),
    ]


def collides(geom: mujoco.MjsGeom) -> bool:
    """Returns True if a geom's masks allow collisions."""
    return bool(geom.contype or geom.conaffinity)


def paired_geoms(spec: mujoco.MjSpec) -> set[str]:
    """Returns the names of geoms in explicit pairs, which collide regardless of their masks."""
    return {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}


def _condim(most: int, name: str, sentence: str) -> Simplification:
    def limit(draft: Draft) -> bool:
        paired, changed = paired_geoms(draft.spec), False
        for geom in draft.spec.geoms:
            if geom.condim > most and (collides(geom) or geom.name in paired):
                geom.condim, changed = most, True
        for pair in draft.spec.pairs:
            if pair.condim > most:
                pair.condim, changed = most, True
        return changed

    return Simplification(name, sentence, limit)


def _make_pyramidal(draft: Draft) -> bool:
    spec = draft.spec
    if spec.option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL:
        return False
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    rubbing = [geom for geom in spec.geoms if collides(geom) and geom.condim > 1]
    return bool(rubbing) or any(pair.condim > 1 for pair in spec.pairs)


def _drop_idle_geoms(spec: mujoco.MjSpec, seen: Witness) -> bool:
    near, changed = seen.near_geoms, False
    for geom in spec.geoms:
        if collides(geom) and geom.name not in near:
            geom.contype = geom.conaffinity = 0
            changed = True
    return changed


def _exclude_idle_bodies(spec: mujoco.MjSpec, seen: Witness) -> bool:
    home = {geom.name: geom.parent.name for geom in spec.geoms if collides(geom)}
    possible, near = (
        {frozenset(home[name] for name in pair) for pair in pairs if pair <= home.keys()}
        for pairs in (seen.possible, seen.near)
    )
    idle = sorted(sorted(pair) for pair in possible - near if len(pair) == 2)
    done = {frozenset((each.bodyname1, each.bodyname2)) for each in spec.excludes}
    new = [pair for pair in idle if frozenset(pair) not in done]
    for first, second in new:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    return bool(new)
