"""Faults that appear only in a motion."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from hapticbridge.check.case import Case
from hapticbridge.check.faults import Fault, number
from hapticbridge.check.observation import Observation
from hapticbridge.scene.contact_concerns import suggested_solref

ITERATIONS = 100
"""MuJoCo's default limit of solver iterations. Newton's solver takes 1 to 8 in the shipped
scenes."""

LITTLE_DAMPING = 0.001
"""First joint damping in N m s/rad to try if a jointed tool creates energy by itself. It removed
all of it from a bare lever of 36 g; a hand that turns the lever at 1 rad/s feels 1 mN m."""


def run_faults(case: Case) -> Iterator[Fault]:
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
    if seen.full_ticks:
        limit = int(case.model.opt.iterations)
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
    if seen.environment != "strict":
        yield _energy_created(case, seen)


def _energy_created(case: Case, seen: Observation) -> Fault:
    """Names the contact with the largest force; the meter cannot tell which created energy."""
    used = f"{number(100 * seen.slack_share)} % of the coupling's slack, which covers it"
    if seen.environment == "active":
        used = "more than the coupling's slack covers"
    sentence = f"contacts or joints created energy in the motion: {used}"
    if not seen.meetings:
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


def _created_without_contact(case: Case, sentence: str) -> Fault:
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
