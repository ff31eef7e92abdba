"""Simplifications of a scene: edits that ``lean`` tries and judges."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import PurePath

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from hapticbridge.check.version import MotionTrace, SceneVariant, census, model_of
from hapticbridge.scene.compile import unfused_model
from hapticbridge.scene.physics import IDENTITY, matrix_of, pose_in, quaternion_of, rotation_vector
from hapticbridge.units import format_count

OTHER_MOTIONS, PICTURE = "in this motion", "with the picture"
"""Losses of a simplification that a hand cannot notice in one motion."""


@dataclass(frozen=True, slots=True)
class Simplification:
    """One edit that reduces the model.

    Attributes:
        name: Short name, for tables.
        sentence: Description of the edit.
        edit: Changes a draft in place; returns False if there was nothing to change.
        loses: Loss that a hand in this motion cannot notice: ``OTHER_MOTIONS``, ``PICTURE`` or
            empty.
    """

    name: str
    sentence: str
    edit: Callable[[SceneVariant], bool]
    loses: str = ""


ITERATIONS = (1, 2, 3, 5, 10, 20, 50)
"""Limits of solver iterations that are tried if a step took more."""

TOLERANCE, LINE_TOLERANCE = 1e-8, 1e-2
"""MuJoCo's default solver tolerances, in its scaled units."""

RATE_DIVISORS = {2: "half", 4: "a quarter of"}
"""Divisors of the rate and their names. A period above 4 ms is slower than any haptic device
requires."""


def solver_simplifications(seen: MotionTrace) -> list[Simplification]:
    """Returns simplifications of the solver."""
    simpler = [
        Simplification(
            "usual tolerance",
            f"the solver stops at MuJoCo's usual tolerances ({TOLERANCE:g}, {LINE_TOLERANCE:g})",
            _relax_tolerance,
        )
    ]
    used = seen.solver_iterations
    return simpler + [_iterations(count, used) for count in ITERATIONS if count < used]


def _iterations(count: int, used: int) -> Simplification:
    def limit(draft: SceneVariant) -> bool:
        option = draft.spec.option
        if draft.setting.contact == "rigid" or option.iterations <= count:
            return False  # rigid contact raises the limit again
        option.iterations = count
        return True

    name = format_count(count, "iteration")
    return Simplification(name, f"the solver stops after {count} of up to {used}", limit)


def _relax_tolerance(draft: SceneVariant) -> bool:
    option = draft.spec.option
    changed = option.tolerance < TOLERANCE or option.ls_tolerance < LINE_TOLERANCE
    option.tolerance = max(option.tolerance, TOLERANCE)
    option.ls_tolerance = max(option.ls_tolerance, LINE_TOLERANCE)
    return bool(changed)


