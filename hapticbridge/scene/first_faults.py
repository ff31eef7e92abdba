"""Faults that are felt from the first second, and seen without a motion: units, drives, creep."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.codes import added_actuators
from hapticbridge.scene.checks import OF_A_JOINT, driven_name, pumps
from hapticbridge.scene.contacts import REFERENCE_STEPS, impedance_at
from hapticbridge.scene.fault import CompiledScene, Fault, length, number, numbers, weight
from hapticbridge.scene.load import SceneSource
from hapticbridge.scene.physics import joint_inertia, tool_masses
from hapticbridge.scene.scene import Scene
from hapticbridge.scene.source import read_elements
from hapticbridge.scene.source_map import Place, Places


def pump_faults(case: CompiledScene) -> Iterator[Fault]:
    """Yields joints and motors that push what moves already: energy without end."""
    case.scene.reset()
    for pump in pumps(case.model, case.scene.data):
        yield Fault("pump", case.places.find(pump.kind, pump.number), pump.words, pump.change)


MOTOR_FORCE = 0.1
"""Force in N, or torque in N m, of an actuator at the start from which it is told."""


def motor_faults(case: CompiledScene) -> Iterator[Fault]:
    """Yields actuators that push at the start with more than holds gravity and springs.

    The strongest one comes first. None pushes that only brakes: against the motion, and without
    force at rest.
    """
    model, data = case.model, case.scene.data
    case.scene.reset()
    own = [i for i in range(model.nactuator) if i not in added_actuators(model)]
    parts = {i: _joint_forces(model, data, i) for i in own}
    brakes = [i for i in own if float(parts[i] @ data.qvel) < 0.0]
    if brakes:
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        brakes = [i for i in brakes if not _joint_forces(model, data, i).any()]
        case.scene.reset()
    own = [i for i in own if i not in brakes]
    total = sum((parts[i] for i in own), np.zeros(model.nv))
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
            case.places.find("actuator", actuator),
            f"actuator '{name}' pushes {driven_name(model, actuator)} with {number(force)} {unit} "
            "from the start on; no guarantee covers what a motor gives the hand",
            _motor_change(model, data, actuator, is_alone=len(own) == 1),
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
    joint = model.jnt_type[driven] if kind in OF_A_JOINT else None
    if joint == mujoco.mjtJoint.mjJNT_BALL:
        return force * float(np.linalg.norm(gear[:3])), "N m"
    if joint == mujoco.mjtJoint.mjJNT_FREE or kind == mujoco.mjtTrn.mjTRN_SITE:
        is_force = bool(np.any(gear[:3]))
        return force * float(np.linalg.norm(gear[:3] if is_force else gear[3:])), (
            "N" if is_force else "N m"
        )
    return force * abs(float(gear[0])), "N m" if joint == mujoco.mjtJoint.mjJNT_HINGE else "N"


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
    return f"ctrl=\"{number(rest)}\"{name} in a keyframe 'home', or a smaller forcerange"


# Units of the tool and of hinges

UNITS = "units"
"""Kind of the fault of a tool whose sizes or masses no hand could hold."""


MAX_TOOL, HEAVIEST_TOOL = 3.0, 50.0
"""Length of a tool in m, and mass in kg of its part that the hand holds, above which wrong units
are suspected: no hand holds that. A robot's arm may hang on a base that weighs more."""


NARROWEST_RANGE = np.radians(np.pi)
"""Range of a hinge in rad up to which radians read as degrees are suspected: ±π/2 written so. A
hinge that truly turns less is rarely given limits."""


WIDEST_TURN = 8 * np.pi
"""Limit of a hinge in rad beyond which degrees read as radians are suspected: four turns to a side,
more than any hand makes."""


