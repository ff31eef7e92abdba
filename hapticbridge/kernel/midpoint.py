"""The coupling's wrench where half of it is solved implicitly: its law, and what was applied."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.native import floats
from hapticbridge.kernel.ports import moment_dot
from hapticbridge.pose import (
    Quaternion,
    Vector,
    add,
    conjugate,
    quaternion_of,
    rotated,
    rotation_between,
    scaled,
    store_vector,
    subtract,
    vector_of,
)


@compiled
def implicit_half(state: NDArray[np.void]) -> tuple[Vector, Vector]:
    """Returns the wrench on the tool that the coupling's actuators applied in the step, as a mean.

    ``actuator_force`` is theirs at the start of the step; two terms of MuJoCo's effective metric
    take it to the end (see ``ports``). The axes are the handle's. Must run before kinematics are
    refreshed.
    """
    s = state[0]
    h = s.timestep
    first = s.coupling_output_adr
    forces = floats(s.actuator_force, first + 6)
    f = np.empty(6)
    for axis in range(6):
        stiffness, damping = s.stiffness, s.damping
        if axis >= 3:
            stiffness, damping = s.rotational_stiffness, s.rotational_damping
        end = moment_dot(state, first + axis, s.qvel)
        change = moment_dot(state, first + axis, s.qacc)
        in_position, in_velocity = 0.5 * h * stiffness, 0.5 * h * (h * stiffness + damping)
        f[axis] = forces[first + axis] - in_position * (end - h * change) - in_velocity * change
    handle = quaternion_of(s.handle_quaternion)
    return rotated(handle, vector_of(f)), rotated(handle, vector_of(f[3:6]))


@compiled
def midpoint_torque(state: NDArray[np.void], tool: Quaternion, turned: Vector) -> Vector:
    """Returns the coupling's torque on the tool, in the world frame, by the midpoint rule.

    In the tool's frame τ = K_r (φ_k + φ_{k−1})/2 + (B_r/T) [½ (R_kᵀ + R_{k−1}ᵀ) δφ_h − R_kᵀ δφ_x]
    with B_r = B'_r + K_r T/2; the force needs no other rule, because in translation
    K (e_k + e_{k−1})/2 + (B/T) δe = K e_k + (B'/T) δe.

    Args:
        state: The bound state, still with the tool's orientation before the step.
        tool: Its orientation after it.
        turned: How it turned, δφ_x.
    """
    s = state[0]
    to_before, to_after = conjugate(quaternion_of(s.tool_quaternion)), conjugate(tool)
    before, after = vector_of(s.twist), twist_in_tool(state, tool)
    turn = vector_of(s.handle_turn)
    handles = scaled(0.5, add(rotated(to_after, turn), rotated(to_before, turn)))
    rate = (s.rotational_damping + 0.5 * s.period * s.rotational_stiffness) / s.period
    spring = scaled(0.5 * s.rotational_stiffness, add(after, before))
    damper = scaled(rate, subtract(handles, rotated(to_after, turned)))
    return rotated(tool, add(spring, damper))


@compiled
def twist_in_tool(state: NDArray[np.void], tool: Quaternion) -> Vector:
    """Returns φ, the rotation vector from the tool to the handle, in the tool's frame."""
    handle = quaternion_of(state[0].handle_quaternion)
    return rotated(conjugate(tool), rotation_between(tool, handle))


@compiled
def note_twist(state: NDArray[np.void]) -> None:
    """Notes φ as it is: before the first tick, and for the next one."""
    s = state[0]
    store_vector(s.twist, twist_in_tool(state, quaternion_of(s.tool_quaternion)))
