"""Rendering methods that exist to be compared: zero-order hold, weld, and a tool without mass.

Zero-order hold: the coupling law is evaluated after the step, and its wrench is applied as a force
during the next tick.

Weld: an equality constraint of MuJoCo joins grip and handle; its row forces give the wrench.

Massless: the tool is placed at the handle and pushed back by one frictionless spring per contact,

    F = K_c p n,    V = ½ K_c p²

with p the penetration in m, n the contact's normal, K_c the contact stiffness in N/m. The tool has
no mass, so the hand's wrench on it is minus the sum of the contacts' wrenches.

``lab.methods`` has the recipe for another method.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.codes import EQUALITY, Scheme, State
from hapticbridge.kernel.force_level import limited_wrench_after_step
from hapticbridge.kernel.handle import note_tool, tool_after_step, tool_motion
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.law import command_handle_velocity
from hapticbridge.kernel.ledger import set_contact_springs_energy
from hapticbridge.kernel.mujoco_c import floats, ints, pointer_at
from hapticbridge.kernel.pose import (
    Quaternion,
    Vector,
    add,
    conjugate,
    cross,
    dot,
    product,
    quaternion_exp,
    quaternion_of,
    rotated,
    scaled,
    store_quaternion,
    store_vector,
    subtract,
    vector_of,
)


@compiled
def drive_compared(s: State, orientation: Quaternion) -> None:
    """Makes the tool follow the handle in the next step of MuJoCo.

    Args:
        s: The bound state with the handle in its place.
        orientation: The handle's orientation in this substep.
    """
    if s.run.scheme == Scheme.MASSLESS:
        place_tool(s)
    elif s.run.scheme == Scheme.ZERO_ORDER_HOLD:
        hold_wrench(s, orientation)
    elif s.run.scheme == Scheme.WELD:
        command_handle_velocity(s, orientation)


@compiled
def compared_wrench(
    states: NDArray[np.void], is_last: bool
) -> tuple[Vector, Vector, Vector, Vector]:
    """Returns force, torque, and the tool's motion and rotation vector since the last call.

    A scheme without a branch here has a wrench that is not finite, so its first tick is refused.

    Args:
        states: The bound states after a step of MuJoCo.
        is_last: True for the last substep of the tick.
    """
    s = states[0]
    if s.run.scheme == Scheme.ZERO_ORDER_HOLD:
        return limited_wrench_after_step(states, is_last)
    if s.run.scheme == Scheme.WELD:
        wrench = weld_wrench(s)  # before the kinematics are refreshed
        position, orientation, moved, turned = tool_after_step(s)
    elif s.run.scheme == Scheme.MASSLESS:
        wrench = balance_contacts(s)
        position, orientation, moved, turned = tool_motion(s)
    else:
        unknown = (np.nan, np.nan, np.nan)
        return unknown, unknown, unknown, unknown
    note_tool(s.pose, position, orientation, turned)
    return wrench[0], wrench[1], moved, turned


@compiled
def hold_wrench(s: State, orientation: Quaternion) -> None:
    """Gives the actuators the wrench of the previous tick, in the handle's axes."""
    to_handle = conjugate(orientation)
    ctrl = floats(s.mj.ctrl + 8 * s.mj.coupling_ctrl_adr, 6)
    w = s.loop.wrench_on_tool
    store_vector(ctrl[0:3], rotated(to_handle, vector_of(w)))
    store_vector(ctrl[3:6], rotated(to_handle, vector_of(w[3:6])))


@compiled
def weld_wrench(s: State) -> tuple[Vector, Vector]:
    """Returns force and torque of the weld on the tool, about the grip, in the world frame.

    A weld of two sites has six constraint rows. Three are the grip's position minus the handle's;
    their forces λ act at the grip. Three are the vector part of q̄_h ⊗ q_x, which a rotation ω of
    the tool changes by ½ vec(q̄_h ⊗ (0, ω) ⊗ q_x); their torque is the transpose of that map times
    λ.

    Must run before the kinematics are refreshed, because the step used the poses of its start.
    """
    mj = s.mj
    count = min(ints(mj.ne, 1)[0], ints(mj.nefc, 1)[0])
    kinds, ids = ints(pointer_at(mj.efc_type), count), ints(pointer_at(mj.efc_id), count)
    row = 0
    while row < count and not (kinds[row] == EQUALITY and ids[row] == mj.weld_id):
        row += 1
    if row + 6 > count:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    force = floats(pointer_at(mj.efc_force), count)
    grip = quaternion_of(floats(mj.site_xquat + 32 * mj.grip_site_id, 4))
    to_handle = conjugate(quaternion_of(floats(mj.site_xquat + 32 * mj.handle_site_id, 4)))
    x = product(product(to_handle, (0.0, 1.0, 0.0, 0.0)), grip)
    y = product(product(to_handle, (0.0, 0.0, 1.0, 0.0)), grip)
    z = product(product(to_handle, (0.0, 0.0, 0.0, 1.0)), grip)
    a, b, c = 0.5 * force[row + 3], 0.5 * force[row + 4], 0.5 * force[row + 5]
    return (
        vector_of(force[row : row + 3]),
        (
            a * x[1] + b * x[2] + c * x[3],
            a * y[1] + b * y[2] + c * y[3],
            a * z[1] + b * z[2] + c * z[3],
        ),
    )


