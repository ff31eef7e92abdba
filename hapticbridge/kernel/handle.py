"""Poses of device, handle and tool: the map from device to scene, and the steps of a tick."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.codes import Part, State
from hapticbridge.kernel.jit import compiled, direct
from hapticbridge.kernel.mujoco_c import (
    floats,
    ints,
    mj_kinematics,
    mj_transmission,
    mju_mul_mat_vec_sparse,
    mju_normalize4,
    mju_quat2mat,
    mju_sub_quat,
)
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.pose import (
    Quaternion,
    Vector,
    add,
    canonical,
    conjugate,
    cross,
    norm,
    product,
    quaternion_exp,
    quaternion_of,
    rotation_between,
    scaled,
    store_quaternion,
    store_vector,
    subtract,
    vector_of,
)

POSE_DTYPE = np.dtype(
    [
        ("device_origin", "<f8", 7),
        ("handle_origin", "<f8", 7),
        ("handle_home", "<f8", 7),
        ("device_position", "<f8", 3),
        ("device_quaternion", "<f8", 4),
        ("handle_position", "<f8", 3),
        ("handle_quaternion", "<f8", 4),
        ("tool_position", "<f8", 3),
        ("tool_quaternion", "<f8", 4),
        ("handle_step", "<f8", 3),
        ("handle_turn", "<f8", 3),
        ("tool_turn", "<f8", 3),
    ]
)
"""Sub-record ``pose``, written by this module alone. Positions in m, quaternions (w, x, y, z);
``handle_step`` in m and ``handle_turn`` in rad are the handle's motion in the present tick,
``tool_turn`` in rad is the tool's in its last step."""


UPRIGHT = (1.0, 0.0, 0.0, 0.0)
"""Quaternion without a rotation."""


@compiled
def scene_from_device(axes: NDArray[np.float64], v: Vector) -> Vector:
    """Returns A v, with A row by row."""
    return (
        axes[0] * v[0] + axes[1] * v[1] + axes[2] * v[2],
        axes[3] * v[0] + axes[4] * v[1] + axes[5] * v[2],
        axes[6] * v[0] + axes[7] * v[1] + axes[8] * v[2],
    )


@compiled
def device_from_scene(axes: NDArray[np.float64], v: Vector) -> Vector:
    """Returns Aᵀ v, with A row by row."""
    return (
        axes[0] * v[0] + axes[3] * v[1] + axes[6] * v[2],
        axes[1] * v[0] + axes[4] * v[1] + axes[7] * v[2],
        axes[2] * v[0] + axes[5] * v[1] + axes[8] * v[2],
    )


@compiled
def handle_pose(
    run: Part, pose: Part, position: Vector, quaternion: Quaternion
) -> tuple[Vector, Quaternion]:
    """Maps a device pose into the scene.

        h = h_0 + scale · A (p − p_0),    R_h = A (R R_0ᵀ) Aᵀ R_h0

    A is the rotation from the device's axes to the scene's; subscript 0 marks the origins.
    """
    offset = subtract(position, vector_of(pose.device_origin))
    moved = scaled(run.scale, scene_from_device(run.axes, offset))
    origin = pose.handle_origin
    start = quaternion_of(pose.device_origin[3:7])
    axes = quaternion_of(run.axes_quaternion)
    turn = product(product(axes, product(quaternion, conjugate(start))), conjugate(axes))
    return add(vector_of(origin), moved), canonical(product(turn, quaternion_of(origin[3:7])))


def bind_poses(run: Part, pose: Part, parameters: RunParameters) -> None:
    """Fills in the origins, and the poses of device and handle before the first tick."""
    pose["device_origin"], pose["handle_origin"] = (
        parameters.device_origin,
        parameters.handle_origin,
    )
    x, y, z, qw, qx, qy, qz = parameters.device_start
    pose["device_position"], pose["device_quaternion"] = (x, y, z), (qw, qx, qy, qz)
    direct(_place_first, run, pose)(run, pose)


@compiled
def _place_first(run: Part, pose: Part) -> None:
    position, quaternion = vector_of(pose.device_position), quaternion_of(pose.device_quaternion)
    handle, orientation = handle_pose(run, pose, position, quaternion)
    store_vector(pose.handle_position, handle)
    store_quaternion(pose.handle_quaternion, orientation)
    store_vector(pose.handle_home, handle)
    store_quaternion(pose.handle_home[3:7], orientation)


@compiled
def stretch_at(s: State, sample: NDArray[np.void]) -> float:
    """Returns the distance in m between the tool and the handle that a sample would give."""
    pose, first = s.pose, sample[0]
    handle, _ = handle_pose(s.run, pose, vector_of(first.position), quaternion_of(first.quaternion))
    return norm(subtract(handle, vector_of(pose.tool_position)))


