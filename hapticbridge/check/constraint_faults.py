"""Faults of joint limits, equality constraints and dry friction: as soft as MuJoCo's default."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from hapticbridge.check.case import (
    CompiledScene,
    Fault,
    SceneUnderCheck,
    length,
    number,
    numbers,
)
from hapticbridge.kernel.rigid_contact import LAST_RIGID
from hapticbridge.scene.contacts import (
    REFERENCE_STEPS,
    ROUNDING,
    SOFT_STEPS,
    contact_numbers,
    impedance_at,
)
from hapticbridge.scene.physics import (
    constraint_stiffness,
    depth_under,
    joint_inertia,
)

CREEP_LOAD = 0.5
"""Load as a share of the dry friction at which creep is judged, without unit. Creep grows with the
load."""


FASTEST_CREEP, FASTEST_TURN = 1e-4, 1e-3
"""Creep in m/s and rad/s above which dry friction is reported: 1 mm in 10 s, on the axis or 0.1 m
off it. The shipped scenes creep by at most a fifth of it; MuJoCo's default creeps by about 5 mm/s
at 5 N/kg."""


MIN_GIVE, MIN_TURN = 1e-4, 1e-3
"""Penetration in m and rad above which a limit counts as soft, under the device's full force: 0.1
mm, on the axis or 0.1 m off it. The limit of a heavy arm is stiff even with MuJoCo's default."""


