"""The tick's arithmetic: before MuJoCo's step, and after it.

The live loop calls ``before_step``, MuJoCo through its Python bindings, ``after.answer_step``, and
once the wrench is out ``after.close_tick`` and ``publish.publish``. Compiled loops inline the same
functions around ``advance``, MuJoCo by its C symbol (``kernel.simulation``).
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled, compiled_for_threads
from hapticbridge.kernel.codes import (
    BAD_RESULT,
    BAD_SAMPLE,
    CONTACT,
    COUPLED,
    DIRECT,
    HALF_DONE,
    HELD,
    LARGEST_CONTROL,
    LOSSLESS,
    MIDPOINT,
    OK,
    RING_FULL,
    TRIP,
)
from hapticbridge.kernel.compared_methods import place_tool
from hapticbridge.kernel.coupling import render, wrench_of_step
from hapticbridge.kernel.guard import DEVICE_BUTTONS, follow, refused
from hapticbridge.kernel.handle import handle_pose, retune
from hapticbridge.kernel.ledger import (
    add_coupling_work,
    judge_environment,
    meter_ports,
    note_moved_mocap_bodies,
    refresh_energies,
)
from hapticbridge.kernel.lossless import apply_carried, finish_lossless
from hapticbridge.kernel.mujoco_c import (
    floats,
    has_warned,
    ints,
    mj_contact_force,
    mj_fwd_position,
    mj_fwd_velocity,
    mj_kinematics,
    mj_sensor_pos,
    mj_sensor_vel,
    mj_step,
    mj_transmission,
    pointer_at,
    release_fence,
)
from hapticbridge.kernel.passivity_controller import observe_energy
from hapticbridge.pose import (
    add,
    canonical,
    conjugate,
    dot,
    norm,
    product,
    quaternion_exp,
    quaternion_of,
    rotated,
    rotation_between,
    scaled,
    store_quaternion,
    store_vector,
    subtract,
    vector_of,
)

# The part of MuJoCo's step that needs no new sample, done ahead while the loop waits for one.
#
# MuJoCo's step is a chain of stages: positions (kinematics, inertia, collisions, constraints),
# velocities, forces, solver, integration. Of the first, only the handle's own pose and the six
# actuators' moments depend on the device: the handle has no mass and no geom. So the live loop
# can run that stage on the new state as soon as the wrench is out. When the sample comes, the
# handle is put to its place, moments and velocities are computed, and MuJoCo's second half
# (``mj_step2``) does the rest. Every number is the one that a whole step would have computed, to
# the bit.
#
# A whole step is done instead where more depends on the sample, or on who had the scene
# meanwhile: at the first tick, after a pause, after a mocap body of the scene was moved, and
# where a position or velocity is so large that MuJoCo's own check at the start of a step would
# reset the scene. Methods and scenes for which it does not hold at all: ``can_split``.


def can_split(model: mujoco.MjModel, scheme: int) -> bool:
    """Tells whether the position stage may run ahead of the sample.

    Not with a weld to the handle, whose constraint rows change with its pose; not where the tool is
    where the handle is; not under RK4, which evaluates all stages four times; and not with a
    plugin or a callback for the controls, which may look at anything.

    Args:
        model: The prepared scene.
        scheme: How the wrench reaches the tool (``kernel.scheme``).
    """
    return (
        scheme in (COUPLED, HELD, LOSSLESS)
        and model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4
        and model.nplugin == 0
        and mujoco.get_mjcb_control() is None
    )


@compiled
def take_handle_in(state: NDArray[np.void]) -> None:
    """Redoes what depends on the handle's pose in the position stage, and the velocity stage.

    None of these can fail where the position stage has just succeeded through Python.
    """
    s = state[0]
    mj_kinematics(s.model, s.data)
    if s.nsensor > 0:
        mj_sensor_pos(s.model, s.data)
    mj_transmission(s.model, s.data)
    mj_fwd_velocity(s.model, s.data)
    if s.nsensor > 0:
        mj_sensor_vel(s.model, s.data)


@compiled
def is_sound(state: NDArray[np.void]) -> bool:
    """Tells whether MuJoCo's check at the start of a step would find nothing to reset."""
    s = state[0]
    for values in (floats(s.qpos, s.nq), floats(s.qvel, s.nv)):
        for value in values:
            if not abs(value) < LARGEST_CONTROL:  # not a number is not less either
                return False
    return True


# The tick after MuJoCo's step, in two parts: the wrench first, then the books.
#
# What the device waits for is only the grip's new pose. Energies, ledger and record need more of
# MuJoCo and can wait until the wrench is out (``kernel.ahead``).