def follow_handle(pose: Part, loop: Part) -> None:
    """Puts device and handle of a slower scene where the handle of its loop is, as their home."""
    for end, part in (("position", slice(3)), ("quaternion", slice(3, 7))):
        value = loop[f"handle_{end}"]
        pose[f"device_{end}"] = pose[f"handle_{end}"] = pose["handle_home"][part] = value


def set_tool(pose: Part, position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> None:
    """Sets the tool's pose at the start or after a reset."""
    pose["tool_turn"] = 0.0
    pose["tool_position"] = position
    pose["tool_quaternion"] = quaternion if quaternion[0] >= 0 else -quaternion


@compiled
def move_device(pose: Part, position: Vector, quaternion: Quaternion) -> None:
    """Notes the device's new pose."""
    store_vector(pose.device_position, position)
    store_quaternion(pose.device_quaternion, quaternion)


@compiled
def move_handle(pose: Part, position: Vector, quaternion: Quaternion) -> None:
    """Notes the handle's new pose, and its step and turn since the previous tick."""
    store_vector(pose.handle_step, subtract(position, vector_of(pose.handle_position)))
    turn = rotation_between(quaternion_of(pose.handle_quaternion), quaternion)
    store_vector(pose.handle_turn, turn)
    store_vector(pose.handle_position, position)
    store_quaternion(pose.handle_quaternion, quaternion)


@compiled
def follow_in_part(
    run: Part, pose: Part, lever: float, moved: Vector, turned: Vector
) -> tuple[Vector, Quaternion]:
    """Returns the handle's pose after a part of the device's motion, by the lever.

        h_k = h_{k−1} + r · scale · A δp,    R_h,k = exp(r · A δφ) R_h,k−1

    With the force r f on the device, the handle moved by r times its motion takes up the work that
    the device does: a lever of ratio r.
    """
    step = scaled(lever * run.scale, scene_from_device(run.axes, moved))
    turn = quaternion_exp(scaled(lever, scene_from_device(run.axes, turned)))
    position = add(vector_of(pose.handle_position), step)
    return position, canonical(product(turn, quaternion_of(pose.handle_quaternion)))


@compiled
def slip_handle(pose: Part, shift: Vector, turn: Vector) -> None:
    """Moves the handle without the device; the handle's step of the tick does not contain it."""
    store_vector(pose.handle_position, add(vector_of(pose.handle_position), shift))
    orientation = product(quaternion_exp(turn), quaternion_of(pose.handle_quaternion))
    store_quaternion(pose.handle_quaternion, canonical(orientation))


@compiled
def anchor_handle(pose: Part) -> None:
    """Re-anchors the handle: its pose belongs to the device's present pose from now on."""
    for i in range(3):
        pose.device_origin[i] = pose.device_position[i]
        pose.handle_origin[i] = pose.handle_position[i]
    for i in range(4):
        pose.device_origin[3 + i] = pose.device_quaternion[i]
        pose.handle_origin[3 + i] = pose.handle_quaternion[i]


def move_handle_home(pose: Part, *, at_tool: bool = False) -> None:
    """Puts the handle at rest to its pose before the first tick, where it carries the tool.

    With ``at_tool`` its home is the tool's present pose from now on.
    """
    pose["handle_step"] = pose["handle_turn"] = 0.0
    if at_tool:
        pose["handle_home"][:3], pose["handle_home"][3:] = (
            pose["tool_position"],
            pose["tool_quaternion"],
        )
    pose["handle_position"] = pose["handle_home"][:3]
    pose["handle_quaternion"] = pose["handle_home"][3:]


@compiled
def note_tool(pose: Part, position: Vector, quaternion: Quaternion, turned: Vector) -> None:
    """Notes the tool's new pose, and its turn in the step; none for a tool that is only shown."""
    store_vector(pose.tool_turn, turned)
    store_vector(pose.tool_position, position)
    store_quaternion(pose.tool_quaternion, quaternion)


@compiled
def grip_pose(mj: Part) -> tuple[Vector, Quaternion]:
    """Returns the grip's pose as MuJoCo's kinematics left it; (q, 0, 0) for a joint at q."""
    grip = mj.grip_site_id
    if mj.held_qpos != 0:
        return (floats(mj.held_qpos, 1)[0], 0.0, 0.0), UPRIGHT
    position = vector_of(floats(mj.site_xpos + 24 * grip, 3))
    return position, canonical(quaternion_of(floats(mj.site_xquat + 32 * grip, 4)))


@compiled
def tool_motion(s: State) -> tuple[Vector, Quaternion, Vector, Vector]:
    """Returns the grip's pose, and its motion and rotation vector since it was last noted."""
    position, orientation = grip_pose(s.mj)
    moved = subtract(position, vector_of(s.pose.tool_position))
    turned = rotation_between(quaternion_of(s.pose.tool_quaternion), orientation)
    return position, orientation, moved, turned


@compiled
def tool_after_step(s: State) -> tuple[Vector, Quaternion, Vector, Vector]:
    """Brings the bodies' poses to the end of the step, and returns ``tool_motion``.

    ``mj_step`` leaves the poses of the step's start.
    """
    mj_kinematics(s.mj.model, s.mj.data)
    return tool_motion(s)


@compiled
def place_handle(s: State, substep: int) -> Quaternion:
    """Puts the handle's mocap body to its pose in this substep; returns its orientation.

    The handle moves uniformly within a tick and reaches its new pose in the last substep. That of a
    joint has no body.
    """
    mj = s.mj
    pose = s.pose
    position = vector_of(pose.handle_position)
    orientation = quaternion_of(pose.handle_quaternion)
    if mj.held_qpos != 0:
        return orientation
    remaining = (s.run.substeps - 1 - substep) / s.run.substeps
    if remaining > 0.0:
        position = subtract(position, scaled(remaining, vector_of(pose.handle_step)))
        back = quaternion_exp(scaled(-remaining, vector_of(pose.handle_turn)))
        orientation = product(back, orientation)
    m = mj.handle_mocap_id
    store_vector(floats(mj.mocap_pos + 24 * m, 3), position)
    store_quaternion(floats(mj.mocap_quat + 32 * m, 4), orientation)
    return orientation


@compiled
def handle_of_step(s: State, is_last: bool) -> tuple[Vector, Quaternion]:
    """Returns the handle's pose in the step that just ended."""
    mj = s.mj
    if is_last:
        return vector_of(s.pose.handle_position), quaternion_of(s.pose.handle_quaternion)
    m = mj.handle_mocap_id
    position = vector_of(floats(mj.mocap_pos + 24 * m, 3))
    return position, canonical(quaternion_of(floats(mj.mocap_quat + 32 * m, 4)))


# What MuJoCo's position stage computes of the handle, for a handle that moved after that stage
#
# The handle is a body of the world without joint, mass or geom. Its pose decides its frames, and
# length and moment of the coupling's actuators, which measure the grip's pose in the handle's axes.
# Kinematics and transmission of a whole scene take a fifth of MuJoCo's step, with one free body as
# with a hundred, and compute the same numbers to the bit.


def handle_facts(mj: Part, model: mujoco.MjModel) -> tuple[dict[str, int], NDArray[np.int32]]:
    """Returns numbers of ``MJ_DTYPE`` about grip and handle, and the grip's degrees of freedom.

    Needs the ids of both. ``is_handle_alone`` is 0 if other actuators follow those of the coupling,
    whose place in MuJoCo's arrays depends on the coupling's moments.
    """
    body, dofs = int(mj["grip_body_id"]), list[int]()
    root = int(model.body_rootid[body])
    while body > 0 and model.body_dofnum[body] == 0:
        body = int(model.body_parentid[body])
    dof = int(model.body_dofadr[body] + model.body_dofnum[body]) - 1 if body > 0 else -1
    while dof >= 0:
        dofs.insert(0, dof)
        dof = int(model.dof_parentid[dof])
    handle, site = int(mj["handle_body_id"]), int(mj["handle_site_id"])
    is_alone = (
        int(mj["coupling_output_adr"]) + 6 == model.nout
        and model.body_sameframe[handle] == mujoco.mjtSameFrame.mjSAMEFRAME_BODY
        and model.site_sameframe[site] == mujoco.mjtSameFrame.mjSAMEFRAME_BODY
    )
    facts = {"grip_root_id": root, "grip_dof_count": len(dofs), "is_handle_alone": bool(is_alone)}
    return facts, np.array(dofs or [0], dtype=np.int32)


@compiled
def take_handle_frames(s: State) -> None:
    """Computes what depends on the handle's pose in MuJoCo's position stage, as that stage does."""
    mj = s.mj
    if mj.held_qpos != 0:
        return  # such a coupling has no handle, and its gains alone depend on the sample
    if not mj.is_handle_alone:
        mj_kinematics(mj.model, mj.data)
        mj_transmission(mj.model, mj.data)
        return
    _move_handle_body(mj)
    _turn_actuators(mj)


@compiled
def turns_actuators_alone(s: State) -> bool:
    """Returns True if in MuJoCo's velocity stage only those actuators depend on the handle.

    Springs of the tool's joints and tendons change their form with it (``kernel.springs``).
    """
    return bool(s.mj.is_handle_alone != 0 and s.mj.held_qpos == 0 and s.springs.count == 0)


@compiled
def take_actuator_velocities(mj: Part) -> None:
    """Computes the velocities of the coupling's actuators, as MuJoCo's velocity stage does."""
    first = mj.coupling_output_adr
    mju_mul_mat_vec_sparse(
        mj.actuator_velocity + 8 * first,
        mj.actuator_moment,
        mj.qvel,
        6,
        mj.moment_rownnz + 4 * first,
        mj.moment_rowadr + 4 * first,
        mj.moment_colind,
        0,
    )


@compiled
def _move_handle_body(mj: Part) -> None:
    """Computes the frames of the handle's body and site, which coincide."""
    m, body, site = mj.handle_mocap_id, mj.handle_body_id, mj.handle_site_id
    position = vector_of(floats(mj.mocap_pos + 24 * m, 3))
    for address in (mj.xpos + 24 * body, mj.xipos + 24 * body, mj.site_xpos + 24 * site):
        store_vector(floats(address, 3), position)
    quaternion, frame = floats(mj.xquat + 32 * body, 4), floats(mj.xmat + 72 * body, 9)
    store_quaternion(quaternion, quaternion_of(floats(mj.mocap_quat + 32 * m, 4)))
    mju_normalize4(mj.xquat + 32 * body)
    mju_quat2mat(mj.xmat + 72 * body, mj.xquat + 32 * body)
    store_quaternion(floats(mj.site_xquat + 32 * site, 4), quaternion_of(quaternion))
    inertial, own = floats(mj.ximat + 72 * body, 9), floats(mj.site_xmat + 72 * site, 9)
    for i in range(9):
        inertial[i] = own[i] = frame[i]


@compiled
def _turn_actuators(mj: Part) -> None:
    """Computes length and moment of the coupling's actuators: the grip in the handle's axes.

    MuJoCo keeps a moment's entries that are not zero, in the order of the degrees of freedom.
    """
    first, count = mj.coupling_output_adr, mj.grip_dof_count
    lengths = floats(mj.actuator_length + 8 * first, 6)
    frame = floats(mj.site_xmat + 72 * mj.handle_site_id, 9)
    grip = vector_of(floats(mj.site_xpos + 24 * mj.grip_site_id, 3))
    shift = subtract(grip, vector_of(floats(mj.site_xpos + 24 * mj.handle_site_id, 3)))
    for i in range(3):
        lengths[i] = frame[i] * shift[0] + frame[3 + i] * shift[1] + frame[6 + i] * shift[2]
    mju_sub_quat(
        mj.actuator_length + 8 * first + 24,
        mj.site_xquat + 32 * mj.grip_site_id,
        mj.site_xquat + 32 * mj.handle_site_id,
    )
    arm = _grip_arm(mj)
    sizes, starts = ints(mj.moment_rownnz, first + 6), ints(mj.moment_rowadr, first + 6)
    dofs, end = ints(mj.grip_dofs, count), starts[first]
    columns = ints(mj.moment_colind, end + 6 * count)
    moments = floats(mj.actuator_moment, end + 6 * count)
    for row in range(6):
        axis, start = row % 3, end
        for dof in dofs:
            v = vector_of(floats(mj.cdof + 48 * dof, 3)) if row >= 3 else _grip_motion(mj, dof, arm)
            moment = v[0] * frame[axis] + v[1] * frame[3 + axis] + v[2] * frame[6 + axis]
            if moment != 0.0:
                columns[end], moments[end] = dof, moment
                end += 1
        starts[first + row], sizes[first + row] = start, end - start


@compiled
def _grip_arm(mj: Part) -> Vector:
    """Returns the grip in m, seen from the point about which ``cdof`` is given."""
    grip = vector_of(floats(mj.site_xpos + 24 * mj.grip_site_id, 3))
    return subtract(grip, vector_of(floats(mj.subtree_com + 24 * mj.grip_root_id, 3)))


@compiled
def _grip_motion(mj: Part, dof: int, arm: Vector) -> Vector:
    """Returns the grip's velocity for a degree of freedom that moves with 1 m/s or 1 rad/s."""
    motion = floats(mj.cdof + 48 * dof, 6)
    return add(vector_of(motion[3:6]), cross(vector_of(motion), arm))


@compiled
def grip_acceleration(mj: Part) -> Vector:
    """Returns (v⁺ − v)/h of the grip in m/s² in the step that just ended, in the scene's frame."""
    total, arm, change = (0.0, 0.0, 0.0), _grip_arm(mj), floats(mj.qacc, mj.nv)
    for dof in ints(mj.grip_dofs, mj.grip_dof_count):
        total = add(total, scaled(change[dof], _grip_motion(mj, dof, arm)))
    return total
