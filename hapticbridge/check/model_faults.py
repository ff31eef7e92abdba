"""Faults of masses: missing, chosen by MuJoCo, too unequal, or too heavy for the coupling."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.case import (
    STAND_IN_INERTIA,
    STAND_IN_MASS,
    CompiledScene,
    Fault,
    SceneUnderCheck,
    length,
    number,
    others,
    weight,
)
from hapticbridge.check.inventory import VISUAL, geom_uses
from hapticbridge.check.physics import (
    body_inertia,
    constraint_stiffness,
    depth_under,
    joint_inertia,
    mesh_of,
)
from hapticbridge.check.source_map import Place, Places
from hapticbridge.kernel.codes import added_actuators
from hapticbridge.kernel.rigid_contact import LAST_RIGID
from hapticbridge.scene import Scene, SceneSource
from hapticbridge.scene.checks import OF_A_JOINT, driven_name, pumps
from hapticbridge.scene.contacts import (
    REFERENCE_STEPS,
    ROUNDING,
    SOFT_STEPS,
    contact_numbers,
    impedance_at,
)

# Faults that are felt at once, and seen without a motion


def worst_faults(source: SceneSource, scene: Scene) -> Iterator[Fault]:
    """Yields faults that make a run feel wrong from its first second.

    These are units, pumps, the strongest of the motors that push, angles and creep.

    They need no motion, so that a run can tell them at its start. The scene is reset.
    """
    loaded = CompiledScene(source, scene, Places(source, scene.model))
    for rule in (_units, _pumps, _strongest_motor, _angles, _frictions):
        scene.reset()
        yield from rule(loaded)


# Faults of joint limits, equality constraints and dry friction

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


def _is_soft(case: SceneUnderCheck, solref: Sequence[float], solimp: Sequence[float]) -> bool:
    numbers = contact_numbers(solref, solimp, float(case.model.opt.timestep))
    return numbers.resolved > SOFT_STEPS * (1 + ROUNDING)


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
            softer = contact_numbers(solref, solimp, float(model.opt.timestep)).softness
            yield Fault(
                "soft equality",
                place,
                f"{place.element} has solref {_numbers(solref)}: it gives {number(softer)} times "
                f'as far as with "{_reference(case)}", and what it joins lags behind',
                f'solref="{_reference(case)}" solimp="0.9 0.95 0.001"',
            )


def _frictions(case: CompiledScene) -> Iterator[Fault]:
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
            _firm_friction(case, CREEP_LOAD * loss, inertia, is_slide=bool(is_slide)),
        )


FIRM_IMPEDANCES = 0.999, 0.9999
"""Impedances that are proposed for dry friction, without unit; MuJoCo takes no larger one."""


def _firm_friction(case: CompiledScene, force: float, inertia: float, *, is_slide: bool) -> str:
    """Returns settings of a joint with which dry friction holds a force, as they are written."""
    solref = REFERENCE_STEPS * float(case.model.opt.timestep), 1.0
    fastest = FASTEST_CREEP if is_slide else FASTEST_TURN
    for impedance in FIRM_IMPEDANCES:
        solimp = impedance, impedance, 0.001
        speed = creep_speed(force, solref, solimp, inertia)
        change = f'solreffriction="{_reference(case)}" solimpfriction="{_listed(solimp)}"'
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
    step = float(case.model.opt.timestep)
    push = case.info.force_limit if is_slide else case.info.torque_limit
    depth = depth_under(push, solref, solimp, inertia, step)
    if depth < (MIN_GIVE if is_slide else MIN_TURN):
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


def _reference(case: CompiledScene) -> str:
    return f"{REFERENCE_STEPS * float(case.model.opt.timestep):g} 1"


def _numbers(values: Sequence[float]) -> str:
    return f'"{_listed(values)}"'


def _listed(values: Sequence[float]) -> str:
    return " ".join(f"{value:g}" for value in values)


# Faults of sizes and shapes: units, filled holes, a distant grip, a small device

UNITS = "units"
"""Kind of the fault of a tool whose sizes or masses no hand could hold."""

LARGEST_TOOL, HEAVIEST_TOOL = 3.0, 50.0
"""Length in m and mass in kg above which no hand holds a tool, so that wrong units are
suspected."""

NARROWEST_RANGE = np.radians(np.pi)
"""Range of a hinge in rad up to which radians read as degrees are suspected: ±π/2 written so. A
hinge that truly turns less is rarely given limits."""

WIDEST_TURN = 8 * np.pi
"""Limit of a hinge in rad beyond which degrees read as radians are suspected: four turns to a side,
more than any hand makes."""

DEEPEST_DENT = 0.02
"""Depth of a mesh's dent below its convex hull, relative to the mesh's largest extent, without
unit. Rounding of vertices and facets stays far below it."""

FARTHEST_GRIP = 1.0
"""Distance from the grip to the tool's centre of mass, relative to the tool's largest extent,
without unit. A grip on the tool itself is at most at 1."""

_AT_ONCE = 1000  # triangles per block; about 100 MB with a hull of 10 000 facets

_SMALLEST_EXTENT = 1e-3  # m; a grip nearer than this counts as on the tool


def geometry_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields faults of sizes and shapes."""
    yield from _units(case)
    yield from _pumps(case)
    yield from _motors(case)
    yield from _angles(case)
    yield from _dented_meshes(case)
    yield from _far_grip(case)
    yield from _workspace(case)


