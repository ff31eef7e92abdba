"""Faults that appear only in a motion."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from hapticbridge.check.case import SceneUnderCheck
from hapticbridge.check.observe import Observation
from hapticbridge.scene.checks import unmetered_work
from hapticbridge.scene.contacts import suggested_solref
from hapticbridge.scene.fault import Fault, number
from hapticbridge.scene.physics import STEADY_WAY, WayJump
from hapticbridge.scene.scene import iteration_limit
from hapticbridge.units import format_count

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
            "mend the other findings first, a motor that pushes too; if there is none, a softer "
            "contact or a heavier tool",
        )
        return
    if seen.full_ticks > FULL_TICKS * case.samples.size:
        limit, usual = (
            iteration_limit(case.model, is_rigid=each) for each in (case.is_rigid, True)
        )
        yield Fault(
            "solver iterations",
            option("iterations"),
            f"the solver stopped at its limit of {limit} iterations in {seen.full_ticks} of "
            f"{case.samples.size} ticks: contact forces are not what they should be",
            case.places.option_change("iterations", f"{max(usual, 2 * limit)}"),
        )
    for words, count in seen.warnings.items():
        yield Fault(
            "MuJoCo warning",
            option("timestep"),
            f"MuJoCo warned {format_count(count, 'time')} in the motion: {words}",
            "follow the warning's advice",
        )
    yield from _falling_bodies(case, seen)
    # negative damping is told as a pump, and wind as unmetered work
    is_told = np.any(case.model.dof_damping < 0.0) or unmetered_work(case.model)
    if seen.environment != "strict" and not is_told:
        yield _energy_created(case, seen)


FALLING = 0.5
"""Share of the way of a free fall above which a body that nothing holds is told; no unit. A body on
a slope without friction slides less than this down to slopes of 45 degrees."""


GAINING = 0.4
"""Share of the fall within the first half of the motion below which a body gains speed; no unit. It
is 1/4 in a free fall, and 1/2 of a body that rides down on another one."""


def _falling_bodies(case: SceneUnderCheck, seen: Observation) -> Iterator[Fault]:
    """Yields a fault for a free body that fell through the whole motion, ½ g t²; for no tool."""
    model, gravity = case.model, case.model.opt.gravity
    if len(seen.postures) < 2 or not np.any(gravity):
        return
    seconds = seen.ticks_between_postures * (len(seen.postures) - 1) * case.period
    far = 0.5 * float(np.linalg.norm(gravity)) * seconds**2
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).tolist():
        address, body = int(model.jnt_qposadr[joint]), int(model.jnt_bodyid[joint])
        if case.tool_bodies[body]:
            continue
        ways = seen.postures[:, address : address + 3] - seen.postures[0, address : address + 3]
        falls = ways @ gravity / np.linalg.norm(gravity)
        fallen, half = float(falls[-1]), float(falls[(len(falls) - 1) // 2])
        pulled = 1.0 - float(model.body_gravcomp[body])
        if fallen > FALLING * far * pulled > 0.0 and half < GAINING * fallen:
            place = case.places.find("body", body)
            yield Fault(
                "falling body",
                place,
                f"nothing holds {place.element}: it fell by {number(fallen)} m along gravity "
                "in the motion",
                'a floor in its way, no joint, or gravcomp="1"',
            )


def _energy_created(case: SceneUnderCheck, seen: Observation) -> Fault:
    """Names the contact with the largest force; the meter cannot tell which created energy."""
    kind, used = (
        ("energy created", "more than the coupling's slack covers")
        if seen.environment == "active"
        else (
            "energy in the slack",
            f"{number(100 * seen.slack_share)} % of the coupling's slack, which covers it",
        )
    )
    if seen.jump is not None:
        return _created_by_jump(case, *seen.jump, kind, used)
    sentence = (
        f"contacts or joints created energy in the motion: {used}; a hand that yields, as in a "
        "run, may see less"
    )
    if not seen.meetings or case.is_rigid:
        return _created_without_contact(case, kind, sentence)
    pair = max(seen.meetings, key=lambda each: seen.meetings[each].force)
    one, other = (case.places.find("geom", geom) for geom in pair)
    return Fault(
        kind,
        one,
        f"{sentence}; the largest force was between {one.element} and {other.element}",
        f"{suggested_solref(case.step)} there and at {other.file}:"
        f"{other.line}, {other.element} (four times softer, and slow to come back), or more mass",
    )


def _created_by_jump(
    case: SceneUnderCheck, tendon: int, jump: WayJump, kind: str, used: str
) -> Fault:
    """Names the tendon that jumped: what stretches it at once does no work for that."""
    place = case.places.find("tendon", tendon)
    return Fault(
        kind,
        place,
        f"the {jump.quantity} of {place.element} jumped by {jump.size} in one tick of the motion, "
        f"as its way round a geom changed, and energy was created: {used}",
        STEADY_WAY,
    )


def _created_without_contact(case: SceneUnderCheck, kind: str, sentence: str) -> Fault:
    """Names the tool's joints: their axes turn within a step, the only other source of energy."""
    model = case.model
    tool_joints = np.flatnonzero(case.tool_bodies[model.jnt_bodyid])
    if model.jnt_type[tool_joints[0]] == mujoco.mjtJoint.mjJNT_FREE:
        change, place = "slower springs and actuators", case.places.option("integrator")
    else:
        change = f'damping="{LITTLE_DAMPING:g}" or more there, or slower springs and actuators'
        place = case.places.find("joint", int(tool_joints[0]))
    return Fault(kind, place, sentence, change)