def unit_faults(case: CompiledScene) -> Iterator[Fault]:
    """Yields a tool that no hand could hold: its units are probably wrong."""
    model = case.model
    tool_bodies = case.tool_bodies
    mass, extent = tool_masses(model, case.scene.grip)[0], float(tool_extent(case).max())
    found = []
    if extent > MAX_TOOL:
        found.append(f"is {length(extent)} long")
    if mass > HEAVIEST_TOOL:
        found.append(f"weighs {weight(mass)}")
    if not found:
        return
    meshes = [
        int(model.geom_dataid[geom])
        for geom in range(model.ngeom)
        if tool_bodies[model.geom_bodyid[geom]]
        and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
    ]
    body = int(model.body_rootid[model.site(case.scene.grip).bodyid[0]])
    place = case.places.find("mesh", meshes[0]) if meshes else case.places.find("body", body)
    change = 'scale="0.001 0.001 0.001"' if meshes else "its sizes and positions in m, kg"
    yield Fault(
        UNITS,
        place,
        f"the tool {' and '.join(found)}: are these millimetres or grams? MuJoCo counts in m and "
        "kg",
        change,
    )


def angle_faults(case: CompiledScene) -> Iterator[Fault]:
    """Yields ranges of hinges whose unit is not that of the compiler."""
    model, is_degree = case.model, bool(case.source.spec.compiler.degree)
    for joint in range(model.njnt):
        is_hinge = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        if not is_hinge or not model.jnt_limited[joint]:
            continue
        low, high = (float(limit) for limit in model.jnt_range[joint])
        place = case.places.find("joint", joint)
        if is_degree and high - low <= NARROWEST_RANGE:
            written = f"{number(np.degrees(low))} to {number(np.degrees(high))}"
            yield Fault(
                "angle unit",
                place,
                f"{place.element} turns from {written} degrees; are these radians?",
                '<compiler angle="radian"/> in <mujoco>',
            )
        elif not is_degree and max(abs(low), abs(high)) > WIDEST_TURN:
            yield Fault(
                "angle unit",
                place,
                f"{place.element} turns from {number(low)} to {number(high)} radians, which is "
                f"{number(max(abs(low), abs(high)) / (2 * np.pi))} turns; are these degrees?",
                'a range in radians, or <compiler angle="degree"/> in <mujoco>',
            )


def tool_extent(case: CompiledScene) -> NDArray[np.float64]:
    """Returns the edges in m of the axis-aligned box around the tool's geoms at the start."""
    model, scene = case.model, case.scene
    scene.reset()
    tool_bodies = case.tool_bodies
    corners = []
    for geom in range(model.ngeom):
        if (
            tool_bodies[model.geom_bodyid[geom]]
            and model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE
        ):
            centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            rotation = scene.data.geom_xmat[geom].reshape(3, 3)
            middle = scene.data.geom_xpos[geom] + rotation @ centre
            reach = np.abs(rotation) @ half
            corners += [middle - reach, middle + reach]
    return np.ptp(corners, axis=0) if corners else np.zeros(3)


# Dry friction that creeps

CREEP_LOAD = 0.5
"""Load as a share of the dry friction at which creep is judged, without unit. Creep grows with the
load."""


FASTEST_CREEP, FASTEST_TURN = 1e-4, 1e-3
"""Creep in m/s and rad/s above which dry friction is reported: 1 mm in 10 s, on the axis or 0.1 m
off it. The shipped scenes creep by at most a fifth of it; MuJoCo's default creeps by about 5 mm/s
at 5 N/kg."""


def friction_faults(case: CompiledScene) -> Iterator[Fault]:
    """Yields dry friction that creeps where it should hold; none if a flag disables all of it."""
    model, disable = case.model, mujoco.mjtDisableBit
    if model.opt.disableflags & (disable.mjDSBL_FRICTIONLOSS | disable.mjDSBL_CONSTRAINT):
        return
    reported = set()
    for dof in np.flatnonzero(model.dof_frictionloss > 0).tolist():
        joint, solref = int(model.dof_jntid[dof]), model.dof_solref[dof]
        solimp, loss = model.dof_solimp[dof], float(model.dof_frictionloss[dof])
        inertia, viscous = joint_inertia(model, case.scene.data, dof), float(model.dof_damping[dof])
        if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_DIAGEXACT:  # that of the whole step
            inertia += case.step * viscous
        load = CREEP_LOAD * loss
        speed = creep_speed(load, solref, solimp, inertia, viscous)
        is_slide = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        if joint in reported or speed <= (FASTEST_CREEP if is_slide else FASTEST_TURN):
            continue
        reported.add(joint)
        moved = f"{length(speed)}/s" if is_slide else f"{number(speed)} rad/s"
        place, unit = case.places.find("joint", joint), "N" if is_slide else "N m"
        yield Fault(
            "creeping friction",
            place,
            f"the dry friction of {place.element}, {loss:g} {unit}, creeps by {moved} under half "
            f'of it (solref "{numbers(solref)}", impedance {solimp[0]:g}), where it should hold',
            _firm_friction(case, load, inertia, viscous, is_slide=bool(is_slide)),
        )


