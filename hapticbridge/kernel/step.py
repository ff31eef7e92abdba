"""The tick's arithmetic: before MuJoCo's step, and after it.

The live loop calls ``before_step``, MuJoCo through its Python bindings, ``after_step`` and
``publish.publish``; the re-simulation calls ``simulate``, which inlines the same functions around
``advance``, MuJoCo by its C symbol.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled, compiled_for_threads
from hapticbridge.kernel.account import keep_account
from hapticbridge.kernel.direct import place_tool
from hapticbridge.kernel.handle import (
    handle_pose,
    quaternion_of,
    store_quaternion,
    store_vector,
    vector_of,
)
from hapticbridge.kernel.lossless import apply_carried
from hapticbridge.kernel.meter import (
    add_coupling_work,
    judge_environment,
)
from hapticbridge.kernel.native import floats, has_warned, ints, mj_fwd_position, mj_step
from hapticbridge.kernel.ports import meter_ports, note_moved_mocap_bodies
from hapticbridge.kernel.scheme import DIRECT, HELD, LOSSLESS
from hapticbridge.kernel.watch import follow, refused
from hapticbridge.kernel.wrench import render, wrench_of_step
from hapticbridge.pose import (
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
CONTACT, TRIP, MIDPOINT = 64, 512, 1024

OK, BAD_SAMPLE, BAD_RESULT = 0, 1, 2
"""What a kernel function returns: go on, the device's sample is not finite, the simulation's
result is not finite."""

LARGEST_CONTROL = 1e10
"""mjMAXVAL, in N and N m. Beyond it the run has diverged anyway."""


@compiled
def _show_handle(state: NDArray[np.void], substep: int) -> None:
    """Puts the handle where it is in this substep, and gives the actuators their control."""
    s = state[0]
    position = vector_of(s.handle_position)
    orientation = quaternion_of(s.handle_quaternion)
    remaining = (s.substeps - 1 - substep) / s.substeps
    if remaining > 0.0:
        position = subtract(position, scaled(remaining, vector_of(s.handle_step)))
        back = quaternion_exp(scaled(-remaining, vector_of(s.handle_turn)))
        orientation = product(back, orientation)
    m = s.handle_mocap_id
    store_vector(floats(s.mocap_pos + 24 * m, 3), position)
    store_quaternion(floats(s.mocap_quat + 32 * m, 4), orientation)
    if s.scheme == DIRECT:
        place_tool(state)
        return
    to_handle = conjugate(orientation)
    ctrl = floats(s.ctrl + 8 * s.coupling_ctrl_adr, 6)
    if s.scheme == HELD:
        w = s.wrench_on_tool  # of the tick before: held, as a zero-order hold would
        store_vector(ctrl[0:3], rotated(to_handle, (w[0], w[1], w[2])))
        store_vector(ctrl[3:6], rotated(to_handle, (w[3], w[4], w[5])))
        return
    if s.scheme == LOSSLESS:
        apply_carried(state)
    rate = 1.0 / s.period
    store_vector(ctrl[0:3], scaled(rate, rotated(to_handle, vector_of(s.handle_step))))
    store_vector(ctrl[3:6], scaled(rate, rotated(to_handle, vector_of(s.handle_turn))))


@compiled
def before_step(
    state: NDArray[np.void],
    sample: NDArray[np.void],
    row: NDArray[np.void],
    substep: int,
    elapsed: float,
) -> int:
    """Takes a device sample into the scene: the handle's pose, and its velocity as ``ctrl``.

    Over substeps the handle moves uniformly from its previous pose to the new one, which it
    reaches in the last. The control of the coupling's actuators is the handle's velocity in the
    handle's own axes, R_hᵀ δh/T and R_hᵀ δφ_h/T: a mocap body has no velocity of its own. Where
    the wrench is applied and held, the control is the wrench of the tick before, in those axes.

    Over a time t, the device's damper burns ∫ b v² >= b ‖δp‖²/t for every motion that ends δp away.
    Where deadlines were missed t is longer than T, and T would count more than was burnt.

    Args:
        state: The bound state.
        sample: One device sample.
        row: The bound record.
        substep: Which of the tick's.
        elapsed: Time since the sample before it in s. One below T counts as T: that counts less
            than was burnt, and an uneven time stamp must not count more.

    Returns:
        ``OK``; else ``BAD_SAMPLE`` or why ``watch.refused`` it, and nothing was changed.
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
        code = refused(state, moved, turned, elapsed)
        if code != OK:
            return code
        keep_account(state, moved, turned, elapsed)
        w = s.wrench_on_device
        s.device_energy += dot((w[0], w[1], w[2]), moved) + dot((w[3], w[4], w[5]), turned)
        if s.tick > s.ramp_start:
            # before the first tick and in a pause nobody knows how long the device took to move
            interval = max(elapsed, s.period)
            s.device_burnt += s.device_damping / interval * dot(moved, moved)
            s.device_burnt += s.device_rotational_damping / interval * dot(turned, turned)
        store_vector(s.device_position, position)
        store_quaternion(s.device_quaternion, quaternion)

        handle, orientation = vector_of(s.handle_position), quaternion_of(s.handle_quaternion)
        buttons = sample[0].buttons
        if follow(state, position, quaternion, moved, turned, buttons, elapsed):
            handle, orientation = handle_pose(state, position, quaternion)
        store_vector(s.handle_step, subtract(handle, vector_of(s.handle_position)))
        store_vector(
            s.handle_turn, rotation_between(quaternion_of(s.handle_quaternion), orientation)
        )
        store_vector(s.handle_position, handle)
        store_quaternion(s.handle_quaternion, orientation)
        if s.nmocap > 1:
            note_moved_mocap_bodies(state)

        r.tick = s.tick
        r.buttons = sample[0].buttons
        store_vector(r.device_position, position)
        store_quaternion(r.device_quaternion, quaternion)
        store_vector(r.handle_position, handle)
        store_quaternion(r.handle_quaternion, orientation)

    _show_handle(state, substep)
    return OK


