"""Faults of joint limits, equality constraints and dry friction: as soft as MuJoCo's default."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from hapticbridge.check.case import SceneUnderCheck
from hapticbridge.kernel.rigid_contact import LAST_RIGID
from hapticbridge.scene.contacts import (
    ROUNDING,
    SOFT_STEPS,
    contact_numbers,
)
from hapticbridge.scene.fault import Fault, length, number, numbers
from hapticbridge.scene.first_faults import friction_faults, reference
from hapticbridge.scene.physics import (
    constraint_stiffness,
    depth_under,
    joint_inertia,
)

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


def _is_soft(case: SceneUnderCheck, solref: Sequence[float], solimp: Sequence[float]) -> bool:
    return contact_numbers(solref, solimp, case.step).resolved > SOFT_STEPS * (1 + ROUNDING)


def _limits(case: SceneUnderCheck) -> Iterator[Fault]:
    model = case.model
    found = []
    for joint in np.flatnonzero(model.jnt_limited).tolist():
        inertia = joint_inertia(model, case.scene.data, int(model.jnt_dofadr[joint]))
        is_slide = bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)
        solver = model.jnt_solref[joint], model.jnt_solimp[joint]
        found.append((case.places.find("joint", joint), *solver, inertia, is_slide))
    can_move = model.tendon_invweight0 > 0
    for tendon in np.flatnonzero(model.tendon_limited & can_move).tolist():
        solver = model.tendon_solref_lim[tendon], model.tendon_solimp_lim[tendon]
        inertia = 1.0 / float(model.tendon_invweight0[tendon])
        found.append((case.places.find("tendon", tendon), *solver, inertia, True))
    for place, solref, solimp, inertia, is_slide in found:
        if _is_soft(case, solref, solimp) and (
            words := _depth_words(case, solref, solimp, inertia, is_slide)
        ):
            yield Fault(
                "soft limit",
                place,
                f"the limit of {place.element} {words}",
                f'solreflimit="{reference(case)}" solimplimit="0.9 0.95 0.001"',
            )


def _equalities(case: SceneUnderCheck) -> Iterator[Fault]:
    model = case.model
    for equality in np.flatnonzero(model.eq_active0).tolist():
        if case.is_rigid and model.eq_type[equality] <= LAST_RIGID:
            continue
        solref, solimp = model.eq_solref[equality], model.eq_solimp[equality]
        if _is_soft(case, solref, solimp):
            place = case.places.find("equality", equality)
            softer = contact_numbers(solref, solimp, case.step).softness
            yield Fault(
                "soft equality",
                place,
                f'{place.element} has solref "{numbers(solref)}": it gives {number(softer)} times '
                f'as far as with "{reference(case)}", and what it joins lags behind',
                f'solref="{reference(case)}" solimp="0.9 0.95 0.001"',
            )


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