FREE_TOOL = 7
"""Count of numbers that ``tool_map`` returns for a tool on a free joint; for a planar tool 22."""


def tool_map(model: mujoco.MjModel, site_id: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Returns the geometry that ``place_tool`` uses, and the addresses of the tool's coordinates.

    For a tool on a free joint, the geometry is the grip's position (3) and orientation (4) in the
    body. For a planar tool on two slides and a hinge it is: the axes of the slides (6) and of the
    hinge (3), the hinge's anchor (3), the grip's position (3) and orientation (4) in the world at
    ``qpos0``, and ``qpos0`` of the three joints (3).

    Args:
        model: A scene that ``scene.checks.check_massless_tool`` accepts.
        site_id: The grip.
    """
    body_id = int(model.site_bodyid[site_id])
    first, count = int(model.body_jntadr[body_id]), int(model.body_jntnum[body_id])
    addresses = np.ascontiguousarray(model.jnt_qposadr[first : first + count], dtype=np.int32)
    if count == 1:
        frame = np.concatenate([model.site_pos[site_id], model.site_quat[site_id]])
        return np.ascontiguousarray(frame), addresses
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    numbers = [
        data.xaxis[first : first + 3].ravel(),
        data.xanchor[first + 2],
        data.site_xpos[site_id],
        data.site_xquat[site_id],
        model.qpos0[addresses],
    ]
    return np.ascontiguousarray(np.concatenate(numbers)), addresses


@compiled
def place_tool(s: State) -> None:
    """Writes the tool's coordinates so that the grip is at the handle.

    A planar tool follows the handle's rotation about its hinge and its motion along its slides.
    """
    mj = s.mj
    handle = vector_of(s.pose.handle_position)
    orientation = quaternion_of(s.pose.handle_quaternion)
    numbers = floats(mj.tool_map, mj.tool_map_size)
    addresses = ints(mj.tool_qpos, 3)
    if mj.tool_map_size == FREE_TOOL:
        body = product(orientation, conjugate(quaternion_of(numbers[3:])))
        position = subtract(handle, rotated(body, vector_of(numbers)))
        qpos = floats(mj.qpos + 8 * addresses[0], 7)
        store_vector(qpos, position)
        store_quaternion(qpos[3:7], body)
        return
    axis, anchor, grip = vector_of(numbers[6:]), vector_of(numbers[9:]), vector_of(numbers[12:])
    turn = product(orientation, conjugate(quaternion_of(numbers[15:])))
    angle = 2.0 * math.atan2(dot((turn[1], turn[2], turn[3]), axis), turn[0])
    angle = math.atan2(math.sin(angle), math.cos(angle))
    swung = rotated(quaternion_exp(scaled(angle, axis)), subtract(grip, anchor))
    left = subtract(handle, add(anchor, swung))
    for joint in range(2):
        slide = dot(vector_of(numbers[3 * joint :]), left)
        floats(mj.qpos + 8 * addresses[joint], 1)[0] = numbers[19 + joint] + slide
    floats(mj.qpos + 8 * addresses[2], 1)[0] = numbers[21] + angle


@compiled
def balance_contacts(s: State) -> tuple[Vector, Vector]:
    """Returns the wrench that balances the contacts on the tool, about the grip.

    Also books the energy of the contact springs as the scene's storage.
    """
    mj = s.mj
    grip = vector_of(floats(mj.site_xpos + 24 * mj.grip_site_id, 3))
    is_tool = ints(mj.geom_is_tool, mj.ngeom)
    force, torque = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    energy = 0.0
    for c in range(ints(mj.ncon, 1)[0]):
        contact = pointer_at(mj.contact) + c * mj.contact_size
        depth = -floats(contact + mj.contact_distance, 1)[0]
        geoms = ints(contact + mj.contact_geoms, 2)
        if depth <= 0.0 or geoms[0] < 0 or geoms[1] < 0:
            continue
        side = is_tool[geoms[1]] - is_tool[geoms[0]]
        if side == 0:
            continue
        # the normal points from the first geom to the second
        normal = vector_of(floats(contact + mj.contact_frame, 3))
        push = scaled(side * s.run.contact_stiffness * depth, normal)
        arm = subtract(vector_of(floats(contact + mj.contact_point, 3)), grip)
        force, torque = subtract(force, push), subtract(torque, cross(arm, push))
        energy += 0.5 * s.run.contact_stiffness * depth * depth
    set_contact_springs_energy(s.energy, energy)
    return force, torque


def massless_tool(model: mujoco.MjModel, grip_site: int) -> dict[str, NDArray[np.generic]]:
    """Returns the arrays that the method needs, by their names in the sub-record ``mj``."""
    numbers, addresses = tool_map(model, grip_site)
    tool = model.body_weldid[model.site_bodyid[grip_site]]
    is_tool = model.body_weldid[model.geom_bodyid] == tool
    return {
        "tool_map": numbers,
        "tool_qpos": addresses,
        "geom_is_tool": np.ascontiguousarray(is_tool, dtype=np.int32),
    }
