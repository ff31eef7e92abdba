"""Describes a MuJoCo scene of free bodies among fixed shapes to other engines."""

from __future__ import annotations

from itertools import combinations

import mujoco
import numpy as np

from hapticbridge.coupling import Coupling
from hapticbridge.device.trajectory import Motion
from hapticbridge.errors import StudyError
from hapticbridge.kernel.codes import COUPLING_ACTUATORS, held_body
from hapticbridge.kernel.pose import (
    add,
    canonical,
    cross,
    product,
    rotated,
    subtract,
)
from hapticbridge.lab.engines import base
from hapticbridge.scene import Scene
from hapticbridge.scene.physics import quaternion_of

_KINDS: dict[int, base.Kind] = {
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}

_WITHOUT = (
    mujoco.mjtDisableBit.mjDSBL_CONTACT,
    mujoco.mjtDisableBit.mjDSBL_CONSTRAINT,
    mujoco.mjtDisableBit.mjDSBL_GRAVITY,
)


def task_from_scene(
    scene: Scene, motion: Motion | None = None, coupling: Coupling | None = None
) -> base.Task:
    """Returns the task that a scene of a free tool, other free bodies and fixed shapes sets.

    MuJoCo's contact settings are left out: each engine has its own. Friction is that of the pairs
    of geoms, as MuJoCo takes it the larger of the two.

    Args:
        scene: Scene to describe; it is reset to its start.
        motion: Motion of the handle relative to its first pose, as ``check.case`` returns it.
            It begins at the grip's pose at the start. None: the handle rests there.
        coupling: Coupling between handle and grip; None leaves the tool alone.

    Raises:
        StudyError: Other engines cannot represent the scene. Bodies move on free joints without
            damping, armature or friction, no other body is fixed to them, and all but the tool
            start at rest; the geoms that touch are boxes, spheres, capsules or convex meshes, each
            against each of other bodies, without margin and with one friction for sliding alone;
            there are no constraints, tendons, fluid, or actuators of the scene's own.
    """
    scene.reset()
    model, data = scene.model, scene.data
    tool = held_body(model, scene.grip)
    if fault := _fault(scene, tool):
        raise StudyError(f"scene '{scene.name}' cannot be given to other engines: {fault}")
    pairs = _touching(scene)
    touching = sorted({geom for pair in pairs for geom in pair})
    friction = _friction(scene, pairs)
    tool_free = _free_body(scene, tool, touching, friction)
    start, frame = tool_free.start, tool_free.body.inertia_frame
    grip_in_world = _pose(scene.grip_pose()[:3], scene.grip_pose()[3:])
    first = int(model.body_dofadr[tool])
    spin = rotated(start.quaternion, _vector(data.qvel[first + 3 : first + 6]))
    lever = subtract(base.composed(start, frame).position, start.position)
    speed = add(_vector(data.qvel[first : first + 3]), cross(spin, lever))
    return base.Task(
        name=scene.name,
        body=tool_free.body,
        fixed=tuple(
            _shape(model, i, _pose(data.geom_xpos[i], quaternion_of(data.geom_xmat[i])))
            for i in touching
            if not _is_free(model, model.geom_bodyid[i])
        ),
        gravity=_vector(model.opt.gravity),
        coupling=coupling,
        grip=base.composed(base.inverted(start), grip_in_world),
        start=start,
        start_velocity=base.Velocity(speed, spin),
        handle=None if motion is None else _from(grip_in_world, motion),
        others=tuple(
            _free_body(scene, int(body), touching, friction)
            for body in model.jnt_bodyid
            if body != tool
        ),
    )


def _is_free(model: mujoco.MjModel, body: int) -> bool:
    return bool(model.body_jntnum[body])


def _free_body(scene: Scene, body: int, touching: list[int], friction: float) -> base.FreeBody:
    """Returns a body with those of its geoms that touch."""
    model, data = scene.model, scene.data
    return base.FreeBody(
        base.Body(
            mass=float(model.body_mass[body]),
            inertia=_vector(model.body_inertia[body]),
            inertia_frame=_pose(model.body_ipos[body], model.body_iquat[body]),
            shapes=tuple(
                _shape(model, i, _pose(model.geom_pos[i], model.geom_quat[i]))
                for i in touching
                if model.geom_bodyid[i] == body
            ),
            friction=friction,
        ),
        _pose(data.xpos[body], data.xquat[body]),
    )