def rate_simplifications(draft: SceneVariant) -> list[Simplification]:
    """Returns larger time steps: fewer substeps, and lower rates that the device must support."""
    substeps, period = draft.setting.substeps, draft.setting.period
    counts = sorted({1, max(substeps // 2, 1)} - {substeps})
    simpler = [_substeps(count, substeps) for count in counts]
    return simpler + [_rate(divisor, word, period) for divisor, word in RATE_DIVISORS.items()]


def _substeps(count: int, present: int) -> Simplification:
    def lower(draft: SceneVariant) -> bool:
        changed = draft.setting.substeps > count
        draft.setting = replace(draft.setting, substeps=min(draft.setting.substeps, count))
        return changed

    name = format_count(count, "substep")
    return Simplification(name, f"MuJoCo takes {count} of {present} steps a tick", lower)


def _rate(divisor: int, word: str, period: float) -> Simplification:
    slower = divisor * period

    def lower(draft: SceneVariant) -> bool:
        changed = draft.setting.period < slower
        draft.setting = replace(draft.setting, period=max(draft.setting.period, slower))
        return changed

    return Simplification(f"{word} the rate", f"the loop runs at {1 / slower:g} Hz", lower)


def contact_simplifications(seen: MotionTrace) -> list[Simplification]:
    """Returns simplifications of contacts: friction, dimensions, elliptic cone, pairs."""
    return [
        _condim(1, "no friction", "contacts do not resist sliding (condim 1)"),
        _condim(3, "condim 3", "contacts resist sliding, not twisting or rolling"),
        _condim(4, "condim 4", "contacts resist sliding and twisting, not rolling"),
        Simplification(
            "pyramidal cone", "friction is limited by a pyramid in place of a cone", _make_pyramidal
        ),
        Simplification(
            "idle geoms",
            "geoms that never came near anything do not collide",
            lambda draft: _drop_idle_geoms(draft.spec, seen),
            loses=OTHER_MOTIONS,
        ),
        Simplification(
            "idle pairs",
            "pairs of bodies that never came near each other are excluded",
            lambda draft: _exclude_idle_bodies(draft.spec, seen),
            loses=OTHER_MOTIONS,
        ),
    ]


def collides(geom: mujoco.MjsGeom) -> bool:
    """Returns True if a geom's masks allow collisions."""
    return bool(geom.contype or geom.conaffinity)


def paired_geoms(spec: mujoco.MjSpec) -> set[str]:
    """Returns the names of geoms in explicit pairs, which collide regardless of their masks."""
    return {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}


def _condim(most: int, name: str, sentence: str) -> Simplification:
    def limit(draft: SceneVariant) -> bool:
        paired, changed = paired_geoms(draft.spec), False
        for geom in draft.spec.geoms:
            if geom.condim > most and (collides(geom) or geom.name in paired):
                geom.condim, changed = most, True
        for pair in draft.spec.pairs:
            if pair.condim > most:
                pair.condim, changed = most, True
        return changed

    return Simplification(name, sentence, limit)


def _make_pyramidal(draft: SceneVariant) -> bool:
    spec = draft.spec
    if draft.setting.contact == "rigid" or spec.option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL:
        return False  # rigid contact makes the cone elliptic again
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    rubbing = [geom for geom in spec.geoms if collides(geom) and geom.condim > 1]
    return bool(rubbing) or any(pair.condim > 1 for pair in spec.pairs)


def _drop_idle_geoms(spec: mujoco.MjSpec, seen: MotionTrace) -> bool:
    near, changed = seen.near_geoms, False
    for geom in spec.geoms:
        if collides(geom) and geom.name not in near:
            geom.contype = geom.conaffinity = 0
            changed = True
    return changed


def _exclude_idle_bodies(spec: mujoco.MjSpec, seen: MotionTrace) -> bool:
    home = {geom.name: geom.parent.name for geom in spec.geoms if collides(geom)}
    possible, near = (
        {frozenset(home[name] for name in pair) for pair in pairs if pair <= home.keys()}
        for pairs in (seen.possible, seen.near)
    )
    idle = sorted(sorted(pair) for pair in possible - near if len(pair) == 2)
    done = {frozenset((each.bodyname1, each.bodyname2)) for each in spec.excludes}
    new = [pair for pair in idle if frozenset(pair) not in done]
    for first, second in new:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    return bool(new)


# Simplifications of joints: fixed joints, and free joints replaced by their used axes

HARDLY_FAR, HARDLY_TURNED = 5e-4, 1e-2
"""Travel in m and rad up to which fixing a joint is tried. With a grip held by the default coupling
(2400 N/m, 2.4 N m/rad) it amounts to 1.2 N and 24 mN m. The felt error decides; larger values would
be tried in vain."""

MAX_JOINTS = 8
"""Largest number of nearly still joints that are fixed one by one; more are fixed together."""

_FREE, _BALL = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
_SLIDE, _HINGE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
_AXES = "xyz"

Array = NDArray[np.float64]
Keys = list[dict[str, tuple[Array, Array]]]
"""Position and velocity by joint, for each keyframe."""


def freedom_simplifications(draft: SceneVariant, seen: MotionTrace) -> list[Simplification]:
    """Returns the joints to fix and the free joints to replace, as the motion allows."""
    still, simpler = [], []
    for joint in draft.spec.joints:
        way = np.abs(seen.travel[joint.name]).max(axis=0)
        if joint.type == _FREE:
            far, turned = way[:3] > HARDLY_FAR, way[3:] > HARDLY_TURNED
            if not far.any() and not turned.any():
                still.append(str(joint.name))
            else:
                simpler += _replacements(str(joint.name), far, turned, seen)
        elif way.max() <= (HARDLY_FAR if joint.type == _SLIDE else HARDLY_TURNED):
            still.append(str(joint.name))
    groups = [[name] for name in still] if len(still) <= MAX_JOINTS else [still]
    return [_fixed(group, seen) for group in groups] + simpler


def _fixed(names: list[str], seen: MotionTrace) -> Simplification:
    def fix(spec: mujoco.MjSpec, keys: Keys) -> bool:
        fixed = [_fix(spec, keys, name, seen) for name in names]
        return any(fixed)

    what = f"'{names[0]}'" if len(names) == 1 else f"{len(names)} joints"
    return Simplification(
        f"{what} fixed",
        f"{what} hardly moved and stays where it started",
        lambda draft: _edit_joints(draft, fix),
        loses=OTHER_MOTIONS,
    )


def _fix(spec: mujoco.MjSpec, keys: Keys, name: str, seen: MotionTrace) -> bool:
    joint = spec.joint(name)
    if joint is None:
        return False
    body = joint.parent
    if len(list(body.joints)) > 1:
        # fixing it away from its reference would turn the axes of the joints before it
        if joint.type == _BALL or abs(seen.start[name][0] - joint.ref) > 1e-12:
            return False
    else:
        _place(spec, body, seen.pose[body.name])
    spec.delete(joint)
    for key in keys:
        key.pop(name)
    return True


def _replacements(name: str, far: Array, turned: Array, seen: MotionTrace) -> list[Simplification]:
    """Returns replacements by the used axes alone, and by all three slides with the used hinge."""
    if turned.sum() > 1:
        return []
    hinge = [int(axis) for axis in np.flatnonzero(turned)]
    slides = [int(axis) for axis in np.flatnonzero(far)]
    choices = [slides] if len(slides) == 3 else [slides, [0, 1, 2]]
    return [_replaced(name, each, hinge, seen) for each in choices]


def _replaced(name: str, slides: list[int], hinges: list[int], seen: MotionTrace) -> Simplification:
    def replace(spec: mujoco.MjSpec, keys: Keys) -> bool:
        joint = spec.joint(name)
        if joint is None or joint.type != _FREE or _is_special(spec, joint):
            return False
        body, start = joint.parent, seen.start[name]
        _place(spec, body, seen.pose[body.name])
        spec.delete(joint)
        turn = matrix_of(start[3:])
        new = [(f"{name}_{_AXES[a]}", _SLIDE, a) for a in slides]
        new += [(f"{name}_turn_{_AXES[a]}", _HINGE, a) for a in hinges]
        for new_name, kind, axis in new:
            _add_joint(body, new_name, kind, turn.T @ np.eye(3)[axis])
        for key in keys:
            position, velocity = _in_world(*key.pop(name), start)
            for new_name, kind, axis in new:
                at = axis + 3 * (kind == _HINGE)
                key[new_name] = position[at : at + 1], velocity[at : at + 1]
        return True

    words = [f"slides along {''.join(_AXES[a] for a in slides)}"] if slides else []
    words += [f"turns about {_AXES[a]}" for a in hinges]
    return Simplification(
        f"'{name}' {' and '.join(words)}",
        f"the free joint has only the axes it used: it {' and '.join(words)}",
        lambda draft: _edit_joints(draft, replace),
        loses=OTHER_MOTIONS,
    )


def _is_special(spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> bool:
    """Returns True for a free joint with properties that slides and hinges cannot take over."""
    loads = (joint.stiffness, joint.damping, [joint.armature, joint.frictionloss])
    aligned = mujoco.mjtAlignFree.mjALIGNFREE_TRUE
    return (
        any(np.any(np.asarray(load)) for load in loads)
        or joint.align == aligned
        or bool(spec.compiler.alignfree)
        or len(list(joint.parent.joints)) > 1
    )


def _add_joint(body: mujoco.MjsBody, name: str, kind: mujoco.mjtJoint, axis: Array) -> None:
    """Adds a joint with every field set; a user's ``<default>`` class would fill unset fields."""
    joint = body.add_joint(name=name)
    plain = mujoco.MjSpec().worldbody.add_body().add_joint()
    for field in dir(plain):
        value = getattr(plain, field)
        if isinstance(value, float | np.ndarray) and field not in ("userdata",):
            setattr(joint, field, value)
    joint.limited = joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    joint.actgravcomp = False
    joint.type, joint.axis = kind, axis


def _in_world(position: Array, velocity: Array, start: Array) -> tuple[Array, Array]:
    """Returns displacement and rotation vector from the start, and velocity, in the world frame."""
    vector = rotation_vector(start[3:], position[3:])
    spin = matrix_of(position[3:]) @ velocity[3:]  # MuJoCo stores it in the body's frame
    return np.concatenate([position[:3] - start[:3], vector]), np.concatenate([velocity[:3], spin])


def _place(spec: mujoco.MjSpec, body: mujoco.MjsBody, pose: Array) -> None:
    """Moves a body to a pose in its parent's frame, even if it is written in another frame."""
    body.pos, body.quat = np.zeros(3), IDENTITY
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    model = model_of(spec)
    at = model.body(body.name).id
    written = pose_in(np.concatenate([model.body_pos[at], model.body_quat[at]]), pose)
    body.pos, body.quat = written[:3], written[3:]


def _edit_joints(draft: SceneVariant, change: Callable[[mujoco.MjSpec, Keys], bool]) -> bool:
    """Changes joints and carries keyframes over; refuses if other elements refer to the joints."""
    spec, before = draft.spec.copy(), model_of(draft.spec)
    keys = _read_keys(before)
    if not change(spec, keys):
        return False
    bare = spec.copy()
    for key in list(bare.keys):
        bare.delete(key)
    after = model_of(bare)
    if census(after) != census(before):
        return False
    order = [after.joint(j).name for j in range(after.njnt)]
    for key, values in zip(spec.keys, keys, strict=True):
        key.qpos = np.concatenate([np.zeros(0), *(values[name][0] for name in order)])
        key.qvel = np.concatenate([np.zeros(0), *(values[name][1] for name in order)])
    draft.source = draft.with_spec(spec)
    return True


def _read_keys(model: mujoco.MjModel) -> Keys:
    names = [model.joint(j).name for j in range(model.njnt)]
    places, dofs = model.jnt_qposadr[1:], model.jnt_dofadr[1:]
    keys = zip(model.key_qpos.copy(), model.key_qvel.copy(), strict=True)
    parts = (zip(np.split(q, places), np.split(v, dofs), strict=True) for q, v in keys)
    return [dict(zip(names, each, strict=False)) for each in parts]


# Primitive shapes fitted to a mesh

_GEOM = mujoco.mjtGeom


@dataclass(frozen=True, slots=True, eq=False)
class Primitive:
    """A geometric shape of MuJoCo.

    Attributes:
        kind: Box, cylinder, capsule or sphere. Ellipsoids are not tried, because their contacts
            cost as much as a mesh's.
        size: MuJoCo's three sizes, in m.
        position: Centre, in m.
        axes: Rotation whose columns are the shape's axes.
        error: Largest distance of a point from the surface divided by the points' radius, plus the
            relative volume difference to the points' hull; without unit.
    """

    kind: mujoco.mjtGeom
    size: Array
    position: Array
    axes: Array
    error: float


def best_primitive(points: Array, frames: Iterable[Array]) -> Primitive:
    """Returns the best of the primitives that just contain some points.

    MuJoCo's own fit uses the axes of inertia, which are arbitrary for a square bar: its box comes
    out turned by 45 degrees. Here the caller provides the frames.

    Args:
        points: Points in m, shape (n, 3), not all in one plane.
        frames: Rotations whose columns are the axes to try.
    """
    volume = float(ConvexHull(points).volume)
    radius = float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())
    return min(
        (
            Primitive(kind, size, position, axes, _error(kind, size, local, volume, radius))
            for kind, size, position, axes, local in _candidates(points, frames)
        ),
        key=lambda each: each.error,
    )


def _candidates(
    points: Array, frames: Iterable[Array]
) -> Iterator[tuple[mujoco.mjtGeom, Array, Array, Array, Array]]:
    for frame in frames:
        for axis in range(3):
            axes = np.roll(frame, 2 - axis, axis=1)  # the chosen axis becomes the third
            local = points @ axes
            low, high = local.min(axis=0), local.max(axis=0)
            centre, half = 0.5 * (low + high), 0.5 * (high - low)
            position, local = axes @ centre, local - centre
            round_radius = float(np.linalg.norm(local[:, :2], axis=1).max())
            length = float(max(half[2] - round_radius, 0.0))
            if axis == 2:
                ball = float(np.linalg.norm(local, axis=1).max())
                yield _GEOM.mjGEOM_BOX, half, position, axes, local
                yield _GEOM.mjGEOM_SPHERE, np.array([ball, 0, 0]), position, axes, local
            yield _GEOM.mjGEOM_CYLINDER, np.array([round_radius, half[2], 0]), position, axes, local
            if length > 0.0:
                size = np.array([round_radius, length, 0])
                yield _GEOM.mjGEOM_CAPSULE, size, position, axes, local


def _error(kind: mujoco.mjtGeom, size: Array, local: Array, volume: float, radius: float) -> float:
    outside = np.abs(signed_distance(kind, size, local)).max()
    return float(outside / radius + abs(_volume(kind, size) / volume - 1.0))


def signed_distance(kind: mujoco.mjtGeom, size: Array, points: Array) -> Array:
    """Returns the distance of points from a primitive's surface, in m; negative inside.

    ``size`` holds MuJoCo's sizes in m; points are in the primitive's frame, in m, shape (n, 3).
    """
    if kind in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE):
        length = size[1] if kind == _GEOM.mjGEOM_CAPSULE else 0.0
        along = np.clip(points[:, 2], -length, length)
        core = np.stack([np.zeros_like(along), np.zeros_like(along), along], axis=1)
        return np.asarray(np.linalg.norm(points - core, axis=1) - size[0])
    if kind == _GEOM.mjGEOM_CYLINDER:
        radial = np.linalg.norm(points[:, :2], axis=1) - size[0]
        beyond = np.stack([radial, np.abs(points[:, 2]) - size[1]], axis=1)
    else:
        beyond = np.abs(points) - size
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0))


