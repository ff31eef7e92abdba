"""The wrench on the tool, and what of it reaches the device."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import DIRECT, FORCE_LIMITED, LOSSLESS, SLEW_LIMITED, WELD
from hapticbridge.kernel.compared_methods import balance_contacts, weld_wrench
from hapticbridge.kernel.guard import transmitted_share
from hapticbridge.kernel.handle import device_from_scene
from hapticbridge.kernel.ledger import refresh_poses
from hapticbridge.kernel.lossless import implicit_half, is_near, midpoint_torque
from hapticbridge.kernel.mujoco_c import floats
from hapticbridge.kernel.passivity_controller import control
from hapticbridge.pose import (
    Quaternion,
    Vector,
    add,
    canonical,
    conjugate,
    norm,
    quaternion_of,
    rotated,
    rotation_between,
    scaled,
    store_quaternion,
    store_vector,
    subtract,
    vector_of,
)


@compiled
def _law(
    state: NDArray[np.void],
    handle: tuple[Vector, Quaternion],
    tool: tuple[Vector, Quaternion],
    moved: Vector,
    turned: Vector,
) -> tuple[Vector, Vector]:
    """The coupling's force and torque on the tool, over one of the tick's ``laws``."""
    s = state[0]
    share, rate = 1.0 / s.laws, s.laws / s.period
    stretch = subtract(handle[0], tool[0])
    twist = rotation_between(tool[1], handle[1])
    force = add(
        scaled(s.stiffness, stretch),
        scaled(s.damping * rate, subtract(scaled(share, vector_of(s.handle_step)), moved)),
    )
    torque = add(
        scaled(s.rotational_stiffness, twist),
        scaled(
            s.rotational_damping * rate,
            subtract(scaled(share, vector_of(s.handle_turn)), turned),
        ),
    )
    return force, torque


@compiled
def _handle_in_scene(state: NDArray[np.void]) -> tuple[Vector, Quaternion]:
    """The handle's pose as the step that just ended had it."""
    s = state[0]
    m = s.handle_mocap_id
    position = vector_of(floats(s.mocap_pos + 24 * m, 3))
    return position, canonical(quaternion_of(floats(s.mocap_quat + 32 * m, 4)))


@compiled
def wrench_of_step(
    state: NDArray[np.void], substep: int, is_last: bool
) -> tuple[Vector, Vector, Vector, Vector]:
    """Returns the wrench on the tool and the tool's motion since the last time it was asked.

    Brings the tool's pose up to date on the way; ``close_tick`` goes on from what is noted here.
    """
    s = state[0]
    applied = half = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    if s.scheme == LOSSLESS:  # while everything is still as the step had it
        s.is_near = is_near(state)
        s.was_midpoint = s.is_midpoint
        if s.is_midpoint:
            half = implicit_half(state)
    elif s.scheme == WELD:
        applied = weld_wrench(state)  # in the Jacobians of the step's start, as the step had them
    elif s.scheme == DIRECT:
        applied = balance_contacts(state)
    if s.scheme != DIRECT:
        refresh_poses(state)
    grip = s.grip_site_id
    position = vector_of(floats(s.site_xpos + 24 * grip, 3))
    orientation = canonical(quaternion_of(floats(s.site_xquat + 32 * grip, 4)))
    before = quaternion_of(s.tool_quaternion)
    moved = subtract(position, vector_of(s.tool_position))
    turned = rotation_between(before, orientation)
    if s.has_law:
        handle = (vector_of(s.handle_position), quaternion_of(s.handle_quaternion))
        if not is_last:
            handle = _handle_in_scene(state)
        applied = _law(state, handle, (position, orientation), moved, turned)
        if s.scheme == LOSSLESS and s.is_midpoint:
            applied = applied[0], midpoint_torque(state, orientation, turned)
            # the torque is carried in the tool's frame, so that it turns with the tool
            half = half[0], rotated(orientation, rotated(conjugate(before), half[1]))
            store_vector(s.applied_half[0:3], half[0])
            store_vector(s.applied_half[3:6], half[1])
    store_vector(s.tool_position, position)
    store_quaternion(s.tool_quaternion, orientation)
    return applied[0], applied[1], moved, turned


@compiled
def _limited(v: Vector, limit: float) -> tuple[Vector, bool]:
    length = norm(v)
    if length > limit:
        return scaled(limit / length, v), True
    return v, False


@compiled
def _slewed(v: Vector, before: Vector, rise: float) -> tuple[Vector, bool]:
    change = subtract(v, before)
    length = norm(change)
    if length > rise:
        return add(before, scaled(rise / length, change)), True
    return v, False


@compiled
def render(state: NDArray[np.void], row: NDArray[np.void], force: Vector, torque: Vector) -> None:
    """Turns the wrench on the tool into the one on the device.

    In this order: scale, passivity controller, limit by norm, slew limit, and what fades or starts
    the wrench as a whole.
    """
    s = state[0]
    s.flags |= s.watch_flags
    on_device = scaled(-s.force_scale, device_from_scene(s.axes, force))
    torque_on_device = scaled(-s.force_scale / s.scale, device_from_scene(s.axes, torque))
    asked = norm(on_device)
    on_device, torque_on_device = control(state, on_device, torque_on_device)
    on_device, is_limited = _limited(on_device, s.force_limit)
    torque_on_device, is_torque_limited = _limited(torque_on_device, s.torque_limit)
    if is_limited or is_torque_limited:
        s.flags |= FORCE_LIMITED
    last, last_torque = vector_of(s.slewed), vector_of(s.slewed[3:6])
    on_device, is_slewed = _slewed(on_device, last, s.force_rise)
    torque_on_device, is_torque_slewed = _slewed(torque_on_device, last_torque, s.torque_rise)
    if is_slewed or is_torque_slewed:
        s.flags |= SLEW_LIMITED
    store_vector(s.slewed[0:3], on_device)
    store_vector(s.slewed[3:6], torque_on_device)
    share = transmitted_share(state, row)
    if share != 1.0:
        on_device, torque_on_device = scaled(share, on_device), scaled(share, torque_on_device)
    s.passed = min(norm(on_device) / asked, 1.0) if asked > 0.0 else share
    store_vector(s.wrench_on_device[0:3], on_device)
    store_vector(s.wrench_on_device[3:6], torque_on_device)