def _units(case: CompiledScene) -> Iterator[Fault]:
    model = case.model
    tool_bodies = _tool_bodies(case)
    mass, extent = float(model.body_mass[tool_bodies].sum()), float(_tool_extent(case).max())
    found = []
    if extent > LARGEST_TOOL:
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
    place = case.places.mesh(meshes[0]) if meshes else case.places.body(body)
    change = 'scale="0.001 0.001 0.001"' if meshes else "its sizes and positions in m, kg"
    yield Fault(
        UNITS,
        place,
        f"the tool {' and '.join(found)}: are these millimetres or grams? MuJoCo counts in m and "
        "kg",
        change,
    )


def _pumps(case: CompiledScene) -> Iterator[Fault]:
    """Finds joints and motors that push what moves already: energy without end."""
    case.scene.reset()
    for pump in pumps(case.model, case.scene.data):
        place = case.places.joint if pump.kind == "joint" else case.places.actuator
        yield Fault("pump", place(pump.number), pump.words, pump.change)


MOTOR_FORCE = 0.1
"""Force in N, or torque in N m, of an actuator at the start from which it is told."""


def _motors(case: CompiledScene) -> Iterator[Fault]:
    """Finds actuators that push at the start with more than holds gravity and springs.

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


def _strongest_motor(case: CompiledScene) -> Iterator[Fault]:
    yield from islice(_motors(case), 1)


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


def _angles(case: CompiledScene) -> Iterator[Fault]:
    """Finds ranges of hinges whose unit is not that of the compiler."""
    model, is_degree = case.model, bool(case.source.spec.compiler.degree)
    for joint in range(model.njnt):
        is_hinge = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        if not is_hinge or not model.jnt_limited[joint]:
            continue
        low, high = (float(limit) for limit in model.jnt_range[joint])
        place = case.places.joint(joint)
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


def _dented_meshes(case: SceneUnderCheck) -> Iterator[Fault]:
    """Finds colliding meshes that are not convex; MuJoCo collides their hulls."""
    model, uses = case.model, geom_uses(case.model)
    reported = set()
    for geom in range(model.ngeom):
        mesh = int(model.geom_dataid[geom])
        is_mesh = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
        if not is_mesh or uses[geom] == VISUAL or mesh in reported:
            continue
        reported.add(mesh)
        vertices, faces = mesh_of(model, mesh)
        dent, filled = dent_of(vertices, faces)
        if dent <= DEEPEST_DENT * float(np.ptp(vertices, axis=0).max()):
            continue
        place = case.places.geom(geom)
        mesh_place = case.places.mesh(mesh)
        more = f" and {number(1e6 * filled)} cm³ of air are filled" if filled > 0 else ""
        yield Fault(
            "mesh not convex",
            place,
            f"{place.element} collides with {mesh_place.element} ({mesh_place.file}:"
            f"{mesh_place.line}), which is not convex: MuJoCo takes its hull, so that a dent or "
            f"hole {length(dent)} deep is closed{more}",
            'contype="0" conaffinity="0", and convex pieces or primitives that collide instead',
        )


def dent_of(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[float, float]:
    """Returns the depth of a mesh's dents below its convex hull, and the volume they hold.

    Args:
        vertices: Shape (n, 3), in m.
        faces: Shape (m, 3).

    Returns:
        Depth in m of the triangle centre that lies deepest inside the hull, and volume of the hull
        minus that of the mesh in m³. The volume is 0 for a surface that is not closed.
    """
    from scipy import spatial  # noqa: PLC0415 - for meshes alone; it is slow to import

    try:
        hull = spatial.ConvexHull(vertices)
    except (spatial.QhullError, ValueError):  # a flat mesh; MuJoCo gives it no volume either
        return 0.0, 0.0
    triangles = vertices[faces]
    dent = 0.0
    for centres in np.array_split(triangles.mean(axis=1), len(faces) // _AT_ONCE + 1):
        inside = -(centres @ hull.equations[:, :3].T + hull.equations[:, 3])
        dent = max(dent, float(inside.min(axis=1).max(initial=0.0)))
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    is_closed = np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    volume = abs(float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum())) / 6.0
    return dent, float(hull.volume) - volume if is_closed else 0.0


def _far_grip(case: SceneUnderCheck) -> Iterator[Fault]:
    model, scene = case.model, case.scene
    scene.reset()
    site = model.site(scene.grip).id
    tool_bodies, body = _tool_bodies(case), int(model.site_bodyid[site])
    mass = model.body_mass[tool_bodies]
    if not mass.sum() > 0:  # it has no centre, and another fault says so
        return
    centre = mass @ scene.data.xipos[tool_bodies] / mass.sum()
    grip = scene.data.site_xpos[site]
    distance = float(np.linalg.norm(grip - centre))
    extent = max(float(np.linalg.norm(_tool_extent(case))), _SMALLEST_EXTENT)
    if distance <= FARTHEST_GRIP * extent:
        return
    rotation = scene.data.xmat[body].reshape(3, 3)
    offset = np.round(rotation.T @ (centre - scene.data.xpos[body]), 6) + 0.0  # no -0
    local = " ".join(f"{v:.4g}" for v in offset)
    place = case.places.site(site)
    yield Fault(
        "far grip",
        place,
        f"{place.element}, the grip, is {length(distance)} from the tool's centre of mass, "
        f"and the tool is {length(extent)} large: every push turns it about a point in the "
        "air",
        f'pos="{local}" (the centre of mass)',
    )


def _workspace(case: SceneUnderCheck) -> Iterator[Fault]:
    extent = float(np.ptp(case.motion.table[:, 1:4], axis=0).max()) / case.scale
    if extent <= case.workspace:
        return
    scale = case.scale * extent / case.workspace
    yield Fault(
        "workspace",
        Place(case.motion_name, 0, "the motion"),
        f"{case.motion_name} moves the handle by {length(extent * case.scale)}, which is "
        f"{length(extent)} of the device at scale {case.scale:g}; it reaches "
        f"{length(case.workspace)}",
        f"a smaller scene, or run it with --scale {np.ceil(100 * scale) / 100:g}",
    )


def _tool_bodies(case: CompiledScene) -> NDArray[np.bool_]:
    model = case.model
    tree = model.body_treeid[model.site(case.scene.grip).bodyid[0]]
    return np.asarray(model.body_treeid == tree, dtype=bool)


def _tool_extent(case: CompiledScene) -> NDArray[np.float64]:
    """Returns the edges in m of the axis-aligned box around the tool's geoms at the start."""
    model, scene = case.model, case.scene
    scene.reset()
    tool_bodies = _tool_bodies(case)
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


