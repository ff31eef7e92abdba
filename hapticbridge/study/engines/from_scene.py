"""Describes a MuJoCo scene of one free tool among fixed shapes to other engines."""

from __future__ import annotations

import mujoco
import numpy as np

from hapticbridge.arguments import Array
from hapticbridge.coupling import Coupling
from hapticbridge.device.trajectory import Motion
from hapticbridge.errors import StudyError
from hapticbridge.kernel.codes import COUPLING_ACTUATORS
from hapticbridge.pose import add, canonical, cross, product, rotated, subtract
from hapticbridge.scene import Scene
from hapticbridge.study.engines.task import (
    SIZES,
    Body,
    Kind,
    Pose,
    Shape,
    Task,
    Velocity,
    composed,
    inverted,
)

_KINDS: dict[int, Kind] = {
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
) -> Task:
    """Returns the task that a scene of one free tool among fixed shapes sets.

    MuJoCo's contact settings are left out: each engine has its own. Friction is that of the pairs
    of geoms, as MuJoCo takes it the larger of the two.

    Args:
        scene: Its start is described; it is put there.
        motion: Of the handle, counted from its first pose as ``check.motion_for`` returns it; it
            begins where the grip is at the start. None: the handle rests there.
        coupling: Between handle and grip; None leaves the tool alone.

    Raises:
        StudyError: It is none that other engines share. One body moves, on a free joint without
            damping, armature or friction, and no other body is fixed to it; the geoms that touch
            are boxes, spheres, capsules or convex meshes, each of the tool's against each of the
            fixed, without margin and with one friction for sliding alone; there are no
            constraints, tendons, fluid, or actuators of the scene's own.
    """
    scene.reset()
    model, data = scene.model, scene.data
    if fault := _fault(model):
        raise StudyError(f"scene '{scene.name}' cannot be given to other engines: {fault}")
    body_id = int(model.jnt_bodyid[0])
    tool_ids, fixed_ids = _touching(scene, body_id)
    start = _pose(data.xpos[body_id], data.xquat[body_id])
    grip_in_world = _pose(scene.grip_pose()[:3], scene.grip_pose()[3:])
    world_to_body = inverted(start)
    inertia_frame = _pose(model.body_ipos[body_id], model.body_iquat[body_id])
    body = Body(
        mass=float(model.body_mass[body_id]),
        inertia=_vector(model.body_inertia[body_id]),
        inertia_frame=inertia_frame,
        shapes=tuple(
            _shape(model, i, _pose(model.geom_pos[i], model.geom_quat[i])) for i in tool_ids
        ),
        friction=_friction(scene, tool_ids, fixed_ids),
    )
    spin = rotated(start.quaternion, _vector(data.qvel[3:6]))
    lever = subtract(composed(start, inertia_frame).position, start.position)
    return Task(
        name=scene.name,
        body=body,
        fixed=tuple(
            _shape(model, i, _pose(data.geom_xpos[i], _quaternion(data.geom_xmat[i])))
            for i in fixed_ids
        ),
        gravity=_vector(model.opt.gravity),
        coupling=coupling,
        grip=composed(world_to_body, grip_in_world),
        start=start,
        start_velocity=Velocity(add(_vector(data.qvel[:3]), cross(spin, lever)), spin),
        handle=None if motion is None else _from(grip_in_world, motion),
    )


def _fault(model: mujoco.MjModel) -> str:
    """Returns why other engines cannot be given a model; empty where they can."""
    free = int(mujoco.mjtJoint.mjJNT_FREE)
    if model.njnt != 1 or model.jnt_type[0] != free:
        return f"it has {model.njnt} joint(s), and it must have a free joint and no other"
    body_id = int(model.jnt_bodyid[0])
    is_drag_free = model.opt.density == 0 and model.opt.viscosity == 0
    faults = (
        (int(np.sum(model.body_weldid == body_id)) > 1, "its tool is made of several bodies"),
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
            "its free joint has damping, armature, friction or stiffness",
        ),
        (not is_drag_free or np.any(model.opt.wind), "it has a fluid"),
        (any(model.opt.disableflags & bit for bit in _WITHOUT), "it has contact or gravity off"),
    )
    return next((clause for is_so, clause in faults if is_so), "")


def _touching(scene: Scene, body_id: int) -> tuple[list[int], list[int]]:
    """Returns the geoms of the tool and the fixed ones that can touch each other."""
    model = scene.model
    tool = [i for i in range(model.ngeom) if model.geom_bodyid[i] == body_id]
    fixed = [i for i in range(model.ngeom) if model.geom_bodyid[i] != body_id]
    own, affinity = model.geom_contype, model.geom_conaffinity
    pairs = {(a, b) for a in tool for b in fixed if own[a] & affinity[b] or own[b] & affinity[a]}
    tool_ids, fixed_ids = sorted({a for a, _ in pairs}), sorted({b for _, b in pairs})
    fault = ""
    if len(pairs) != len(tool_ids) * len(fixed_ids):
        fault = "not every geom of the tool touches every fixed one"
    for i in (*tool_ids, *fixed_ids):
        kind = int(model.geom_type[i])
        if kind not in _KINDS:
            name = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
            fault = f"geom '{model.geom(i).name}' is a {name}; they share {', '.join(SIZES)}"
        elif model.geom_margin[i] != 0 or model.geom_gap[i] != 0:
            fault = f"geom '{model.geom(i).name}' has a margin or gap"
    if fault:
        raise StudyError(f"scene '{scene.name}' cannot be given to other engines: {fault}")
    return tool_ids, fixed_ids


def _friction(scene: Scene, tool_ids: list[int], fixed_ids: list[int]) -> float:
    """Returns the friction that all pairs share."""
    model, found = scene.model, set()
    for a in tool_ids:
        for b in fixed_ids:
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


def _shape(model: mujoco.MjModel, geom_id: int, pose: Pose) -> Shape:
    kind = _KINDS[int(model.geom_type[geom_id])]
    vertices = None
    if kind == "mesh":
        mesh = int(model.geom_dataid[geom_id])
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        vertices = np.array(model.mesh_vert[first : first + count], dtype=np.float64)
    size = tuple(float(value) for value in model.geom_size[geom_id][: SIZES[kind]])
    return Shape(kind, size, pose.position, pose.quaternion, vertices)


def _from(grip: Pose, motion: Motion) -> Motion:
    """Returns a motion that is counted from its first pose, begun at the grip."""
    table = motion.table
    turned = [product(_four(row[4:]), grip.quaternion) for row in table]
    return Motion(table[:, 0], table[:, 1:4] + np.asarray(grip.position), turned)


def _pose(position: object, quaternion: object) -> Pose:
    return Pose(_vector(position), canonical(_four(quaternion)))


def _vector(values: object) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in np.asarray(values))
    return x, y, z


def _four(values: object) -> tuple[float, float, float, float]:
    w, x, y, z = (float(value) for value in np.asarray(values))
    return w, x, y, z


def _quaternion(matrix: Array) -> Array:
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, matrix)
    return quaternion