def _volume(kind: mujoco.mjtGeom, size: Array) -> float:
    if kind == _GEOM.mjGEOM_BOX:
        return float(8.0 * size.prod())
    radius, half = float(size[0]), float(size[1])
    if kind == _GEOM.mjGEOM_CYLINDER:
        return 2.0 * math.pi * radius**2 * half
    ball = 4.0 / 3.0 * math.pi * radius**3
    return ball + (2.0 * math.pi * radius**2 * half if kind == _GEOM.mjGEOM_CAPSULE else 0.0)


# Simplifications of shapes: fewer hull corners, primitives, no visual geoms

HULL_CORNERS = (64, 32, 16, 8)
"""Numbers of corners to which convex hulls are limited in turn."""


def shape_simplifications() -> list[Simplification]:
    """Returns simplifications of shapes; masses and inertias stay as compiled."""
    return [
        Simplification(
            "nothing only seen",
            "geoms that do not collide are left out; their mass stays",
            _drop_visual_geoms,
            loses=PICTURE,
        ),
        *(_hull(count) for count in HULL_CORNERS),
        Simplification(
            "primitives",
            "each mesh that collides becomes the primitive that fits it best",
            _fit_primitives,
        ),
    ]


def _drop_visual_geoms(draft: SceneVariant) -> bool:
    spec = draft.spec
    left = spec.copy()
    left.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    left.discard_visual()  # keeps geoms that sensors, tendons and other elements refer to
    kept = {geom.name for geom in left.geoms}
    dropped = [geom for geom in spec.geoms if geom.name not in kept]
    _keep_inertia(spec, {geom.parent.name for geom in dropped})
    for geom in dropped:
        spec.delete(geom)
    return bool(dropped)


