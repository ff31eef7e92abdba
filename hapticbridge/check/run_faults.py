"""Faults that appear only in a motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np

from hapticbridge.check.case import Fault, SceneUnderCheck, number
from hapticbridge.check.contact_faults import (
    contact_faults,
    margin_faults,
    shape_faults,
    start_faults,
)
from hapticbridge.check.model_faults import (
    UNITS,
    constraint_faults,
    geometry_faults,
    mass_faults,
)
from hapticbridge.check.observe import Observation
from hapticbridge.check.own_motion import own_motion
from hapticbridge.errors import choices
from hapticbridge.scene import compile_scene
from hapticbridge.scene.checks import check_model, first_pump
from hapticbridge.scene.compile import START_KEYFRAME
from hapticbridge.scene.contacts import suggested_solref

# Faults of a scene's options that the bridge overrides

_OWN_FAULT = "integrator:", "solver:", "start where"  # changes with a fault of their own

_SAME_STEP = 1e-9  # relative: 0.001 as 1/1000


def option_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields a time step that is not the run's, and concerns from loading the scene.

    Integrator, solver and flags that a run needs are set when the scene is loaded
    (``Scene.changes``), so that they are no faults.
    """
    option, places = case.source.spec.option, case.places
    step = float(option.timestep)
    if not case.has_chosen_period and abs(step - case.period) > _SAME_STEP * case.period:
        yield Fault(
            "time step",
            places.option("timestep"),
            f"the scene has a time step of {1e3 * step:g} ms; it runs at {1e3 * case.period:g} ms, "
            f"one step per tick at {1 / case.period:g} Hz, and its contacts change with it",
            f"{places.option_change('timestep', f'{case.period:g}')}, or check with --rate "
            f"{1 / step:g}",
            is_note=True,
        )
    for change in case.scene.changes:
        if not change.startswith(_OWN_FAULT):
            yield Fault(
                "changed",
                places.option("integrator"),
                f"the scene runs with a change, {change}",
                "run --as-is, which refuses the scene",
                is_note=True,
            )
    found = (
        ("wind", case.source.concerns),
        ("surfacevel", check_model(case.model, case.scene.grip)),
    )
    for attribute, concerns in found:
        place = places.with_attribute(attribute) or places.option(attribute)
        for concern in concerns:
            yield Fault("unmetered work", place, concern, f"remove {attribute}")


def own_motion_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields a fault if the scene alone moves noticeably differently than its file says."""
    if case.refused or first_pump(case.model) is not None:
        return  # the file's own scene does not compile, or a pump moves it without bound
    scene = compile_scene(case.source, case.scene.grip, warns=False, checks_start=False)
    found = own_motion(case.source, scene, case.setting)
    place = case.places.option("timestep")
    if found is not None and found.jnd > 1.0:
        yield Fault("own motion", place, str(found), found.remedy(case.setting))
    if found is not None and found.creation:
        yield Fault("own motion", place, found.creation, "--contact rigid or --substeps")


def keyframe_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields a fault if the scene has keyframes but no start among them."""
    names = [str(key.name) for key in case.source.spec.keys]
    if names and START_KEYFRAME not in names:
        listed = choices(name for name in names if name)
        yield Fault(
            "keyframe",
            case.places.named("key", names[0]),
            f"the scene has keyframes ({listed}), but none is called '{START_KEYFRAME}': it starts "
            "from the joints' zeros instead",
            f'name="{START_KEYFRAME}"',
        )


ITERATIONS = 100
"""MuJoCo's default limit of solver iterations. Newton's solver takes 1 to 8 in the shipped
scenes."""

FULL_TICKS = 1e-3
"""Share of a motion's ticks above which a solver at its limit is told, without unit. A hard blow
takes it there in one tick of thousands, whatever the limit."""

LITTLE_DAMPING = 0.001
"""First joint damping in N m s/rad to try if a jointed tool creates energy by itself. It removed
all of it from a bare lever of 36 g; a hand that turns the lever at 1 rad/s feels 1 mN m."""