def _fault(scene: Scene, tool: int) -> str:
    """Returns the reason why other engines cannot represent a scene; empty where they can."""
    model = scene.model
    if not model.njnt or np.any(model.jnt_type != mujoco.mjtJoint.mjJNT_FREE):
        return f"it has {model.njnt} joint(s), and it must have free joints and no others"
    if not _is_free(model, tool):
        return "its grip is on no free body"
    is_drag_free = model.opt.density == 0 and model.opt.viscosity == 0
    first = int(model.body_dofadr[tool])
    is_elsewhere = np.delete(scene.data.qvel, slice(first, first + 6)).any()
    faults = (
        (
            any(np.sum(model.body_weldid == body) > 1 for body in model.jnt_bodyid),
            "a free body is made of several bodies",
        ),
        (is_elsewhere, "a body that is not the tool moves at the start"),
        (model.nmocap > 1, "it has moving mocap bodies"),
        (model.neq > 0 or model.ntendon > 0, "it has constraints or tendons"),
        (model.nu != len(COUPLING_ACTUATORS), "it has actuators of its own"),
        (model.npair > 0 or model.nexclude > 0, "it has contact pairs of its own"),
        (np.any(model.body_gravcomp), "it has gravity compensation"),
        (
            np.any(model.dof_damping)
            or np.any(model.dof_armature)
            or np.any(model.dof_frictionloss)
            or np.any(model.jnt_stiffness),
            "a free joint has damping, armature, friction or stiffness",
        ),
        (not is_drag_free or np.any(model.opt.wind), "it has a fluid"),
        (any(model.opt.disableflags & bit for bit in _WITHOUT), "it has contact or gravity off"),
    )
    return next((clause for is_so, clause in faults if is_so), "")


def _touching(scene: Scene) -> list[tuple[int, int]]:
    """Returns the pairs of geoms of different bodies, one of them free, that can touch."""
    model = scene.model
    own, affinity, bodies = model.geom_contype, model.geom_conaffinity, model.geom_bodyid
    apart = [
        (a, b)
        for a, b in combinations(range(model.ngeom), 2)
        if bodies[a] != bodies[b] and (_is_free(model, bodies[a]) or _is_free(model, bodies[b]))
    ]
    pairs = [(a, b) for a, b in apart if own[a] & affinity[b] or own[b] & affinity[a]]
    touching = {geom for pair in pairs for geom in pair}
    fault = ""
    if len(pairs) != sum(a in touching and b in touching for a, b in apart):
        fault = "not every geom of a free body touches every one of other bodies"
    for i in sorted(touching):
        kind = int(model.geom_type[i])
        if kind not in _KINDS:
            name = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
            fault = f"geom '{model.geom(i).name}' is a {name}; they share {', '.join(base.SIZES)}"
        elif model.geom_margin[i] != 0 or model.geom_gap[i] != 0:
            fault = f"geom '{model.geom(i).name}' has a margin or gap"
    if fault:
        raise StudyError(f"scene '{scene.name}' cannot be given to other engines: {fault}")
    return pairs


def _friction(scene: Scene, pairs: list[tuple[int, int]]) -> float:
    """Returns the friction that all pairs share."""
    model, found = scene.model, set()
    for a, b in pairs:
        rank = model.geom_priority[a] - model.geom_priority[b]
        taken = (a, b) if rank == 0 else (a,) if rank > 0 else (b,)
        dimensions = max(int(model.geom_condim[i]) for i in taken)
        if dimensions > 3:
            raise StudyError(
                f"scene '{scene.name}' cannot be given to other engines: it has torsional or "
                f"rolling friction (condim {dimensions}), which they do not share"
            )
        slides = dimensions == 3
        found.add(max(float(model.geom_friction[i, 0]) for i in taken) if slides else 0.0)
    if len(found) > 1:
        raise StudyError(
            f"scene '{scene.name}' cannot be given to other engines: its contacts differ in "
            f"friction ({', '.join(f'{value:g}' for value in sorted(found))}), and a task has one"
        )
    return found.pop() if found else 0.0


def _shape(model: mujoco.MjModel, geom_id: int, pose: base.Pose) -> base.Shape:
    kind = _KINDS[int(model.geom_type[geom_id])]
    vertices = None
    if kind == "mesh":
        mesh = int(model.geom_dataid[geom_id])
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        vertices = np.array(model.mesh_vert[first : first + count], dtype=np.float64)
    size = tuple(float(value) for value in model.geom_size[geom_id][: base.SIZES[kind]])
    return base.Shape(kind, size, pose.position, pose.quaternion, vertices)


def _from(grip: base.Pose, motion: Motion) -> Motion:
    """Returns a motion relative to its first pose, moved to begin at the grip."""
    table = motion.table
    turned = [product(_four(row[4:]), grip.quaternion) for row in table]
    return Motion(table[:, 0], table[:, 1:4] + np.asarray(grip.position), turned)


def _pose(position: object, quaternion: object) -> base.Pose:
    return base.Pose(_vector(position), canonical(_four(quaternion)))


def _vector(values: object) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in np.asarray(values))
    return x, y, z


def _four(values: object) -> tuple[float, float, float, float]:
    w, x, y, z = (float(value) for value in np.asarray(values))
    return w, x, y, z