def _hull(count: int) -> Simplification:
    def limit(draft: SceneVariant) -> bool:
        spec = draft.spec
        corners = _hull_corners(spec)
        meshes = [mesh for mesh in spec.meshes if corners.get(_name(mesh), 0) > count]
        changed = {_name(mesh) for mesh in meshes}
        _keep_inertia(spec, {geom.parent.name for geom in spec.geoms if geom.meshname in changed})
        for mesh in meshes:
            mesh.maxhullvert = count
        return bool(meshes)

    return Simplification(
        f"hulls of {count}", f"meshes that collide keep {count} corners of their hull", limit
    )


def _hull_corners(spec: mujoco.MjSpec) -> dict[str, int]:
    meshes = {geom.meshname for geom in _mesh_geoms(spec)}
    if not meshes:
        return {}
    model = model_of(spec)
    adr = {name: int(model.mesh_graphadr[model.mesh(name).id]) for name in meshes}
    # a graph begins with its number of corners
    return {name: int(model.mesh_graph[start]) for name, start in adr.items() if start >= 0}


def _mesh_geoms(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
    paired = paired_geoms(spec)
    return [
        geom
        for geom in spec.geoms
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH and (collides(geom) or geom.name in paired)
    ]


def _name(mesh: mujoco.MjsMesh) -> str:
    """Returns a mesh's name; an unnamed mesh has the name of its file."""
    return str(mesh.name or PurePath(str(mesh.file).replace("\\", "/")).stem)


def _fit_primitives(draft: SceneVariant) -> bool:
    spec = draft.spec
    names = [geom.name for geom in _mesh_geoms(spec)]
    if not names:
        return False
    _keep_inertia(spec, {spec.geom(name).parent.name for name in names})
    model = model_of(spec)
    fits = {name: _fit(model, name) for name in names}
    for name in names:
        geom = spec.geom(name)
        geom.type, geom.size = fits[name].kind, fits[name].size
        _remove_mesh(spec, geom)
        geom.pos, geom.quat = np.zeros(3), IDENTITY
        geom.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    for mesh in [mesh for mesh in spec.meshes if not _is_used(spec, mesh)]:
        spec.delete(mesh)
    # the pose of a geom written in a frame is relative to that frame
    frames = model_of(spec)
    for name in names:
        geom, at = spec.geom(name), frames.geom(name).id
        turn = matrix_of(frames.geom_quat[at])
        geom.pos = turn.T @ (fits[name].position - frames.geom_pos[at])
        geom.quat = quaternion_of(turn.T @ fits[name].axes)
    return True


def _remove_mesh(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> None:
    """Removes the mesh from a geom and from its classes, which would restore it in a file."""
    geom.meshname = ""
    for default in (geom.classname, spec.default):
        if default is not None:
            default.geom.meshname = ""


def _is_used(spec: mujoco.MjSpec, mesh: mujoco.MjsMesh) -> bool:
    return any(geom.meshname == _name(mesh) for geom in spec.geoms)


def _fit(model: mujoco.MjModel, name: str) -> Primitive:
    """Fits a mesh geom in its body's frame, along the mesh's own axes and its axes of inertia."""
    geom = model.geom(name).id
    mesh = int(model.geom_dataid[geom])
    start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    inertia = matrix_of(model.geom_quat[geom])
    points = np.asarray(model.mesh_vert[start : start + count], np.float64) @ inertia.T
    own = inertia @ matrix_of(model.mesh_quat[mesh]).T
    return best_primitive(points + model.geom_pos[geom], (own, inertia))


def _keep_inertia(spec: mujoco.MjSpec, bodies: set[str]) -> None:
    """Writes down the compiled inertia of bodies that take it from their geoms.

    MuJoCo's ``adopt_inertial`` refuses a scene whose geoms overrule written inertias.
    """
    compiler, model = spec.compiler, unfused_model(spec)
    is_forced = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    if is_forced or compiler.settotalmass > 0:  # overruled or scaled together
        bodies = {body.name for body in spec.bodies}
        compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    unwritten = mujoco.MjSpec().worldbody.add_body()
    for body in spec.bodies:
        at = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body.name)
        if body.name not in bodies or at <= 0 or not model.body_mass[at]:
            continue
        body.explicitinertial, body.mass = True, model.body_mass[at]
        body.ipos, body.iquat = model.body_ipos[at], model.body_iquat[at]
        body.inertia, body.fullinertia = model.body_inertia[at], unwritten.fullinertia
        body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