WATER = 1000.0
"""Default density of a MuJoCo geom in kg/m³."""

LARGEST_RATIO = 1000.0
"""Largest ratio of two masses in contact, or of a load to its carrier, without unit. A contact has
the stiffness of the lighter body, so the heavier one penetrates a thousand times as deep."""

LARGEST_SAG = 1e-3
"""Largest stretch in m of the coupling under the tool's weight at rest."""


def mass_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields missing, unintended and mismatched masses."""
    for body, refusal in case.refused.items():
        place = case.places.body(body)
        is_none = "mass and" in refusal
        what = "a mass and inertia > 0" if is_none else "inertias with A + B >= C"
        mend = 'mass="…" in one of its geoms, or <inertial pos="0 0 0" mass="…" diaginertia="…"/>'
        stand_in = f"{STAND_IN_MASS:g} kg and {STAND_IN_INERTIA:g} kg m²"
        yield Fault(
            "missing inertia" if is_none else "impossible inertia",
            place,
            f"{place.element} moves, and MuJoCo refuses its inertia: it needs {what}; here it is "
            f"judged with {stand_in} instead",
            mend if is_none else 'the right diaginertia, or balanceinertia="true" in <compiler>',
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
        if len(those) == 1 and solid:
            mend = f'mass="{number(mass)}", or what it really weighs'
            yield _made_of_water(case, body, solid, "density of water", mend)
        elif solid:
            mend = f'mass="…" in each, what it really weighs; now {weight(mass)} together'
            yield _made_of_water(case, body, solid, "density of water", mend)


def _made_of_water(
    case: SceneUnderCheck, body: int, geoms: list[int], kind: str, change: str
) -> Fault:
    place, name = case.places.geom(geoms[0]), case.places.body(body).element
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
        and "density" not in case.places.attributes_at(case.places.geom(geom))
    )


def _contact_ratios(case: SceneUnderCheck) -> Iterator[Fault]:
    model, reported = case.model, set()
    case.scene.reset()
    for pair in case.observation.meetings if case.observation else ():
        bodies = [int(model.geom_bodyid[geom]) for geom in pair]
        inverse = [1.0 / body_inertia(model, case.scene.data, body) for body in bodies]
        key = frozenset(bodies)
        if min(inverse) <= 0 or max(inverse) <= LARGEST_RATIO * min(inverse) or key in reported:
            continue
        reported.add(key)
        light, heavy = (case.places.body(bodies[inverse.index(f(inverse))]) for f in (max, min))
        least = 1.0 / (LARGEST_RATIO * min(inverse))
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
        if load > LARGEST_RATIO * own:
            place, name = case.places.body(parent), case.places.body(body).element
            yield Fault(
                "mass ratio",
                place,
                f"{place.element} ({weight(own)}) carries {name} ({weight(load)}), "
                f"1 to {number(load / own)}: its motion is computed from small differences",
                f'mass="{load / LARGEST_RATIO:.3g}" or more in it',
            )


def _sag(case: SceneUnderCheck) -> Iterator[Fault]:
    """Computes the tool's sag below the handle: (JᵀKJ + K_joints + K_servos) δq = its weight."""
    model, scene = case.model, case.scene
    scene.reset()
    data, site = scene.data, model.site(scene.grip).id
    body = int(model.site_bodyid[site])
    tree = int(model.body_treeid[body])
    dofs = np.flatnonzero(model.dof_treeid == tree)
    jacobian = np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
    coupling = case.coupling
    gains = np.repeat([coupling.stiffness, coupling.rotational_stiffness], 3)
    data.qvel[:] = 0.0
    bias = np.zeros(model.nv)
    mujoco.mj_rne(model, data, 0, bias)
    springs = np.zeros(model.nv)
    for joint in range(model.njnt):
        if model.jnt_type[joint] in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE):
            springs[model.jnt_dofadr[joint]] = float(np.ravel(model.jnt_stiffness[joint])[0])
    for actuator in range(model.nactuator):  # a position servo holds its joint like a spring
        if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT:
            joint = int(model.actuator_trnid[actuator, 0])
            gain = max(-float(model.actuator_biasprm[actuator, 1]), 0.0)
            springs[model.jnt_dofadr[joint]] += gain * float(model.actuator_gear[actuator, 0]) ** 2
    tool_jacobian = jacobian[:, dofs]
    stiffness = tool_jacobian.T @ (gains[:, None] * tool_jacobian) + np.diag(springs[dofs])
    pulls = (data.qfrc_gravcomp - bias)[dofs]
    moved = np.linalg.lstsq(stiffness, pulls, rcond=1e-9)[0]
    sag = float(np.linalg.norm(tool_jacobian[:3] @ moved))
    if sag <= LARGEST_SAG:
        return
    of_tool = np.flatnonzero(model.body_treeid == tree)
    mass = float(model.body_mass[of_tool].sum())
    pull = sag * coupling.stiffness
    yield Fault(
        "heavy tool",
        case.places.body(int(of_tool[0])),  # the first that moves
        f"the tool weighs {weight(mass)}; the part the hand carries, {number(pull)} N, stretches "
        f"the coupling of {coupling.stiffness:.4g} N/m by {length(sag)} at rest; a run carries "
        "it where the device cannot, and with --no-tool-weight",
        'gravcomp="1" in the body and those below it, or less mass',
    )