@compiled
def answer_step(state: NDArray[np.void], row: NDArray[np.void], substep: int) -> int:
    """Computes the wrench of the step that just ended; after the last substep, the device's.

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
    force, torque, moved, turned = wrench_of_step(state, substep, is_last)
    s.law_work = dot(force, moved) + dot(torque, turned)
    if s.laws > 1:
        share = 1.0 / s.laws
        force, torque = scaled(share, force), scaled(share, torque)
        if substep > 0:
            w, m = s.wrench_on_tool, s.motion
            force, torque = add(vector_of(w), force), add(vector_of(w[3:6]), torque)
            moved, turned = add(vector_of(m), moved), add(vector_of(m[3:6]), turned)
    store_vector(s.motion[0:3], moved)
    store_vector(s.motion[3:6], turned)
    store_vector(s.wrench_on_tool[0:3], force)
    store_vector(s.wrench_on_tool[3:6], torque)
    if not is_last:
        add_coupling_work(state, s.law_work)
        return OK
    s.flags = MIDPOINT if s.was_midpoint else 0
    s.lossless_ticks += s.was_midpoint
    square = dot(force, force) + dot(torque, torque)
    # MuJoCo ignores a control beyond its limit, so a wrench that is to be applied must stay below
    if (
        not math.isfinite(square)
        or (s.scheme == HELD and square > LARGEST_CONTROL * LARGEST_CONTROL)
        or has_warned(state)
    ):
        return _refuse(state)
    render(state, row, force, torque)
    if s.scheme != LOSSLESS:  # there a contact may be near without a force
        s.active_contacts = ints(s.ncon, 1)[0]
    if s.active_contacts > 0:
        s.flags |= CONTACT
    row[0].solver_iterations = _solver_iterations(state)
    return OK


@compiled
def close_tick(state: NDArray[np.void], row: NDArray[np.void], has_positions: bool) -> int:
    """Closes the tick's balance and completes its record; the wrench is out by then.

    Args:
        state: The bound state after ``answer_step``.
        row: The bound record.
        has_positions: Whether MuJoCo's position stage has run since the step (``kernel.ahead``).

    Returns:
        ``OK`` or ``BAD_RESULT``; in the latter case zero must be sent.
    """
    s = state[0]
    s.has_positions = has_positions
    if s.scheme != DIRECT:
        refresh_energies(state)
    if s.scheme == LOSSLESS:
        finish_lossless(state)
    add_coupling_work(state, s.law_work)
    judge_environment(state)
    if not math.isfinite(s.environment_energy):
        return _refuse(state)
    s.peak_force = max(s.peak_force, norm(vector_of(s.wrench_on_tool)))
    s.peak_torque = max(s.peak_torque, norm(vector_of(s.wrench_on_tool[3:6])))
    if has_positions and not is_sound(state):
        s.has_positions = 0
    _record(state, row)
    s.tick += 1
    return OK


@compiled
def _refuse(state: NDArray[np.void]) -> int:
    s = state[0]
    s.flags = TRIP
    for i in range(6):
        s.wrench_on_device[i] = 0.0
    return BAD_RESULT


@compiled
def _solver_iterations(state: NDArray[np.void]) -> int:
    s = state[0]
    # without islands MuJoCo counts its iterations as those of island 0
    islands = max(ints(s.nisland, 1)[0], 1)
    total = 0
    for iterations in ints(s.solver_niter, min(islands, 20)):
        total += iterations
    return total


@compiled
def _record(state: NDArray[np.void], row: NDArray[np.void]) -> None:
    """Copies what the tick computed into its record."""
    s, r = state[0], row[0]
    r.flags = s.flags
    r.contacts = s.active_contacts
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
    r.injected_rotational_damping = s.injected_rotational_damping


# The end of a tick: its balance, and the record's way to the ring, where the recorder takes it.

HEAD, TAIL = 0, 1
"""Cursors of the ring: records written, records read."""

SEQUENCE, NUMBER, CONTACTS = 0, 1, 2
"""Head of a snapshot: sequence, odd during a write; number of the record; count of contacts."""


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


@compiled
def finish_tick(
    state: NDArray[np.void],
    row: NDArray[np.void],
    ring: NDArray[np.void],
    cursors: NDArray[np.int64],
    deadline_ns: int,
    wake_ns: int,
    read_ns: int,
    write_ns: int,
    flags: int,
    has_positions: bool,
) -> int:
    """Does ``close_tick`` and ``publish`` in one call: a second one would cost 0.2 µs.

    Returns:
        What ``close_tick`` returns, or ``RING_FULL``: then only ``publish`` is to be repeated.
    """
    code = close_tick(state, row, has_positions)
    if code != OK:
        return code
    taken = publish(row, ring, cursors, deadline_ns, wake_ns, read_ns, write_ns, flags)
    return OK if taken else RING_FULL


@compiled
def publish_positions(
    state: NDArray[np.void],
    cursors: NDArray[np.int64],
    head: NDArray[np.int64],
    numbers: NDArray[np.float64],
) -> None:
    """Copies the scene's positions and contacts to a snapshot (``recording.snapshot``).

    Call it after MuJoCo's step and before the next one begins, while the contact forces of the step
    are there. It changes nothing that the tick reads.

    Args:
        state: The kernel's state.
        cursors: The ring's; the record of this tick is the next one to be written there.
        head: The snapshot's head.
        numbers: The snapshot's numbers: slack, positions, mocap poses, then 6 a contact.
    """
    s = state[0]
    head[SEQUENCE] += 1
    release_fence()
    numbers[0], end = s.slack, 1
    for source, count in (
        (s.qpos, s.nq),
        (s.mocap_pos, 3 * s.nmocap),
        (s.mocap_quat, 4 * s.nmocap),
    ):
        numbers[end : end + count] = floats(source, count)
        end += count
    shown = min(ints(s.ncon, 1)[0], (numbers.size - end) // 6)
    for c in range(shown):
        contact = pointer_at(s.contact) + c * s.contact_size
        slot, frame = numbers[end : end + 6], floats(contact + s.contact_frame, 9)
        mj_contact_force(s.model, s.data, c, slot.ctypes.data)  # along the axes of its frame
        normal, first, second = slot[0], slot[1], slot[2]
        slot[:3] = floats(contact + s.contact_point, 3)
        for axis in range(3):
            slot[3 + axis] = (
                normal * frame[axis] + first * frame[3 + axis] + second * frame[6 + axis]
            )
        end += 6
    head[NUMBER], head[CONTACTS] = cursors[HEAD], shown
    release_fence()
    head[SEQUENCE] += 1


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
        store_vector(ctrl[0:3], rotated(to_handle, vector_of(w)))
        store_vector(ctrl[3:6], rotated(to_handle, vector_of(w[3:6])))
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
        ``OK``, ``HALF_DONE`` where MuJoCo's step needs only its second half, ``BAD_SAMPLE`` or why
        ``watch.refused`` it; in these cases nothing was changed.
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
        # exactly none where it did not turn: rounding would be a speed that the controller damps
        turned, last = (0.0, 0.0, 0.0), quaternion_of(s.device_quaternion)
        if quaternion != last:
            turned = rotation_between(last, quaternion)
        code = refused(state, moved, turned, elapsed)
        if code != OK:
            return code
        # old samples hide how the device moved: it took all the time since the last new one
        interval = max(elapsed, s.period) + s.since_news
        observe_energy(state, moved, turned, interval)
        w = s.wrench_on_device
        s.device_energy += dot(vector_of(w), moved) + dot(vector_of(w[3:6]), turned)
        if s.tick > s.ramp_start:
            # before the first tick and in a pause nobody knows how long the device took to move
            s.device_burnt += s.device_damping / interval * dot(moved, moved)
            s.device_burnt += s.device_rotational_damping / interval * dot(turned, turned)
        store_vector(s.device_position, position)
        store_quaternion(s.device_quaternion, quaternion)

        handle, orientation = vector_of(s.handle_position), quaternion_of(s.handle_quaternion)
        buttons = (sample[0].buttons & DEVICE_BUTTONS) | s.commanded
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
        if s.tuning_ticks > 0:
            retune(state)

        r.tick = s.tick
        r.buttons = buttons
        store_vector(r.device_position, position)
        store_quaternion(r.device_quaternion, quaternion)
        store_vector(r.handle_position, handle)
        store_quaternion(r.handle_quaternion, orientation)

    _show_handle(state, substep)
    if s.has_positions:
        s.has_positions = 0
        if not s.mocap_has_moved:
            take_handle_in(state)
            return HALF_DONE
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
def after_step(state: NDArray[np.void], row: NDArray[np.void], substep: int) -> int:
    """Meters the step that just ended; after the last substep, computes and records the wrench.

    Returns:
        ``OK`` or ``BAD_RESULT``; in the latter case the wrench on the device is zero.
    """
    code = answer_step(state, row, substep)
    if code != OK or substep + 1 != state[0].substeps:
        return code
    return close_tick(state, row, False)


# Whole ticks without the interpreter: what the live loop does, for re-simulation and sweeps.
#
# An error inside MuJoCo ends the process here, so one step must have succeeded through Python
# before, and no device may be attached.


@compiled
def _tick(
    state: NDArray[np.void], sample: NDArray[np.void], row: NDArray[np.void], elapsed: float
) -> bool:
    """Runs one tick; returns whether sample and result were finite."""
    for substep in range(state[0].substeps):
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
    """Runs one tick per sample.

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
