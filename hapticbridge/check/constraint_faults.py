"""Faults of joint limits, equality constraints and dry friction."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from hapticbridge.check.case import Case
from hapticbridge.check.contact_stiffness import constraint_stiffness, depth_under
from hapticbridge.check.faults import Fault, length, number
from hapticbridge.check.inertia import joint_inertia
from hapticbridge.scene.contact_concerns import SOFT_STEPS
from hapticbridge.scene.contact_rule import REFERENCE_STEPS, ROUNDING, contact_numbers, impedance_at

CREEP_LOAD = 0.5
"""Load as a share of the dry friction at which creep is judged, without unit. Creep grows with the
load."""

FASTEST_CREEP, FASTEST_TURN = 1e-4, 1e-3
"""Creep in m/s and rad/s above which dry friction is reported: 1 mm in 10 s, on the axis or 0.1 m
off it. The shipped scenes creep by at most a fifth of it; MuJoCo's default creeps by about 5 mm/s
at 5 N/kg."""

LEAST_GIVE, LEAST_TURN = 1e-4, 1e-3
"""Penetration in m and rad above which a limit counts as soft, under the device's full force: 0.1
mm, on the axis or 0.1 m off it. The limit of a heavy arm is stiff even with MuJoCo's default."""


def constraint_faults(case: Case) -> Iterator[Fault]:
    """Yields limits, equality constraints and dry friction that are as soft as MuJoCo's default."""
    case.scene.reset()
    yield from _limits(case)
    yield from _equalities(case)
    yield from _frictions(case)


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


def _is_soft(case: Case, solref: Sequence[float], solimp: Sequence[float]) -> bool:
    numbers = contact_numbers(solref, solimp, float(case.model.opt.timestep))
    return numbers.resolved > SOFT_STEPS * (1 + ROUNDING)


def _limits(case: Case) -> Iterator[Fault]:
    model = case.model
    found = []
    for joint in np.flatnonzero(model.jnt_limited).tolist():
        inertia = joint_inertia(model, case.scene.data, int(model.jnt_dofadr[joint]))
        is_slide = bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)
        solver = model.jnt_solref[joint], model.jnt_solimp[joint]
        found.append((case.places.joint(joint), *solver, inertia, is_slide))
    for tendon in np.flatnonzero(model.tendon_limited).tolist():
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


def _equalities(case: Case) -> Iterator[Fault]:
    model = case.model
    for equality in np.flatnonzero(model.eq_active0).tolist():
        solref, solimp = model.eq_solref[equality], model.eq_solimp[equality]
        if _is_soft(case, solref, solimp):
            place = case.places.equality(equality)
            softer = contact_numbers(solref, solimp, float(model.opt.timestep)).softness
            yield Fault(
                "soft equality",
                place,
                f"{place.element} has solref {_numbers(solref)}: it gives {number(softer)} times "
                f'as far as with "{_reference(case)}", and what it joins lags behind',
                f'solref="{_reference(case)}" solimp="0.9 0.95 0.001"',
            )


def _frictions(case: Case) -> Iterator[Fault]:
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
            f"of it (solref {_numbers(solref)}, impedance {solimp[0]:g}), where it should hold",
            f'solreffriction="{_reference(case)}" solimpfriction="0.999 0.999 0.001"',
        )


def _depth_words(
    case: Case, solref: Sequence[float], solimp: Sequence[float], inertia: float, is_slide: bool
) -> str:
    step = float(case.model.opt.timestep)
    push = case.info.force_limit if is_slide else case.info.torque_limit
    depth = depth_under(push, solref, solimp, inertia, step)
    if depth < (LEAST_GIVE if is_slide else LEAST_TURN):
        return ""
    stiffness = constraint_stiffness(solref, solimp, inertia, step, depth)
    if is_slide:
        amount, deep = f"{number(stiffness)} N/m", f"{push:g} N push {length(depth)} through it"
    else:
        amount, deep = (
            f"{number(stiffness)} N m/rad",
            f"{push:g} N m turn {number(depth)} rad through it",
        )
    return f"amounts to {amount} (solref {_numbers(solref)}): {deep}"


def _reference(case: Case) -> str:
    return f"{REFERENCE_STEPS * float(case.model.opt.timestep):g} 1"


def _numbers(values: Sequence[float]) -> str:
    return f'"{" ".join(f"{value:g}" for value in values)}"'