FIRM_IMPEDANCES = 0.999, 0.9999
"""Impedances that are proposed for dry friction, without unit; MuJoCo takes no larger one."""


def creep_speed(
    force: float,
    solref: Sequence[float],
    solimp: Sequence[float],
    inertia: float,
    viscous: float = 0.0,
) -> float:
    """Returns the creep speed of dry friction under a force below the friction, in m/s.

        v = F/(b + 2 d m/((1 − d) d_w timeconst))

    with the impedance d at depth zero and d_w beyond the width of ``solimp``.

    Args:
        force: F in N; N m for a hinge, which gives a result in rad/s.
        solref: (timeconst in s, dampratio), or (−stiffness in 1/s², −damping in 1/s).
        solimp: MuJoCo's five impedance parameters.
        inertia: m in kg that the joint moves; kg m² for a hinge.
        viscous: Damping b in N s/m of the joint; N m s/rad for a hinge.
    """
    impedance, last = impedance_at(solimp, 0.0), impedance_at(solimp, np.inf)
    damping = 2.0 / solref[0] if solref[0] > 0 else -float(solref[1])
    return force / (viscous + impedance * inertia * damping / ((1.0 - impedance) * last))


def _firm_friction(
    case: CompiledScene, force: float, inertia: float, viscous: float, *, is_slide: bool
) -> str:
    """Returns settings of a joint with which dry friction holds a force, as they are written."""
    solref = REFERENCE_STEPS * case.step, 1.0
    fastest = FASTEST_CREEP if is_slide else FASTEST_TURN
    for impedance in FIRM_IMPEDANCES:
        solimp = impedance, impedance, 0.001
        speed = creep_speed(force, solref, solimp, inertia, viscous)
        change = f'solreffriction="{reference(case)}" solimpfriction="{numbers(solimp)}"'
        if speed <= fastest:
            return change
    lacking = 1.01 * inertia * ((force / fastest - viscous) / (force / speed - viscous) - 1.0)
    unit = "kg" if is_slide else "kg m²"
    return f'{change} armature="{lacking:.2g}" ({unit} of inertia, which the hand feels)'


def reference(case: CompiledScene) -> str:
    """Returns a firm ``solref`` as it is written."""
    return f"{REFERENCE_STEPS * case.step:g} 1"


# Elements of a URDF that MuJoCo's reader drops

DROPPED = ("contact", "gazebo", "transmission", "safety_controller", "sensor", "loop_joint")
"""Elements of a URDF that MuJoCo does not read, whatever they hold."""


def urdf_faults(case: CompiledScene) -> Iterator[Fault]:
    """Yields a fault if the scene is a URDF with elements that MuJoCo drops."""
    source = case.source.sources[0]
    first, *elements = read_elements(source.data)
    dropped = [each for each in elements if each.tag in DROPPED]
    if first.tag != "robot" or not dropped:
        return
    tags = " and ".join(dict.fromkeys(f"<{each.tag}>" for each in dropped))
    yield Fault(
        "URDF",
        Place(source.name, dropped[0].line, f"<{dropped[0].tag}>"),
        f"MuJoCo does not read {tags} of a URDF: what is said there of friction, stiffness, "
        "damping or motors has no effect",
        "the same in MJCF, which mujoco.MjSpec.from_file(FILE).to_xml() makes of the file",
    )


# Rules for the start of a run

AT_ONCE = (unit_faults, pump_faults, strongest_motor, angle_faults, friction_faults, urdf_faults)
"""Rules on faults that are felt from the first second, and seen without a motion."""


def worst_faults(source: SceneSource, scene: Scene) -> Iterator[Fault]:
    """Yields faults that make a run feel wrong from its first second.

    They need no motion, so that a run can tell them at its start. The scene is reset.
    """
    loaded = CompiledScene(source, scene, Places(source, scene.model))
    for rule in AT_ONCE:
        scene.reset()
        yield from rule(loaded)