def run_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields faults that occurred during the motion."""
    seen, option = case.observation, case.places.option
    if seen is None:
        yield Fault(
            "motion not finished",
            option("timestep"),
            f"under {case.motion_name}: {case.motion_fault}",
            "mend the faults above first; if there are none, a softer contact or a heavier tool",
        )
        return
    if seen.full_ticks > FULL_TICKS * case.samples.size:
        limit = int(case.model.opt.iterations)
        if case.is_rigid:  # which raises a lower limit to MuJoCo's
            limit = max(limit, ITERATIONS)
        yield Fault(
            "solver iterations",
            option("iterations"),
            f"the solver stopped at its limit of {limit} iterations in {seen.full_ticks} of "
            f"{case.samples.size} ticks: contact forces are not what they should be",
            case.places.option_change("iterations", f"{max(ITERATIONS, 2 * limit)}"),
        )
    for words, count in seen.warnings.items():
        yield Fault(
            "MuJoCo warning",
            option("timestep"),
            f"MuJoCo warned {count} times in the motion: {words}",
            "follow the warning's advice",
        )
    yield from _falling_bodies(case, seen)
    if seen.environment != "strict" and not np.any(case.model.dof_damping < 0.0):  # told as a pump
        yield _energy_created(case, seen)


FALLING = 0.5
"""Share of the way of a free fall above which a body that nothing holds is told; no unit. A body on
a slope without friction slides less than this down to slopes of 45 degrees."""


def _falling_bodies(case: SceneUnderCheck, seen: Observation) -> Iterator[Fault]:
    """Yields a fault for a free body that fell through the whole motion, ½ g t²."""
    model, gravity = case.model, case.model.opt.gravity
    if len(seen.postures) < 2 or not np.any(gravity):
        return
    seconds = seen.ticks_between_postures * (len(seen.postures) - 1) * case.period
    far = 0.5 * float(np.linalg.norm(gravity)) * seconds**2
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).tolist():
        address = int(model.jnt_qposadr[joint])
        moved = seen.postures[-1, address : address + 3] - seen.postures[0, address : address + 3]
        fallen = float(moved @ gravity / np.linalg.norm(gravity))
        if fallen > FALLING * far:
            place = case.places.body(int(model.jnt_bodyid[joint]))
            yield Fault(
                "falling body",
                place,
                f"nothing holds {place.element}: it fell by {number(fallen)} m in the motion",
                'a floor below it, no joint, or gravcomp="1"',
            )


def _energy_created(case: SceneUnderCheck, seen: Observation) -> Fault:
    """Names the contact with the largest force; the meter cannot tell which created energy."""
    used = f"{number(100 * seen.slack_share)} % of the coupling's slack, which covers it"
    if seen.environment == "active":
        used = "more than the coupling's slack covers"
    sentence = (
        f"contacts or joints created energy in the motion: {used}; a hand that yields, as in a "
        "run, may see less"
    )
    if not seen.meetings or case.is_rigid:
        return _created_without_contact(case, sentence)
    pair = max(seen.meetings, key=lambda each: seen.meetings[each].force)
    one, other = (case.places.geom(geom) for geom in pair)
    return Fault(
        "energy created",
        one,
        f"{sentence}; the largest force was between {one.element} and {other.element}",
        f"{suggested_solref(float(case.model.opt.timestep))} there and at {other.file}:"
        f"{other.line}, {other.element} (four times softer, and slow to come back), or more mass",
    )


def _created_without_contact(case: SceneUnderCheck, sentence: str) -> Fault:
    """Names the tool's joints: their axes turn within a step, the only other source of energy."""
    model = case.model
    tree = model.body_treeid[model.site(case.scene.grip).bodyid[0]]
    tool_joints = np.flatnonzero(model.body_treeid[model.jnt_bodyid] == tree)
    if model.jnt_type[tool_joints[0]] == mujoco.mjtJoint.mjJNT_FREE:
        change, place = "slower springs and actuators", case.places.option("integrator")
    else:
        change = f'damping="{LITTLE_DAMPING:g}" or more there, or slower springs and actuators'
        place = case.places.joint(int(tool_joints[0]))
    return Fault("energy created", place, sentence, change)


# Rules by which a scene is judged

RULES = (
    option_faults,
    own_motion_faults,
    keyframe_faults,
    mass_faults,
    geometry_faults,
    start_faults,
    contact_faults,
    shape_faults,
    margin_faults,
    constraint_faults,
    run_faults,
)
"""Functions that yield the faults of one subject, in the best order for mending."""


def find_faults(case: SceneUnderCheck) -> tuple[Fault, ...]:
    """Returns all faults of a scene from ``open_case``; the scene is reset.

    A tool in wrong units has faults of every kind, so that these wait until it is mended.
    """
    faults = [fault for rule in RULES for fault in rule(case)]
    units = [fault for fault in faults if fault.kind == UNITS]
    if not units or len(faults) == len(units):
        return tuple(faults)
    waiting = f"; {len(faults) - len(units)} more findings wait until this is mended"
    return tuple(replace(fault, sentence=fault.sentence + waiting) for fault in units)
