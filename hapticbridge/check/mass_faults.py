"""Faults of masses: missing, chosen by MuJoCo, too unequal, or too heavy for the coupling."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from hapticbridge.check.case import STAND_IN_INERTIA, STAND_IN_MASS, SceneUnderCheck
from hapticbridge.demand.rehearsal import rehearsal_parameters
from hapticbridge.errors import SceneError
from hapticbridge.kernel.codes import held_body
from hapticbridge.scene.fault import Fault, length, number, others, weight
from hapticbridge.scene.handle import tied_trees
from hapticbridge.scene.physics import body_inertia
from hapticbridge.scene.rehearsal import along, static_load, wrench_sizes
from hapticbridge.units import format_degrees, format_number

WATER = 1000.0
"""Default density of a MuJoCo geom in kg/m³."""


MAX_RATIO = 1000.0
"""Largest ratio of two masses in contact, or of a load to its carrier, without unit. A contact has
the stiffness of the lighter body, so the heavier one penetrates a thousand times as deep."""


MAX_SAG, MAX_DROOP = 1e-3, 0.05
"""Largest stretch in m and turn in rad of the coupling under the tool's weight at rest. With the
usual coupling they are a quarter of the usual force and torque limits, 2.4 N and 0.12 N m."""


def mass_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields missing, unintended and mismatched masses."""
    for body, refusal in case.refused.items():
        place = case.places.find("body", body)
        is_none = "mass and" in refusal
        what = "a mass and inertia > 0" if is_none else "inertias with A + B >= C"
        mend = 'mass="…" in one of its geoms, or <inertial pos="0 0 0" mass="…" diaginertia="…"/>'
        stand_in = f"{STAND_IN_MASS:g} kg and {STAND_IN_INERTIA:g} kg m²"
        yield Fault(
            "missing inertia" if is_none else "impossible inertia",
            place,
            f"{place.element} moves, and MuJoCo refuses its inertia: it needs {what}; here it is "
            f"judged with {stand_in} instead",
            mend if is_none else 'the right inertia, or balanceinertia="true" in <compiler>',
        )
    yield from _default_densities(case)
    yield from _contact_ratios(case)
    yield from _load_ratios(case)
    yield from _sag(case)


def _default_densities(case: SceneUnderCheck) -> Iterator[Fault]:
    """Finds moving bodies with a geom that has the default density."""
    model, geoms = case.model, list(case.source.spec.geoms)
    if len(geoms) != model.ngeom:  # the compiler dropped some, so ids do not match
        return
    if case.source.spec.compiler.settotalmass > 0:  # the file states the mass of all together
        return
    silent: dict[int, list[int]] = {}
    for geom, written in enumerate(geoms):
        body = int(model.geom_bodyid[geom])
        is_free_to_move = model.body_treeid[body] >= 0 and body not in case.refused
        if is_free_to_move and _sets_no_mass(case, geom, written):
            silent.setdefault(body, []).append(geom)
    for body, those in silent.items():
        collides = (model.geom_contype[those] | model.geom_conaffinity[those]) != 0
        visual, solid = (np.array(those)[each].tolist() for each in (~collides, collides))
        mass = float(model.body_mass[body])
        if visual:
            yield _made_of_water(case, body, visual, "visual geom with mass", 'mass="0"')
        if solid:
            rest = np.setdiff1d(np.flatnonzero(model.geom_bodyid == body), those)
            mend = f'mass="…"{" in each" * (len(those) > 1)}, what it really weighs'
            if all(geoms[geom].mass == 0.0 for geom in rest):
                mend = f"{mend}; now {weight(mass)} together"
                if len(those) == 1:
                    mend = f'mass="{number(mass)}", or what it really weighs'
            yield _made_of_water(case, body, solid, "density of water", mend)


def _made_of_water(
    case: SceneUnderCheck, body: int, geoms: list[int], kind: str, change: str
) -> Fault:
    place, name = case.places.find("geom", geoms[0]), case.places.find("body", body).element
    made = "has neither mass nor density and so is made of water"
    if len(geoms) > 1:
        made = "have neither mass nor density and so are made of water"
    return Fault(
        kind,
        place,
        f"{place.element}{others(len(geoms) - 1)} {made} ({WATER:g} kg/m³); {name} "
        f"weighs {weight(float(case.model.body_mass[body]))} with it",
        change,
    )


def _sets_no_mass(case: SceneUnderCheck, geom: int, written: Any) -> bool:
    compiler = case.source.spec.compiler
    low, high = compiler.inertiagrouprange
    return bool(
        np.isnan(written.mass)
        and written.density == WATER
        and low <= written.group <= high
        and not written.parent.explicitinertial
        and not case.places.may_set("geom", "density", case.places.find("geom", geom))
    )