@compiled
def advance(state: NDArray[np.void]) -> None:
    """MuJoCo's part of a substep, by C symbol: what ``Method.step`` is in Python.

    A massless tool has no dynamics: for it only positions and contacts are computed.
    """
    s = state[0]
    if s.scheme == DIRECT:
        mj_fwd_position(s.model, s.data)
    else:
        mj_step(s.model, s.data)


@compiled
def _record(state: NDArray[np.void], row: NDArray[np.void]) -> None:
    """Copies what the tick computed into its record."""
    s, r = state[0], row[0]
    r.flags = s.flags
    r.contacts = s.active_contacts
    # without islands MuJoCo counts its iterations as those of island 0
    islands = max(ints(s.nisland, 1)[0], 1)
    iterations = ints(s.solver_niter, min(islands, 20))
    r.solver_iterations = 0
    for i in range(iterations.size):
        r.solver_iterations += iterations[i]
    store_vector(r.tool_position, vector_of(s.tool_position))
    store_quaternion(r.tool_quaternion, quaternion_of(s.tool_quaternion))
    for i in range(6):
        r.wrench_on_tool[i] = s.wrench_on_tool[i]
        r.wrench_on_device[i] = s.wrench_on_device[i]
    r.kinetic, r.potential = s.kinetic, s.potential
    r.coupling_work, r.actuator_work = s.coupling_work, s.actuator_work
    r.external_work = s.external_work
    r.environment_energy, r.device_energy = s.environment_energy, s.device_energy
    r.injected_damping = s.injected_damping


@compiled
def after_step(state: NDArray[np.void], row: NDArray[np.void], substep: int) -> int:
    """Meters the step that just ended; after the last substep, computes and records the wrench.

    With several laws a tick the wrench is their mean: the handle moves uniformly within a tick, so
    the mean does on it the work that the single ones did.

    Returns:
        ``OK`` or ``BAD_RESULT``; in the latter case the wrench on the device is zero.
    """
    s = state[0]
    if s.scheme != DIRECT:
        meter_ports(state)
    is_last = substep + 1 == s.substeps
    if s.laws == 1 and not is_last:
        return OK
    was_midpoint = s.is_midpoint != 0
    force, torque, moved, turned = wrench_of_step(state, substep, is_last)
    add_coupling_work(state, force, torque, moved, turned)
    if s.laws > 1:
        share = 1.0 / s.laws
        force, torque = scaled(share, force), scaled(share, torque)
        if substep > 0:
            w, m = s.wrench_on_tool, s.motion
            force = add((w[0], w[1], w[2]), force)
            torque = add((w[3], w[4], w[5]), torque)
            moved = add((m[0], m[1], m[2]), moved)
            turned = add((m[3], m[4], m[5]), turned)
        store_vector(s.motion[0:3], moved)
        store_vector(s.motion[3:6], turned)
    store_vector(s.wrench_on_tool[0:3], force)
    store_vector(s.wrench_on_tool[3:6], torque)
    if not is_last:
        return OK
    judge_environment(state, moved, turned)
    s.flags = MIDPOINT if was_midpoint else 0
    square = dot(force, force) + dot(torque, torque)
    # MuJoCo ignores a control beyond its limit, so a wrench that is to be applied must stay below
    if (
        not math.isfinite(square + s.environment_energy)
        or (s.scheme == HELD and square > LARGEST_CONTROL * LARGEST_CONTROL)
        or has_warned(state)
    ):
        s.flags = TRIP
        for i in range(6):
            s.wrench_on_device[i] = 0.0
        return BAD_RESULT
    render(state, force, torque)
    if s.scheme != LOSSLESS:  # there a contact may be near without a force
        s.active_contacts = ints(s.ncon, 1)[0]
    if s.active_contacts > 0:
        s.flags |= CONTACT
    s.peak_force = max(s.peak_force, norm(force))
    s.peak_torque = max(s.peak_torque, norm(torque))

    _record(state, row)
    s.tick += 1
    return OK


@compiled
def _tick(
    state: NDArray[np.void], sample: NDArray[np.void], row: NDArray[np.void], elapsed: float
) -> bool:
    s = state[0]
    for substep in range(s.substeps):
        if before_step(state, sample, row, substep, elapsed) != OK:
            return False
        advance(state)
        if after_step(state, row, substep) != OK:
            return False
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
    for k in range(samples.size):
        if not _tick(state, samples[k : k + 1], row, state[0].period):
            return k
        rows[k] = row[0]
    return int(samples.size)


@compiled_for_threads
def simulate_recorded(
    state: NDArray[np.void],
    samples: NDArray[np.void],
    outside: NDArray[np.int64],
    elapsed: NDArray[np.float64],
    row: NDArray[np.void],
    rows: NDArray[np.void],
) -> int:
    """As ``simulate``, of a run that was recorded: with what came from outside the scene.

    Args:
        state: The bound state.
        samples: Device samples, one per tick.
        outside: ``STALE_SAMPLE`` and ``RESEATED`` as the live loop had them, per tick.
        elapsed: Time between two samples in s, per tick.
        row: The bound record.
        rows: Receives the records; as long as ``samples``.
    """
    for k in range(samples.size):
        state[0].outside = outside[k]
        if not _tick(state, samples[k : k + 1], row, elapsed[k]):
            return k
        rows[k] = row[0]
    return int(samples.size)
