"""The tick's arithmetic: before MuJoCo's step, after it, and the hand-over of the record.

The live loop calls ``before_step``, ``mujoco.mj_step``, ``after_step`` and ``publish``; the
re-simulation calls ``simulate``, which inlines the same functions around MuJoCo's C symbol.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled, compiled_for_threads
from hapticbridge.kernel.native import (
    floats,
    ints,
    mj_com_pos,
    mj_energy_pos,
    mj_energy_vel,
    mj_fwd_kinematics,
    mj_kinematics,
    mj_make_m,
    mj_step,
    release_fence,
)
from hapticbridge.kernel.ports import meter_ports, note_moved_mocap_bodies
from hapticbridge.pose import (
    Quaternion,
    Vector,
    add,
    canonical,
    conjugate,
    dot,
    norm,
    product,
    quaternion_exp,
    rotated,
    rotation_between,
    scaled,
    subtract,
)

# flags as plain integers: the compiler cannot read an enumeration
FORCE_LIMITED, RAMPING, CONTACT, TRIP = 4, 16, 64, 512

OK, BAD_SAMPLE, BAD_RESULT = 0, 1, 2
"""What a kernel function returns: go on, the device's sample is not finite, the simulation's
result is not finite."""

ENERGY_TOLERANCE = 1e-9
"""An environment is strict while Σ E_k <= 1e-9 J + 1e-9 Σ|f·δx|: rounding of a sum of many small
works, not physics. Larger hides real creation, smaller reports rounding."""

HEAD, TAIL = 0, 1
"""Cursors of the ring: records written, records read."""


@compiled
def vector_of(values: NDArray[np.float64]) -> Vector:
    """Returns the first three elements as a tuple."""
    return values[0], values[1], values[2]


@compiled
def quaternion_of(values: NDArray[np.float64]) -> Quaternion:
    """Returns the first four elements as a tuple."""
    return values[0], values[1], values[2], values[3]


@compiled
def _store_vector(target: NDArray[np.float64], v: Vector) -> None:
    target[0], target[1], target[2] = v


@compiled
def _store_quaternion(target: NDArray[np.float64], q: Quaternion) -> None:
    target[0], target[1], target[2], target[3] = q


@compiled
def _scene_from_device(axes: NDArray[np.float64], v: Vector) -> Vector:
    return (
        axes[0] * v[0] + axes[1] * v[1] + axes[2] * v[2],
        axes[3] * v[0] + axes[4] * v[1] + axes[5] * v[2],
        axes[6] * v[0] + axes[7] * v[1] + axes[8] * v[2],
    )


@compiled
def _device_from_scene(axes: NDArray[np.float64], v: Vector) -> Vector:
    return (
        axes[0] * v[0] + axes[3] * v[1] + axes[6] * v[2],
        axes[1] * v[0] + axes[4] * v[1] + axes[7] * v[2],
        axes[2] * v[0] + axes[5] * v[1] + axes[8] * v[2],
    )


@compiled
def handle_pose(
    state: NDArray[np.void], position: Vector, quaternion: Quaternion
) -> tuple[Vector, Quaternion]:
    """Maps a device pose into the scene.

        h = h_0 + scale · A (p − p_0),    R_h = A (R R_0ᵀ) Aᵀ R_h0

    A is the rotation from the device's axes to the scene's, subscript 0 the pose at the start.
    """
    s = state[0]
    offset = subtract(position, (s.device_origin[0], s.device_origin[1], s.device_origin[2]))
    moved = scaled(s.scale, _scene_from_device(s.axes, offset))
    origin = s.handle_origin
    start = (s.device_origin[3], s.device_origin[4], s.device_origin[5], s.device_origin[6])
    axes = quaternion_of(s.axes_quaternion)
    turn = product(product(axes, product(quaternion, conjugate(start))), conjugate(axes))
    turned = product(turn, (origin[3], origin[4], origin[5], origin[6]))
    return add((origin[0], origin[1], origin[2]), moved), canonical(turned)


@compiled
def before_step(
    state: NDArray[np.void], sample: NDArray[np.void], row: NDArray[np.void], substep: int
) -> int:
    """Takes a device sample into the scene: the handle's pose, and its velocity as ``ctrl``.

    Over substeps the handle moves uniformly from its previous pose to the new one, which it
    reaches in the last. The control of the coupling's actuators is the handle's velocity in the
    handle's own axes, R_hᵀ δh/T and R_hᵀ δφ_h/T: a mocap body has no velocity of its own.

    Returns:
        ``OK`` or ``BAD_SAMPLE``; in the latter case nothing was changed.
    """
    s, r = state[0], row[0]
    if substep == 0:
        position = vector_of(sample[0].position)
        given = quaternion_of(sample[0].quaternion)
        square = 0.0
        for i in range(4):
            square += given[i] * given[i]
        if not math.isfinite(dot(position, position) + square) or square <= 0.25:
            return BAD_SAMPLE
        quaternion = canonical(given)

        moved = subtract(position, vector_of(s.device_position))
        turned = rotation_between(quaternion_of(s.device_quaternion), quaternion)
        w = s.wrench_on_device
        s.device_energy += dot((w[0], w[1], w[2]), moved) + dot((w[3], w[4], w[5]), turned)
        _store_vector(s.device_position, position)
        _store_quaternion(s.device_quaternion, quaternion)

        handle, orientation = handle_pose(state, position, quaternion)
        _store_vector(s.handle_step, subtract(handle, vector_of(s.handle_position)))
        _store_vector(
            s.handle_turn, rotation_between(quaternion_of(s.handle_quaternion), orientation)
        )
        _store_vector(s.handle_position, handle)
        _store_quaternion(s.handle_quaternion, orientation)
        if s.nmocap > 1:
            note_moved_mocap_bodies(state)

        r.tick = s.tick
        r.buttons = sample[0].buttons
        _store_vector(r.device_position, position)
        _store_quaternion(r.device_quaternion, quaternion)
        _store_vector(r.handle_position, handle)
        _store_quaternion(r.handle_quaternion, orientation)

    position = vector_of(s.handle_position)
    orientation = quaternion_of(s.handle_quaternion)
    remaining = (s.substeps - 1 - substep) / s.substeps
    if remaining > 0.0:
        position = subtract(position, scaled(remaining, vector_of(s.handle_step)))
        back = quaternion_exp(scaled(-remaining, vector_of(s.handle_turn)))
        orientation = product(back, orientation)
    m = s.handle_mocap_id
    _store_vector(floats(s.mocap_pos + 24 * m, 3), position)
    _store_quaternion(floats(s.mocap_quat + 32 * m, 4), orientation)
    to_handle = conjugate(orientation)
    rate = 1.0 / s.period
    ctrl = floats(s.ctrl + 8 * s.coupling_ctrl_adr, 6)
    _store_vector(ctrl[0:3], scaled(rate, rotated(to_handle, vector_of(s.handle_step))))
    _store_vector(ctrl[3:6], scaled(rate, rotated(to_handle, vector_of(s.handle_turn))))
    return OK


@compiled
def refresh_energies(state: NDArray[np.void]) -> None:
    """Brings positions and energies to the state after the step (``mj_step`` leaves them before).

    Kinetic energy needs the inertia matrix, potential energy the positions and, where there are
    any, tendon lengths.
    """
    s = state[0]
    if s.has_tendons_or_flexes:
        mj_fwd_kinematics(s.model, s.data)
    else:
        mj_kinematics(s.model, s.data)
    mj_com_pos(s.model, s.data)
    mj_make_m(s.model, s.data)
    mj_energy_pos(s.model, s.data)
    mj_energy_vel(s.model, s.data)
    energy = floats(s.energy, 2)
    s.potential, s.kinetic = energy[0], energy[1]


@compiled
def _limited(v: Vector, limit: float) -> tuple[Vector, bool]:
    length = norm(v)
    if length > limit:
        return scaled(limit / length, v), True
    return v, False


@compiled
def _meter_coupling(
    state: NDArray[np.void], force: Vector, torque: Vector, moved: Vector, turned: Vector
) -> None:
    """Adds this tick to the coupling's port and holds the environment against (14) and the slack.

    E_k = S_k − S_{k−1} − (f_k·δx_k + τ_k·δφ_k) − actuators − external
    slack_k = Σ ½ ‖δx_k‖²_{K + B/T} + ½ ‖δφ_k‖²_{K_r + B_r/T}
    """
    s = state[0]
    work = dot(force, moved) + dot(torque, turned)
    s.coupling_work += work
    s.throughput += abs(work)
    s.slack += 0.5 * (s.stiffness + s.damping / s.period) * dot(moved, moved)
    s.slack += (
        0.5 * (s.rotational_stiffness + s.rotational_damping / s.period) * dot(turned, turned)
    )
    stored = (s.kinetic + s.potential) - s.start_energy
    s.environment_energy = stored - s.coupling_work - s.actuator_work - s.external_work
    allowed = ENERGY_TOLERANCE * (1.0 + s.throughput)
    if s.environment_energy > allowed:
        if s.first_unstrict < 0:
            s.first_unstrict = s.tick
        s.slack_share = max(s.slack_share, s.environment_energy / (s.slack + allowed))
        if s.environment_energy > s.slack + allowed and s.first_active < 0:
            s.first_active = s.tick


@compiled
def _render(state: NDArray[np.void], force: Vector, torque: Vector) -> None:
    """Turns the wrench on the tool into the one on the device: scale, limit by norm, start ramp."""
    s = state[0]
    on_device = scaled(-s.force_scale, _device_from_scene(s.axes, force))
    torque_on_device = scaled(-s.force_scale / s.scale, _device_from_scene(s.axes, torque))
    on_device, is_limited = _limited(on_device, s.force_limit)
    torque_on_device, is_torque_limited = _limited(torque_on_device, s.torque_limit)
    if is_limited or is_torque_limited:
        s.flags |= FORCE_LIMITED
    since_start = s.tick - s.ramp_start
    if since_start < s.ramp_ticks:
        s.flags |= RAMPING
        ramp = (since_start + 1.0) / (s.ramp_ticks + 1.0)
        on_device, torque_on_device = scaled(ramp, on_device), scaled(ramp, torque_on_device)
    _store_vector(s.wrench_on_device[0:3], on_device)
    _store_vector(s.wrench_on_device[3:6], torque_on_device)


@compiled
def after_step(state: NDArray[np.void], row: NDArray[np.void], substep: int) -> int:
    """Meters the step that just ended; after the last substep, computes and records the wrench.

    Returns:
        ``OK`` or ``BAD_RESULT``; in the latter case the wrench on the device is zero.
    """
    s, r = state[0], row[0]
    meter_ports(state)
    if substep + 1 < s.substeps:
        return OK
    refresh_energies(state)

    grip = s.grip_site_id
    tool = vector_of(floats(s.site_xpos + 24 * grip, 3))
    tool_orientation = canonical(quaternion_of(floats(s.site_xquat + 32 * grip, 4)))
    moved = subtract(tool, vector_of(s.tool_position))
    turned = rotation_between(quaternion_of(s.tool_quaternion), tool_orientation)
    stretch = subtract(vector_of(s.handle_position), tool)
    twist = rotation_between(tool_orientation, quaternion_of(s.handle_quaternion))
    rate = 1.0 / s.period
    force = add(
        scaled(s.stiffness, stretch),
        scaled(s.damping * rate, subtract(vector_of(s.handle_step), moved)),
    )
    torque = add(
        scaled(s.rotational_stiffness, twist),
        scaled(s.rotational_damping * rate, subtract(vector_of(s.handle_turn), turned)),
    )
    _store_vector(s.tool_position, tool)
    _store_quaternion(s.tool_quaternion, tool_orientation)

    _meter_coupling(state, force, torque, moved, turned)
    s.flags = 0
    if not math.isfinite(dot(force, force) + dot(torque, torque) + s.environment_energy):
        s.flags = TRIP
        for i in range(6):
            s.wrench_on_device[i] = 0.0
        return BAD_RESULT
    _render(state, force, torque)
    contacts = ints(s.ncon, 1)[0]
    if contacts > 0:
        s.flags |= CONTACT
    s.peak_force = max(s.peak_force, norm(force))
    s.peak_torque = max(s.peak_torque, norm(torque))

    r.flags = s.flags
    r.contacts = contacts
    # without islands MuJoCo counts its iterations as those of island 0
    islands = max(ints(s.nisland, 1)[0], 1)
    iterations = ints(s.solver_niter, min(islands, 20))
    r.solver_iterations = 0
    for i in range(iterations.size):
        r.solver_iterations += iterations[i]
    _store_vector(r.tool_position, tool)
    _store_quaternion(r.tool_quaternion, tool_orientation)
    _store_vector(r.wrench_on_tool[0:3], force)
    _store_vector(r.wrench_on_tool[3:6], torque)
    for i in range(6):
        r.wrench_on_device[i] = s.wrench_on_device[i]
    r.kinetic, r.potential = s.kinetic, s.potential
    r.coupling_work, r.actuator_work = s.coupling_work, s.actuator_work
    r.external_work = s.external_work
    r.environment_energy, r.device_energy = s.environment_energy, s.device_energy
    r.injected_damping = 0.0
    s.tick += 1
    return OK


@compiled
def publish(
    row: NDArray[np.void],
    ring: NDArray[np.void],
    cursors: NDArray[np.int64],
    deadline_ns: int,
    wake_ns: int,
    read_ns: int,
    write_ns: int,
    flags: int,
) -> bool:
    """Completes the record with its times and hands it to the ring (single producer).

    Returns:
        False if the ring is full; nothing was written then, and the call can be repeated.
    """
    head = cursors[HEAD]
    if head - cursors[TAIL] >= ring.size:
        return False
    r = row[0]
    r.deadline_ns, r.wake_ns, r.read_ns, r.write_ns = deadline_ns, wake_ns, read_ns, write_ns
    r.flags |= flags
    ring[head % ring.size] = r
    release_fence()
    cursors[HEAD] = head + 1
    return True


@compiled_for_threads
def simulate(
    state: NDArray[np.void],
    samples: NDArray[np.void],
    row: NDArray[np.void],
    rows: NDArray[np.void],
) -> int:
    """Runs one tick per sample without the interpreter, calling MuJoCo by its C symbol.

    An error inside MuJoCo ends the process here, so one step must have succeeded through Python
    before, and no device may be attached.

    Args:
        state: The bound state.
        samples: Device samples, one per tick.
        row: The bound record.
        rows: Receives the records; as long as ``samples``.

    Returns:
        How many ticks were completed; fewer than asked where a sample or a result was not finite.
    """
    s = state[0]
    for k in range(samples.size):
        for substep in range(s.substeps):
            if before_step(state, samples[k : k + 1], row, substep) != OK:
                return k
            mj_step(s.model, s.data)
            if after_step(state, row, substep) != OK:
                return k
        rows[k] = row[0]
    return int(samples.size)
