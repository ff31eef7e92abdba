"""Faults of what drives a scene: motors that push from the start on, and pumps of energy."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.case import (
    CompiledScene,
    Fault,
    number,
)
from hapticbridge.kernel.codes import added_actuators
from hapticbridge.scene.checks import OF_A_JOINT, driven_name, pumps


def pump_faults(case: CompiledScene) -> Iterator[Fault]:
    """Yields joints and motors that push what moves already: energy without end."""
    case.scene.reset()
    for pump in pumps(case.model, case.scene.data):
        place = case.places.joint if pump.kind == "joint" else case.places.actuator
        yield Fault("pump", place(pump.number), pump.words, pump.change)


MOTOR_FORCE = 0.1
"""Force in N, or torque in N m, of an actuator at the start from which it is told."""


def motor_faults(case: CompiledScene) -> Iterator[Fault]:
    """Yields actuators that push at the start with more than holds gravity and springs.

    The strongest one comes first.
    """
    model, data = case.model, case.scene.data
    case.scene.reset()
    own = [i for i in range(model.nactuator) if i not in added_actuators(model)]
    parts = {i: _joint_forces(model, data, i) for i in own}
    total = sum(parts.values(), np.zeros(model.nv))
    held = data.qfrc_bias - data.qfrc_passive
    excess = total - np.clip(total, np.minimum(held, 0.0), np.maximum(held, 0.0))
    for actuator in sorted(own, key=lambda i: -float(np.linalg.norm(parts[i]))):
        forces = parts[actuator]
        pushes = np.minimum(np.abs(forces), np.abs(excess)) >= MOTOR_FORCE
        if not np.any(pushes & (forces * excess > 0.0)):
            continue
        force, unit = _motor_force(model, data, actuator)
        name = model.actuator(actuator).name or actuator
        yield Fault(
            "motor",
            case.places.actuator(actuator),
            f"actuator '{name}' pushes {driven_name(model, actuator)} with {number(force)} {unit} "
            "from the start on; no guarantee covers what a motor gives the hand",
            _motor_change(model, data, actuator, is_alone=len(own) == 1),
            is_note=True,
        )


def strongest_motor(case: CompiledScene) -> Iterator[Fault]:
    """Yields the strongest of the motors that push at the start."""
    yield from islice(motor_faults(case), 1)


def _joint_forces(model: mujoco.MjModel, data: mujoco.MjData, actuator: int) -> NDArray[np.float64]:
    """Returns the generalised forces of an actuator in N and N m, (nv,)."""
    found, force = np.zeros(model.nv), float(data.actuator_force[_output(model, actuator)])
    first = int(data.moment_rowadr[_output(model, actuator)])
    row = slice(first, first + int(data.moment_rownnz[_output(model, actuator)]))
    np.add.at(found, data.moment_colind.ravel()[row], data.actuator_moment.ravel()[row] * force)
    return found


def _output(model: mujoco.MjModel, actuator: int) -> int:
    return int(model.actuator_outadr[actuator])


def _motor_force(model: mujoco.MjModel, data: mujoco.MjData, actuator: int) -> tuple[float, str]:
    """Returns the size of an actuator's force on what it drives, and its unit."""
    output, driven = _output(model, actuator), int(model.actuator_trnid[actuator, 0])
    gear, force = model.actuator_gear[output], abs(float(data.actuator_force[output]))
    kind = int(model.actuator_trntype[actuator])
    if kind in OF_A_JOINT:
        is_slide = model.jnt_type[driven] == mujoco.mjtJoint.mjJNT_SLIDE
        return force * float(np.linalg.norm(gear)), "N" if is_slide else "N m"
    if kind == mujoco.mjtTrn.mjTRN_SITE:
        is_force = bool(np.any(gear[:3]))
        return force * float(np.linalg.norm(gear[:3] if is_force else gear[3:])), (
            "N" if is_force else "N m"
        )
    return force * abs(float(gear[0])), "N"


def _motor_change(
    model: mujoco.MjModel, data: mujoco.MjData, actuator: int, *, is_alone: bool
) -> str:
    """Returns what lets an actuator start without force: a motor at 0, a servo at its target."""
    gain, control = float(model.actuator_gainprm[actuator, 0]), model.actuator_ctrladr[actuator]
    is_fixed = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED and gain != 0.0
    is_direct = model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE
    if not (is_fixed and is_direct):
        return "a smaller forcerange, or a start at which it does not push"
    bias = model.actuator_biasprm[actuator] * (
        model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
    )
    length = float(data.actuator_length[_output(model, actuator)])
    rest = -float(bias[0] + bias[1] * length) / gain + 0.0
    name = "" if is_alone else f" of '{model.actuator(actuator).name or actuator}'"
    if model.actuator_ctrllimited[control]:
        low, high = model.actuator_ctrlrange[control]
        if not low <= rest <= high:
            return "a smaller forcerange, or a start at which it does not push"
    return f"ctrl=\"{number(rest)}\"{name} in keyframe 'home', or a smaller forcerange"