def constraint_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields limits, equality constraints and dry friction that are as soft as MuJoCo's default.

    Rigid contact replaces the settings of limits, and of equality constraints but those of a flex.
    """
    case.scene.reset()
    if not case.is_rigid:
        yield from _limits(case)
    yield from _equalities(case)
    yield from friction_faults(case)


def creep_speed(
    force: float, solref: Sequence[float], solimp: Sequence[float], inertia: float
) -> float:
    """Returns the creep speed of dry friction under a force below the friction, in m/s.

        v = F (1 − d) d_w timeconst/(2 d m)

    with the impedance d at depth zero and d_w beyond the width of ``solimp``.

    Args:
        force: F in N; N m for a hinge, which gives a result in rad/s.
        solref: (timeconst in s, dampratio), or (−stiffness in 1/s², −damping in 1/s).
        solimp: MuJoCo's five impedance parameters.
        inertia: m in kg that the joint moves; kg m² for a hinge.
    """
    impedance, last = impedance_at(solimp, 0.0), impedance_at(solimp, np.inf)
    damping = 2.0 / solref[0] if solref[0] > 0 else -float(solref[1])
    return force * (1.0 - impedance) * last / (impedance * inertia * damping)


def _is_soft(case: SceneUnderCheck, solref: Sequence[float], solimp: Sequence[float]) -> bool:
    return contact_numbers(solref, solimp, case.step).resolved > SOFT_STEPS * (1 + ROUNDING)


def _limits(case: SceneUnderCheck) -> Iterator[Fault]:
    model = case.model
    found = []
    for joint in np.flatnonzero(model.jnt_limited).tolist():
        inertia = joint_inertia(model, case.scene.data, int(model.jnt_dofadr[joint]))
        is_slide = bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)
        solver = model.jnt_solref[joint], model.jnt_solimp[joint]
        found.append((case.places.joint(joint), *solver, inertia, is_slide))
    can_move = model.tendon_invweight0 > 0
    for tendon in np.flatnonzero(model.tendon_limited & can_move).tolist():
        solver = model.tendon_solref_lim[tendon], model.tendon_solimp_lim[tendon]
        inertia = 1.0 / float(model.tendon_invweight0[tendon])
        found.append((case.places.tendon(tendon), *solver, inertia, True))
    for place, solref, solimp, inertia, is_slide in found:
        if _is_soft(case, solref, solimp) and (
            words := _depth_words(case, solref, solimp, inertia, is_slide)
        ):
            yield Fault(
                "soft limit",
                place,
                f"the limit of {place.element} {words}",
                f'solreflimit="{_reference(case)}" solimplimit="0.9 0.95 0.001"',
            )


def _equalities(case: SceneUnderCheck) -> Iterator[Fault]:
    model = case.model
    for equality in np.flatnonzero(model.eq_active0).tolist():
        if case.is_rigid and model.eq_type[equality] <= LAST_RIGID:
            continue
        solref, solimp = model.eq_solref[equality], model.eq_solimp[equality]
        if _is_soft(case, solref, solimp):
            place = case.places.equality(equality)
            softer = contact_numbers(solref, solimp, case.step).softness
            yield Fault(
                "soft equality",
                place,
                f'{place.element} has solref "{numbers(solref)}": it gives {number(softer)} times '
                f'as far as with "{_reference(case)}", and what it joins lags behind',
                f'solref="{_reference(case)}" solimp="0.9 0.95 0.001"',
            )


def friction_faults(case: CompiledScene) -> Iterator[Fault]:
    """Yields dry friction that creeps where it should hold."""
    model = case.model
    reported = set()
    for dof in np.flatnonzero(model.dof_frictionloss > 0).tolist():
        joint, solref = int(model.dof_jntid[dof]), model.dof_solref[dof]
        solimp, loss = model.dof_solimp[dof], float(model.dof_frictionloss[dof])
        inertia = joint_inertia(model, case.scene.data, dof)
        speed = creep_speed(CREEP_LOAD * loss, solref, solimp, inertia)
        is_slide = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        if joint in reported or speed <= (FASTEST_CREEP if is_slide else FASTEST_TURN):
            continue
        reported.add(joint)
        moved = f"{length(speed)}/s" if is_slide else f"{number(speed)} rad/s"
        place, unit = case.places.joint(joint), "N" if is_slide else "N m"
        yield Fault(
            "creeping friction",
            place,
            f"the dry friction of {place.element}, {loss:g} {unit}, creeps by {moved} under half "
            f'of it (solref "{numbers(solref)}", impedance {solimp[0]:g}), where it should hold',
            _firm_friction(case, CREEP_LOAD * loss, inertia, is_slide=bool(is_slide)),
        )


FIRM_IMPEDANCES = 0.999, 0.9999
"""Impedances that are proposed for dry friction, without unit; MuJoCo takes no larger one."""


def _firm_friction(case: CompiledScene, force: float, inertia: float, *, is_slide: bool) -> str:
    """Returns settings of a joint with which dry friction holds a force, as they are written."""
    solref = REFERENCE_STEPS * case.step, 1.0
    fastest = FASTEST_CREEP if is_slide else FASTEST_TURN
    for impedance in FIRM_IMPEDANCES:
        solimp = impedance, impedance, 0.001
        speed = creep_speed(force, solref, solimp, inertia)
        change = f'solreffriction="{_reference(case)}" solimpfriction="{numbers(solimp)}"'
        if speed <= fastest:
            return change
    lacking = 1.01 * inertia * (speed / fastest - 1.0)
    unit = "kg" if is_slide else "kg m²"
    return f'{change} armature="{lacking:.2g}" ({unit} of inertia, which the hand feels)'


def _depth_words(
    case: SceneUnderCheck,
    solref: Sequence[float],
    solimp: Sequence[float],
    inertia: float,
    is_slide: bool,
) -> str:
    push = case.info.force_limit if is_slide else case.info.torque_limit
    depth = depth_under(push, solref, solimp, inertia, case.step)
    if depth < (MIN_GIVE if is_slide else MIN_TURN):
        return ""
    stiffness = constraint_stiffness(solref, solimp, inertia, case.step, depth)
    if is_slide:
        amount, deep = f"{number(stiffness)} N/m", f"{push:g} N push {length(depth)} through it"
    else:
        amount, deep = (
            f"{number(stiffness)} N m/rad",
            f"{push:g} N m turn {number(depth)} rad through it",
        )
    return f'amounts to {amount} (solref "{numbers(solref)}"): {deep}'


def _reference(case: CompiledScene) -> str:
    return f"{REFERENCE_STEPS * case.step:g} 1"
