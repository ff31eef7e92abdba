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
    rotated,
    rotation_between,
    scaled,
    subtract,
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
    q = s.handle_quaternion
    handle = (q[0], q[1], q[2], q[3])
    return rotated(handle, (f[0], f[1], f[2])), rotated(handle, (f[3], f[4], f[5]))


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
    q = s.tool_quaternion
    to_before, to_after = conjugate((q[0], q[1], q[2], q[3])), conjugate(tool)
    before, after = s.twist, twist_in_tool(state, tool)
    turn = (s.handle_turn[0], s.handle_turn[1], s.handle_turn[2])
    handles = scaled(0.5, add(rotated(to_after, turn), rotated(to_before, turn)))
    rate = (s.rotational_damping + 0.5 * s.period * s.rotational_stiffness) / s.period
    spring = scaled(0.5 * s.rotational_stiffness, add(after, (before[0], before[1], before[2])))
    damper = scaled(rate, subtract(handles, rotated(to_after, turned)))
    return rotated(tool, add(spring, damper))


@compiled
def twist_in_tool(state: NDArray[np.void], tool: Quaternion) -> Vector:
    """Returns φ, the rotation vector from the tool to the handle, in the tool's frame."""
    q = state[0].handle_quaternion
    return rotated(conjugate(tool), rotation_between(tool, (q[0], q[1], q[2], q[3])))


@compiled
def start_twist(state: NDArray[np.void]) -> None:
    """Notes φ before the first tick."""
    q = state[0].tool_quaternion
    twist = twist_in_tool(state, (q[0], q[1], q[2], q[3]))
    for i in range(3):
        state[0].twist[i] = twist[i]
