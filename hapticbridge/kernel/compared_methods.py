"""A massless rigid tool that is where the handle is, and is pushed back by contact springs.

Per contact, frictionless:  F = K_c p n,  V = ½ K_c p²

with p the penetration in m, n the contact's normal, K_c the contact stiffness in N/m. The tool has
no mass, so the wrench of the hand on it is minus the sum of the contacts' wrenches.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import EQUALITY
from hapticbridge.kernel.mujoco_c import floats, ints, pointer_at
from hapticbridge.pose import (
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

# The wrench of a weld between grip and handle, from the forces of its constraint rows.


@compiled
def weld_wrench(state: NDArray[np.void]) -> tuple[Vector, Vector]:
    """Returns force and torque of the weld on the tool, about the grip, in the world frame.

    A weld of two sites has six rows. Three are the grip's position minus the handle's: their forces
    λ act at the grip as they are. Three are the vector part of q̄_h ⊗ q_x, which a rotation ω of the
    tool changes by ½ vec(q̄_h ⊗ (0, ω) ⊗ q_x): their torque is the transpose of that times λ.

    Must run before kinematics are refreshed: the step used the poses of its start.
    """
    s = state[0]
    count = min(ints(s.ne, 1)[0], ints(s.nefc, 1)[0])
    kinds, ids = ints(pointer_at(s.efc_type), count), ints(pointer_at(s.efc_id), count)
    row = 0
    while row < count and not (kinds[row] == EQUALITY and ids[row] == s.weld_id):
        row += 1
    if row + 6 > count:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    force = floats(pointer_at(s.efc_force), count)
    grip = quaternion_of(floats(s.site_xquat + 32 * s.grip_site_id, 4))
    to_handle = conjugate(quaternion_of(floats(s.site_xquat + 32 * s.handle_site_id, 4)))
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
"""How many numbers ``tool_map`` returns for a tool on a free joint; for a planar one it is 22."""


def tool_map(model: mujoco.MjModel, site_id: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Returns what ``place_tool`` needs to know of the tool, and where its coordinates lie.

    A tool on a free joint: the grip's position in the body (3) and its orientation there (4). A
    planar one, on two slides and then a hinge: the axes of the slides (6) and of the hinge (3), the
    hinge's anchor (3), the grip's position (3) and orientation (4) in the world at ``qpos0``, and
    ``qpos0`` of the three joints (3).

    Args:
        model: A scene that ``scene.methods.check_massless_tool`` accepts.
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
def place_tool(state: NDArray[np.void]) -> None:
    """Writes the tool's coordinates so that the grip is at the handle.

    A planar tool follows as far as its joints let it: by the part of the handle's turn about the
    hinge, and by the part of its motion along the slides.
    """
    s = state[0]
    handle = vector_of(s.handle_position)
    orientation = quaternion_of(s.handle_quaternion)
    numbers = floats(s.tool_map, s.tool_map_size)
    addresses = ints(s.tool_qpos, 3)
    if s.tool_map_size == FREE_TOOL:
        body = product(orientation, conjugate(quaternion_of(numbers[3:])))
        position = subtract(handle, rotated(body, vector_of(numbers)))
        qpos = floats(s.qpos + 8 * addresses[0], 7)
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
        floats(s.qpos + 8 * addresses[joint], 1)[0] = numbers[19 + joint] + slide
    floats(s.qpos + 8 * addresses[2], 1)[0] = numbers[21] + angle


@compiled
def balance_contacts(state: NDArray[np.void]) -> tuple[Vector, Vector]:
    """Returns the wrench that balances the contacts on the tool, about the grip; sets the energies.

    The energies are those of the springs; a tool without mass has no kinetic one.
    """
    s = state[0]
    grip = vector_of(floats(s.site_xpos + 24 * s.grip_site_id, 3))
    is_tool = ints(s.geom_is_tool, s.ngeom)
    force, torque = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    energy = 0.0
    for c in range(ints(s.ncon, 1)[0]):
        contact = pointer_at(s.contact) + c * s.contact_size
        depth = -floats(contact + s.contact_distance, 1)[0]
        geoms = ints(contact + s.contact_geoms, 2)
        if depth <= 0.0 or geoms[0] < 0 or geoms[1] < 0:
            continue
        side = is_tool[geoms[1]] - is_tool[geoms[0]]
        if side == 0:
            continue
        # the normal points from the first geom to the second
        normal = vector_of(floats(contact + s.contact_frame, 3))
        push = scaled(side * s.contact_stiffness * depth, normal)
        arm = subtract(vector_of(floats(contact + s.contact_point, 3)), grip)
        force, torque = subtract(force, push), subtract(torque, cross(arm, push))
        energy += 0.5 * s.contact_stiffness * depth * depth
    s.kinetic, s.potential = 0.0, energy
    return force, torque