def _contact_ratios(case: SceneUnderCheck) -> Iterator[Fault]:
    model, reported = case.model, set()
    case.scene.reset()
    for pair in case.observation.meetings if case.observation else ():
        bodies = [int(model.geom_bodyid[geom]) for geom in pair]
        inverse = [1.0 / body_inertia(model, case.scene.data, body) for body in bodies]
        key = frozenset(bodies)
        if min(inverse) <= 0 or max(inverse) <= MAX_RATIO * min(inverse) or key in reported:
            continue
        reported.add(key)
        light, heavy = (
            case.places.find("body", bodies[inverse.index(f(inverse))]) for f in (max, min)
        )
        least = 1.0 / (MAX_RATIO * min(inverse))
        yield Fault(
            "mass ratio",
            light,
            f"{light.element} ({weight(1 / max(inverse))}) meets {heavy.element} "
            f"({weight(1 / min(inverse))}), 1 to {number(max(inverse) / min(inverse))}: the "
            "contact is as stiff as the lighter one allows, and the heavier sinks in",
            f'mass="{number(least)}" or more, or armature="{number(least)}" on its joint',
        )


def _load_ratios(case: SceneUnderCheck) -> Iterator[Fault]:
    model = case.model
    for body in range(1, model.nbody):
        parent = int(model.body_weldid[model.body_parentid[body]])
        if not model.body_dofnum[body] or model.body_treeid[parent] < 0:
            continue
        own = float(model.body_mass[model.body_weldid == parent].sum())
        dofs = model.dof_bodyid == parent
        if np.any(model.dof_armature[dofs] > 0):
            continue
        load = float(model.body_subtreemass[body])
        if load > MAX_RATIO * own:
            place, name = case.places.find("body", parent), case.places.find("body", body).element
            yield Fault(
                "mass ratio",
                place,
                f"{place.element} ({weight(own)}) carries {name} ({weight(load)}), "
                f"1 to {number(load / own)}: its motion is computed from small differences",
                f'mass="{format_number(load / MAX_RATIO, 3)}" or more in it',
            )


def _sag(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields a weight that stretches or turns the coupling far, as a run measures it at its start.

    Contacts, limits and dry friction hold nothing, as where the hand lifts the tool. Bodies of
    other trees that active welds and connects tie to the tool hang on it.
    """
    model, scene, coupling = case.model, case.scene, case.coupling
    own = int(model.body_treeid[held_body(model, scene.grip)])
    tied = [tree for tree in tied_trees(model, own) if tree != own]
    bodies = case.tool_bodies | np.isin(model.body_treeid, tied)
    try:
        trial = scene.for_trial()
        parameters = rehearsal_parameters(trial, case.setting)
        load = static_load(trial, parameters, is_lifted=True)
        others = static_load(trial, parameters, is_lifted=True, has_weight=False)
        load -= others
    except SceneError:  # another finding says why it cannot be stepped
        return
    force, torque = wrench_sizes(load)
    sag = force / coupling.stiffness
    droop = torque / coupling.rotational_stiffness if coupling.rotational_stiffness else 0.0
    parts = []
    if sag > MAX_SAG:
        parts.append(
            f"{number(force)} N, which stretches the coupling of "
            f"{format_number(coupling.stiffness)} N/m by {length(sag)}"
        )
    if droop > MAX_DROOP:
        parts.append(
            f"{number(torque)} N m about the grip, which turns the "
            f"coupling of {format_number(coupling.rotational_stiffness)} N m/rad by "
            f"{format_degrees(droop, 2)}"
        )
    if not parts:
        return
    of_tool = np.flatnonzero(case.tool_bodies)
    mass = float(model.body_mass[bodies].sum())
    what, where = "the tool", "the body and those below it"
    if tied:
        what, where = "the tool, with what is tied to it,", f"{where}, and in those tied to it"
    does = "; a run carries it where the device cannot, and with --no-tool-weight"
    part = 0 if sag > MAX_SAG else 1
    left = static_load(trial.with_tool_carried(), parameters, is_lifted=True) - others
    if 2.0 * along(left, load)[part] > wrench_sizes(load)[part]:
        does, where = ", most of it from bodies that hang on the tool", "those that hang on it"
    yield Fault(
        "heavy tool",
        case.places.find("body", int(of_tool[0])),  # the first that moves
        f"{what} weighs {weight(mass)}; where no contact, limit, equality, dry friction or "
        f"motor carries it, the hand carries {' and '.join(parts)} at rest{does}",
        f'gravcomp="1" in {where}, or less mass'
        + (", or a grip nearer to the centre of mass" if droop > MAX_DROOP else ""),
    )
