"""The arithmetic of a tick before and after MuJoCo's step, and the end of a tick.

    live loop (``Bridge``)                whole_tick (re-simulation, sweeps)
    1. the device is read                 1. the sample is given
    2. before_step                        2. before_step
    3. MuJoCo by its Python bindings      3. advance: MuJoCo by its C symbol
    4. answer_step                        4. after_step: answer_step,
    5. the wrench is sent                 5.   no device,
    6. finish_tick: close_tick, publish   6.   close_tick

2 to 4 are repeated for each substep. Both inline the same functions and agree to the bit. The end
of a tick has five functions:

    function          called by                                  does
    answer_step       live loop, after_step                      wrenches of a step
    finish_tick       live loop, when the wrench was sent        close_tick, publish
    close_tick        finish_tick, after_step, last substep      balance of all hands
    complete_record   close_tick, for each hand                  peaks, record, count
    publish           finish_tick; live loop if ring was full    records to the ring

Each hand has a state of its own (``state.STATE_DTYPE``): device, handle, coupling, force level,
guard and account. All states are bound to one model and its data; the first one meters the scene,
and has its rigid contacts and their tank. With n hands

    E_k = S_k − S_{k−1} − Σ_i (f_i·δx_i + τ_i·δφ_i) − W_actuators − W_external

and the slack is the sum of the hands' slacks. MuJoCo solves all couplings in one step, so two hands
may hold one body. For each device, the other hands are ports of the scene: energy that another hand
put in may reach it. Several hands need a scheme that allows them (``Scheme.properties``).
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.codes import (
    BAD_RESULT,
    BAD_SAMPLE,
    CONTACT,
    GAVE_ENERGY,
    HALF_DONE,
    HAND_CODES,
    MAX_CONTROL,
    OK,
    RING_FULL,
    TRIP,
    Part,
    Scheme,
    State,
)
from hapticbridge.kernel.compared_methods import compared_wrench, drive_compared
from hapticbridge.kernel.contact_margins import follow_speed
from hapticbridge.kernel.elastic import follow_elastic
from hapticbridge.kernel.explicit_bias import take_back, take_mean_bias_in_substep
from hapticbridge.kernel.force_level import (
    keep_state,
    limited_wrench,
    limited_wrench_after_step,
    settled_wrench,
    spend_within_tank,
)
from hapticbridge.kernel.handle import (
    UPRIGHT,
    anchor_handle,
    device_from_scene,
    follow_in_part,
    handle_pose,
    move_device,
    move_handle,
    place_handle,
    take_actuator_velocities,
    take_handle_frames,
    turns_actuators_alone,
)
from hapticbridge.kernel.impact_pulse import add_pulse, charge_pulses, earn, note_blows
from hapticbridge.kernel.jit import compiled, compiled_for_threads
from hapticbridge.kernel.law import (
    charge_lag,
    charge_lateness,
    command_handle_velocity,
    felt,
    note_sent,
    note_tool,
    retune,
    slack_of_step,
    slip,
)
from hapticbridge.kernel.ledger import (
    add_coupling_work,
    add_slack,
    add_up_hands,
    end_mocap_moves,
    judge_balance,
    meter_device,
    meter_ports,
    note_moved_mocap_bodies,
    refresh_energies,
)
from hapticbridge.kernel.lossless import (
    apply_carried,
    finish_lossless,
    lossless_flag,
    lossless_wrench,
    note_slip,
)
from hapticbridge.kernel.mujoco_c import (
    floats,
    ints,
    mj_contact_force,
    mj_fwd_position,
    mj_fwd_velocity,
    mj_sensor_pos,
    mj_sensor_vel,
    mj_step,
    mj_step1,
    mj_step2,
    pointer_at,
    release_fence,
    warning_at,
)
from hapticbridge.kernel.passivity_controller import (
    control,
    foreseen_excess,
    observe_energy,
    observe_release,
    within_energy_limit,
)
from hapticbridge.kernel.pose import (
    Quaternion,
    Vector,
    add,
    canonical,
    dot,
    norm,
    quaternion_of,
    rotation_between,
    scaled,
    store_quaternion,
    store_vector,
    subtract,
    vector_of,
)
from hapticbridge.kernel.rigid_contact import aim_contacts, fill_tank, finish_contacts
from hapticbridge.kernel.shown_tool import (
    hand_over,
    note_contacts,
    shown_wrench,
    take_over,
    take_posted,
)
from hapticbridge.kernel.springs import restore_springs
from hapticbridge.kernel.swing_watch import watch_device
from hapticbridge.kernel.tick_guard import (
    DEVICE_BUTTONS,
    advance_lever,
    note_anchored,
    refusal,
    send_within,
)
from hapticbridge.kernel.timing import keep_account, note_motion

LOOP_DTYPE = np.dtype(
    [
        ("tick", "<i8"),
        ("flags", "<i8"),
        ("external_flags", "<i8"),
        ("has_positions", "<i8"),
        ("active_contacts", "<i8"),
        ("law_work", "<f8"),
        ("peak_force", "<f8"),
        ("peak_torque", "<f8"),
        ("peak_tool_force", "<f8"),
        ("peak_tool_torque", "<f8"),
        ("wrench_on_tool", "<f8", 6),
        ("motion", "<f8", 6),
        ("wrench_on_device", "<f8", 6),
        ("reported", "<f8", 6),
        ("spread", "<f8", 6),
        ("unfelt", "<f8", 6),
    ]
)
"""Sub-record ``loop``, written by this module alone: results that one stage of a tick hands to the
next. ``external_flags`` is ``STALE_SAMPLE`` as the live loop or a recording has it, set
before the tick, and so is ``reported``, the wrench that a device with a loop of its own says that
it had at its sample; ``spread`` is by how much its mean over the last tick is not known;
``has_positions`` is 1 if MuJoCo's position stage has run since the step; ``motion`` is the tool's,
in m and rad; ``unfelt`` is the wrench that axes without a motor would be sent; wrenches in N and N
m, peaks since the start."""


# Before MuJoCo's step

_AT_REST = (0.0, 0.0, 0.0)


@compiled
def _is_pose(position: Vector, quaternion: Quaternion) -> bool:
    """Returns True if the numbers are finite and the quaternion is not near zero."""
    square = 0.0
    for i in range(4):
        square += quaternion[i] * quaternion[i]
    return math.isfinite(dot(position, position) + square) and square > 0.25


@compiled
def _device_motion(pose: Part, position: Vector, quaternion: Quaternion) -> tuple[Vector, Vector]:
    """Returns motion and rotation vector of the device since the previous tick.

    The rotation is exactly zero without a turn: rounding would be a velocity that the controller
    damps.
    """
    turned, last = (0.0, 0.0, 0.0), quaternion_of(pose.device_quaternion)
    if quaternion != last:
        turned = rotation_between(last, quaternion)
    return subtract(position, vector_of(pose.device_position)), turned


@compiled
def _take_mean_wrench(s: State, interval: float) -> None:
    """Takes the mean of a device's own wrench since its last new sample, by the trapezoidal rule.

    In a pause, or a silence in which the force fades, the ends say nothing of it, and it counts as
    none. ``spread`` is by how much it may have been another one on the way.
    """
    loop, longest = s.loop, (s.guard.stale_ticks + 1) * s.run.period
    share = 0.0 if interval > longest or loop.tick == s.guard.start_tick else 0.5
    for i in range(6):
        before, now = loop.wrench_on_device[i], loop.reported[i]
        loop.wrench_on_device[i], loop.spread[i] = share * (before + now), share * abs(before - now)


@compiled
def take_sample(s: State, sample: State, row: State, elapsed: float) -> int:
    """Checks a sample, observes the energy of the previous tick, and moves the handle.

    A joint is moved by the device's x axis alone.

    Returns:
        ``OK``, or the reason to refuse the sample; nothing was changed then.
    """
    pose = s.pose
    # the device may have moved during all the time since its last new sample
    interval = max(elapsed, s.run.period) + s.guard.time_since_sample
    if s.run.is_apart:
        _take_mean_wrench(s, interval)
    position = vector_of(sample.position)
    if not _is_pose(position, quaternion_of(sample.quaternion)):
        return BAD_SAMPLE
    quaternion = canonical(quaternion_of(sample.quaternion))
    if s.mj.held_qpos != 0:
        position, quaternion = (position[0], 0.0, 0.0), UPRIGHT
    moved, turned = _device_motion(pose, position, quaternion)
    code = refusal(s, moved, turned, elapsed)
    if code != OK:
        return code
    ticks = s.guard.consecutive_stale + 1
    charge_pulses(s, moved, max(elapsed, s.run.period))
    observe_energy(s, moved, turned, interval)
    meter_device(s, moved, turned, interval)
    watch_device(s, moved, turned, interval)
    move_device(pose, position, quaternion)

    buttons = (sample.buttons & DEVICE_BUTTONS) | s.guard.commanded
    lever = s.guard.lever  # of the wrench that was held until now
    if lever == 1.0:
        handle, orientation = handle_pose(s.run, pose, position, quaternion)
    else:
        handle, orientation = follow_in_part(s.run, pose, lever, moved, turned)
    move_handle(pose, handle, orientation)
    advance_lever(s, position, buttons, elapsed)
    max_stretch = max_twist = np.inf
    is_timed = s.run.has_law and s.guard.has_hand and s.loop.tick > s.guard.start_tick
    is_timed = is_timed and not s.run.is_apart  # else nothing waits for a sample
    if is_timed:
        charge_lateness(s, interval, ticks)
        charge_lag(s, lever, ticks, moved, turned)
    else:
        note_tool(s)
    if s.mj.metered_mocaps > 0 and s.run.scheme != Scheme.SHOWN:
        note_moved_mocap_bodies(s)
    if s.coupling.tuning_ticks > 0:
        max_stretch, max_twist = retune(s)
        s.loop.has_positions = 0  # it was computed with the old gains
    has_slipped = slip(s, max_stretch, max_twist)
    note_motion(s, moved, turned, lever, is_timed)
    if has_slipped and s.run.scheme == Scheme.MIDPOINT:
        note_slip(s)
    if has_slipped or (lever < 1.0 and (moved != _AT_REST or turned != _AT_REST)):
        anchor_handle(pose)
        note_anchored(s.guard)
    row.buttons = buttons
    _record_sample(s, row)
    return OK


@compiled
def _record_sample(s: State, r: State) -> None:
    pose = s.pose
    r.tick = s.loop.tick
    store_vector(r.device_position, vector_of(pose.device_position))
    store_quaternion(r.device_quaternion, quaternion_of(pose.device_quaternion))
    store_vector(r.handle_position, vector_of(pose.handle_position))
    store_quaternion(r.handle_quaternion, quaternion_of(pose.handle_quaternion))


@compiled
def before_step(
    state: NDArray[np.void],
    sample: NDArray[np.void],
    row: NDArray[np.void],
    substep: int,
    elapsed: float,
) -> int:
    """Moves every handle by its device's sample, and gives MuJoCo the controls of its next step.

    Args:
        state: The bound states, one per hand, in order.
        sample: One device sample per hand.
        row: The bound records.
        substep: Number of the substep in this tick; the sample is read in substep 0.
        elapsed: Time since the previous sample in s. Values below T are raised to T; a short
            interval would overstate the energy that the damper dissipates, b ‖δp‖²/t.

    Returns:
        ``OK``; ``HALF_DONE`` if only the second half of MuJoCo's step is left to do; ``BAD_SAMPLE``
        or a result of ``tick_guard.refusal`` for the first hand that is refused, plus
        ``HAND_CODES`` times its number. The run must end then: the hands before it have moved.
    """
    s = state[0]
    if substep == 0:
        for i in range(state.size):
            code = take_sample(state[i], sample[i], row[i], elapsed)
            if code != OK:
                return code + HAND_CODES * i
    scheme = s.run.scheme
    if scheme == Scheme.SHOWN:
        return OK
    for i in range(state.size):
        orientation = place_handle(state[i], substep)
        if scheme == Scheme.IMPLICIT:
            command_handle_velocity(state[i], orientation)
        elif scheme == Scheme.MIDPOINT:
            apply_carried(s)
            command_handle_velocity(s, orientation)
        else:
            drive_compared(state[i], orientation)
    if s.level.is_solved:
        keep_state(s)
    if s.loop.has_positions:
        s.loop.has_positions = 0
        if not s.energy.mocap_has_moved:
            take_handle_in(s)
            return HALF_DONE
    return OK


# The position stage of MuJoCo's step, ahead of the sample
#
# MuJoCo's step is a chain of stages: positions (kinematics, inertia, collisions, constraints),
# velocities, forces, solver, integration. In the first stage, only the handle's pose and the six
# actuators' moments depend on the device, because the handle has no mass and no geom. The live loop
# therefore runs that stage on the new state as soon as the wrench is sent, and the velocity stage
# where the velocities of those actuators alone depend on it. When the sample comes, the handle is
# placed, moments and velocities are computed, and MuJoCo's second half (``mj_step2``) does the
# rest. Every number equals that of a whole step to the bit.
#
# A whole step is done if more depends on the sample or the scene may have been changed: at the
# first tick, after a pause, after a move of a mocap body, and if a position or velocity is so large
# that MuJoCo's check at the start of a step would reset the scene.


def can_split(model: mujoco.MjModel, scheme: int) -> bool:
    """Returns True if the position stage may run ahead of the sample.

    It may not with a weld to the handle, whose constraint rows change with its pose; with a tool
    that is placed at the handle; under RK4, which evaluates all stages four times; and with a
    plugin, which may read any number.

    Args:
        model: The prepared scene.
        scheme: One of ``Scheme``.
    """
    return (
        Scheme(scheme).properties.may_split
        and model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4
        and model.nplugin == 0
    )


@compiled
def take_handle_in(s: State) -> None:
    """Repeats what depends on the handle in the stages of positions and velocities.

    They cannot fail after a position stage that has just succeeded through Python.
    """
    mj = s.mj
    take_handle_frames(s)
    if mj.nsensor > 0:
        mj_sensor_pos(mj.model, mj.data)
    if turns_actuators_alone(s):
        take_actuator_velocities(mj)
    else:
        take_velocities(s)
    if mj.nsensor > 0:
        mj_sensor_vel(mj.model, mj.data)


@compiled
def take_velocities(s: State) -> None:
    """Runs the velocity stage, and makes the contacts of the coming step rigid."""
    mj_fwd_velocity(s.mj.model, s.mj.data)
    aim_contacts(s)


@compiled
def is_sound(s: State) -> bool:
    """Returns True if MuJoCo's check at the start of a step would find nothing to reset."""
    mj, outside = s.mj, 0
    for values in (floats(mj.qpos, mj.nq), floats(mj.qvel, mj.nv)):
        for value in values:  # without a branch, so that several are compared at once
            outside |= not abs(value) < MAX_CONTROL  # also for a value that is not a number
    return outside == 0


@compiled
def advance(state: NDArray[np.void]) -> None:
    """Runs MuJoCo's part of a substep by C symbol; ``BoundKernel.step`` is its twin in Python.

    A tool without mass has no dynamics; for it, only positions and contacts are computed.
    """
    s = state[0]
    mj = s.mj
    if s.run.scheme == Scheme.MASSLESS:
        mj_fwd_position(mj.model, mj.data)
    elif s.contact.is_rigid:
        mj_step1(mj.model, mj.data)
        aim_contacts(s)
        mj_step2(mj.model, mj.data)
    else:
        mj_step(mj.model, mj.data)


@compiled
def between_halves(state: NDArray[np.void]) -> None:
    """Runs the part of ``advance`` between MuJoCo's halves, for ``BoundKernel.step``."""
    aim_contacts(state[0])


# After MuJoCo's step: first the wrench, because the device waits for it, then energies and record


@compiled
def _evaluate(states: NDArray[np.void], is_last: bool) -> tuple[Vector, Vector, Vector, Vector]:
    """Returns the first hand's force and torque, and its tool's motion and turn, after a step.

    The levels of all hands are settled then, because one that is reached changes the step of the
    others.
    """
    s = states[0]
    if s.run.scheme == Scheme.IMPLICIT:
        return limited_wrench_after_step(states, is_last)
    if s.run.scheme == Scheme.MIDPOINT:
        return lossless_wrench(states)
    if s.run.scheme == Scheme.SHOWN:
        return shown_wrench(s)
    return compared_wrench(states, is_last)


@compiled
def _failure(s: State, square: float) -> int:
    """Returns the result for a step that is not usable, or ``OK``; ``square`` is |wrench|²."""
    # another thread may be in the step of a slower scene
    is_shown = s.run.scheme == Scheme.SHOWN
    code = s.shown.failure if is_shown else warning_at(s.mj.warnings)
    # MuJoCo ignores a control beyond its limit, so a wrench to be applied must stay below
    is_too_large = square > MAX_CONTROL * MAX_CONTROL
    if code == OK and (not math.isfinite(square) or (s.run.holds_wrench and is_too_large)):
        return BAD_RESULT
    return int(code)


@compiled
def active_contacts(s: State) -> int:
    """Returns the count of contacts that act, or in some schemes exist, after a step."""
    if s.run.scheme == Scheme.SHOWN:
        return int(s.shown.contacts)
    if s.contact.is_rigid:
        return int(s.contact.active_contacts)
    if s.run.scheme == Scheme.MIDPOINT:  # a near contact may exist without a force
        return int(s.lossless.active_contacts)
    return int(ints(s.mj.ncon, 1)[0])


@compiled
def answer_step(state: NDArray[np.void], row: NDArray[np.void], substep: int) -> int:
    """Computes the wrenches of the step that just ended; after the last substep also the devices'.

    With several evaluations of the law per tick, the wrench is their mean. The handle moves
    uniformly within a tick, so the mean does the same work on it as the single wrenches.

    Returns:
        ``OK``; ``BAD_RESULT`` or the result of a warning of MuJoCo (``mujoco_c.warning_at``);
        ``GAVE_ENERGY`` if the wrench would pass the energy limit in the next tick; with the hand
        as ``before_step`` has it. Unless it is ``OK``, the wrench on every device is zero.
    """
    s = state[0]
    loop, scheme, count = s.loop, s.run.scheme, s.run.law_evaluations
    spend_within_tank(s)
    if s.contact.is_rigid:
        follow_speed(s)
    is_last = substep + 1 == s.run.substeps
    if scheme not in (Scheme.MASSLESS, Scheme.SHOWN):
        meter_ports(s)
    if s.impact.share > 0.0 or (s.contact.bounces and s.contact.rebound_ratio > 0.0):
        note_blows(s)
    if count == 1 and not is_last:
        follow_elastic(s)
        end_mocap_moves(s)
        return OK
    if s.shown.is_beside:
        note_contacts(s)
    force, torque, moved, turned = _evaluate(state, is_last)
    end_mocap_moves(s)
    if s.contact.is_rigid:
        finish_contacts(s)
    work = s.shown.work if scheme == Scheme.SHOWN else dot(force, moved) + dot(torque, turned)
    if count > 1:
        share = 1.0 / count
        force, torque = scaled(share, force), scaled(share, torque)
        if substep > 0:
            w, m = loop.wrench_on_tool, loop.motion
            force, torque = add(vector_of(w), force), add(vector_of(w[3:6]), torque)
            moved, turned = add(vector_of(m), moved), add(vector_of(m[3:6]), turned)
    keep_wrench(s, work, force, torque, moved, turned)
    for i in range(1, state.size):
        force, torque, moved, turned = settled_wrench(state[i], is_last)
        work = dot(force, moved) + dot(torque, turned)
        keep_wrench(state[i], work, force, torque, moved, turned)
    if not is_last:
        add_coupling_work(s.energy, loop.law_work)
        follow_elastic(s)
        take_mean_bias_in_substep(s)
        return OK
    contacts, code = active_contacts(s), OK
    for i in range(state.size):
        sent = send_wrench(state[i], row[i], contacts)
        if code == OK and sent != OK:
            code = sent + HAND_CODES * i
    return code if code == OK else refuse_tick(state, code)


@compiled
def keep_wrench(
    s: State, work: float, force: Vector, torque: Vector, moved: Vector, turned: Vector
) -> None:
    """Keeps the wrench on the tool, the work of its newest evaluation and the tool's motion."""
    loop = s.loop
    loop.law_work = work
    store_vector(loop.motion[0:3], moved)
    store_vector(loop.motion[3:6], turned)
    store_vector(loop.wrench_on_tool[0:3], force)
    store_vector(loop.wrench_on_tool[3:6], torque)


@compiled
def send_wrench(s: State, row: State, contacts: int) -> int:
    """Computes the wrench on the device of that on the tool, and the tick's flags.

    Args:
        s: The bound state.
        row: The bound record.
        contacts: Count of contacts with a force in the scene.

    Returns:
        As ``answer_step`` for one hand; unless it is ``OK``, the tick must be refused.
    """
    loop = s.loop
    force, torque = vector_of(loop.wrench_on_tool), vector_of(loop.wrench_on_tool[3:6])
    square = dot(force, force) + dot(torque, torque)
    code = _failure(s, square)
    if code != OK:
        return code
    _render(s, force, torque)
    if foreseen_excess(s) > s.guard.max_energy:
        return GAVE_ENERGY
    loop.active_contacts = contacts
    loop.flags = lossless_flag(s.lossless) | s.guard.flags | s.observer.flags | s.level.flags
    loop.flags |= s.watch.flags
    if loop.active_contacts > 0:
        loop.flags |= CONTACT
    row.solver_iterations = _solver_iterations(s)
    return OK


@compiled
def _render(s: State, force: Vector, torque: Vector) -> None:
    """Turns the wrench on the tool into the wrench on the device, or takes what it reports.

    In this order: scale, axes with a motor, the lever, share of the passivity controller's
    damping what fits, the energy limit at full speed, and the pulse of a blow.
    """
    run = s.run
    if run.is_apart:
        for i in range(6):
            s.loop.wrench_on_device[i] = s.loop.reported[i]
        return
    if not run.has_law:  # nothing limits the wrench on the tool, so the device alone is spared
        force, torque = limited_wrench(s, force, torque)
    force = scaled(-run.force_scale, device_from_scene(run.axes, force))
    torque = scaled(-run.force_scale / run.scale, device_from_scene(run.axes, torque))
    lever = s.guard.lever
    if s.coupling.lacks_motors:
        whole, whole_torque = force, torque
        force, torque = felt(s, force, torque)
        store_vector(s.loop.unfelt[0:3], scaled(lever, subtract(whole, force)))
        store_vector(s.loop.unfelt[3:6], scaled(lever, subtract(whole_torque, torque)))
    if lever != 1.0:
        force, torque = scaled(lever, force), scaled(lever, torque)
    force, torque = send_within(s, (force, torque), control(s, force, torque))
    force, torque = within_energy_limit(s, force, torque)
    force = add_pulse(s, force, torque)
    store_vector(s.loop.wrench_on_device[0:3], force)
    store_vector(s.loop.wrench_on_device[3:6], torque)
    note_sent(s)


@compiled
def close_tick(state: NDArray[np.void], row: NDArray[np.void], has_positions: bool) -> int:
    """Closes the balance of all hands and completes their records, after the wrenches were sent.

    Args:
        state: The bound states after ``answer_step``.
        row: The bound records.
        has_positions: True if MuJoCo's position stage has run since the step.

    Returns:
        ``OK`` or ``BAD_RESULT``; with the latter zero force must be sent to every device.
    """
    s = state[0]
    loop = s.loop
    loop.has_positions = has_positions
    restore_springs(s)
    if s.run.scheme not in (Scheme.MASSLESS, Scheme.SHOWN) or s.shown.is_posted:
        refresh_energies(s)
    if s.run.scheme == Scheme.MIDPOINT and finish_lossless(s):
        loop.has_positions = 0  # it was computed with the springs of the other form
    for i in range(state.size):
        add_coupling_work(state[i].energy, state[i].loop.law_work)
        add_slack(state[i].energy, slack_of_step(state[i]))
    add_up_hands(state)
    if s.run.scheme == Scheme.IMPLICIT and take_back(s, s.mj.qvel, 0.0):
        add_up_hands(state)
    is_finite = True
    for i in range(state.size):
        is_finite = judge_balance(state[i]) and is_finite
    if not is_finite:
        return refuse_tick(state, BAD_RESULT)
    for i in range(state.size):
        observe_release(state[i])
    fill_tank(s, earn(s))
    if has_positions and not is_sound(s):
        loop.has_positions = 0
    for i in range(state.size):
        complete_record(state[i], row[i])
        row[i].contact_tank = row[0].contact_tank
    if loop.has_positions and turns_actuators_alone(s):
        take_velocities(s)
    return OK


@compiled
def complete_record(s: State, row: State) -> None:
    """Notes the peaks, completes the record, and counts the tick."""
    loop = s.loop
    loop.peak_force = max(loop.peak_force, norm(vector_of(loop.wrench_on_device)))
    loop.peak_torque = max(loop.peak_torque, norm(vector_of(loop.wrench_on_device[3:6])))
    loop.peak_tool_force = max(loop.peak_tool_force, norm(vector_of(loop.wrench_on_tool)))
    loop.peak_tool_torque = max(loop.peak_tool_torque, norm(vector_of(loop.wrench_on_tool[3:6])))
    _record(s, row)
    loop.tick += 1


@compiled
def set_external_flags(loop: Part, flags: int) -> None:
    """Sets ``STALE_SAMPLE`` of the next tick, as recorded."""
    loop.external_flags = flags


@compiled
def refuse_tick(states: NDArray[np.void], code: int) -> int:
    """Sets the wrench on every device to zero and flags a trip; returns the code."""
    for hand in range(states.size):
        loop = states[hand].loop
        loop.flags = TRIP
        for i in range(6):
            loop.wrench_on_device[i] = 0.0
    return code


@compiled
def _solver_iterations(s: State) -> int:
    if s.run.scheme == Scheme.SHOWN:
        return 0
    # without islands MuJoCo counts its iterations as those of island 0
    islands = max(ints(s.mj.nisland, 1)[0], 1)
    total = 0
    for iterations in ints(s.mj.solver_niter, min(islands, 20)):
        total += iterations
    return total


@compiled
def _record(s: State, r: State) -> None:
    """Copies the results of the tick into its record; see ``record.TICK_DTYPE``."""
    loop, energy = s.loop, s.energy
    r.flags = loop.flags
    r.contacts = loop.active_contacts
    store_vector(r.tool_position, vector_of(s.pose.tool_position))
    store_quaternion(r.tool_quaternion, quaternion_of(s.pose.tool_quaternion))
    for i in range(6):
        r.wrench_on_tool[i] = loop.wrench_on_tool[i]
        r.wrench_on_device[i] = loop.wrench_on_device[i]
    r.kinetic, r.potential = energy.kinetic, energy.potential
    r.coupling_work, r.actuator_work = energy.coupling_work, energy.actuator_work
    r.external_work = energy.external_work
    r.environment_energy, r.device_energy = energy.environment_energy, energy.device_energy
    r.injected_damping = s.observer.injected_damping
    r.injected_rotational_damping = s.observer.injected_rotational_damping
    r.lever = s.guard.lever
    r.contact_tank = s.contact.tank
    r.scene_step, r.scene_tank = s.shown.scene_step, s.shown.tank
    blow = s.impact
    store_vector(r.pulse, vector_of(blow.newest))
    r.pulse_account, r.blow_energy = blow.account, blow.blow_energy
    r.blow_speed, r.blow_rebound = blow.blow_speed, blow.blow_rebound
    r.blow_restitution = blow.blow_restitution


@compiled
def after_step(state: NDArray[np.void], row: NDArray[np.void], substep: int) -> int:
    """Runs ``answer_step``, and after the last substep ``close_tick``.

    Returns:
        The first result that is not ``OK``, and then the wrench on the device is zero; else ``OK``.
    """
    code = answer_step(state, row, substep)
    if code != OK or substep + 1 != state[0].run.substeps:
        return code
    return close_tick(state, row, False)


def pause(loop: Part) -> None:
    """Notes a pause, in which zero was commanded and the scene may have been changed."""
    loop["wrench_on_device"] = loop["unfelt"] = 0.0
    loop["has_positions"] = 0


def discard_wrench(loop: Part) -> None:
    """Notes that the scene was reset: a held wrench must not act on it."""
    loop["wrench_on_tool"] = 0.0
    loop["has_positions"] = 0


# The way of a record to the ring, and of a scene's positions to the view

HEAD, TAIL = 0, 1
"""Cursors of the ring: records written, records read."""

SEQUENCE, NUMBER, CONTACTS = 0, 1, 2
"""Head of a snapshot: sequence, odd during a write; number of the record; count of contacts."""


@compiled
def publish(
    rows: NDArray[np.void],
    ring: NDArray[np.void],
    cursors: NDArray[np.int64],
    deadline_ns: int,
    wake_ns: int,
    read_ns: int,
    write_ns: int,
    flags: int,
) -> bool:
    """Completes a tick's records, one per hand, and hands them to the ring (single producer).

    Returns:
        False if the ring is full; nothing was written then, and the call can be repeated.
    """
    head = cursors[HEAD]
    if head - cursors[TAIL] > ring.size - rows.size:
        return False
    for i in range(rows.size):
        r = rows[i]
        r.deadline_ns, r.wake_ns, r.read_ns, r.write_ns = deadline_ns, wake_ns, read_ns, write_ns
        r.flags |= flags
        ring[(head + i) % ring.size] = r
    release_fence()
    cursors[HEAD] = head + rows.size
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
    """Runs ``close_tick`` and ``publish`` in one call, because a second one would cost 0.2 µs.

    Returns:
        The result of ``close_tick``, or ``RING_FULL``; with the latter, repeat ``publish`` alone.
    """
    code = close_tick(state, row, has_positions)
    if code != OK:
        return code
    for i in range(state.size):
        keep_account(state[i], deadline_ns, read_ns, write_ns)
        row[i].flags |= state[i].loop.external_flags
    taken = publish(row, ring, cursors, deadline_ns, wake_ns, read_ns, write_ns, flags)
    return OK if taken else RING_FULL


@compiled
def publish_positions(
    state: NDArray[np.void],
    cursors: NDArray[np.int64],
    head: NDArray[np.int64],
    numbers: NDArray[np.float64],
) -> None:
    """Copies the scene's positions and contacts to a snapshot (``recording.ring``).

    Call it after MuJoCo's step and before the next one, while the step's contact forces exist. The
    tick reads nothing that it changes.

    Args:
        state: The bound state.
        cursors: Cursors of the ring; the record of this tick is the next one written there.
        head: Head of the snapshot.
        numbers: Slack in J, positions, mocap poses, then per contact with a force its point in m
            and its force in N.
    """
    s = state[0]
    mj = s.mj
    head[SEQUENCE] += 1
    release_fence()
    numbers[0], end = s.energy.slack, 1
    for source, count in (
        (mj.qpos, mj.nq),
        (mj.mocap_pos, 3 * mj.nmocap),
        (mj.mocap_quat, 4 * mj.nmocap),
    ):
        for value in floats(source, count):
            numbers[end] = value
            end += 1
    shown = 0
    # MuJoCo solves for no contact forces of a tool without mass
    count = 0 if s.run.scheme == Scheme.MASSLESS else ints(mj.ncon, 1)[0]
    for c in range(count):
        if end + 6 > numbers.size:
            break
        contact = pointer_at(mj.contact) + c * mj.contact_size
        slot, frame = numbers[end : end + 6], floats(contact + mj.contact_frame, 9)
        mj_contact_force(mj.model, mj.data, c, slot.ctypes.data)  # along the axes of its frame
        normal, first, second = slot[0], slot[1], slot[2]
        if normal == 0.0 and first == 0.0 and second == 0.0:
            continue  # a near contact may exist without a force
        shown += 1
        point = floats(contact + mj.contact_point, 3)
        for axis in range(3):
            slot[axis] = point[axis]
            slot[3 + axis] = (
                normal * frame[axis] + first * frame[3 + axis] + second * frame[6 + axis]
            )
        end += 6
    head[NUMBER], head[CONTACTS] = cursors[HEAD], shown
    release_fence()
    head[SEQUENCE] += 1


# Whole ticks in compiled code, for re-simulation and sweeps
#
# An error inside MuJoCo ends the process here. One step must have succeeded through Python before,
# and no device may be attached.


@compiled
def whole_tick(
    state: NDArray[np.void], sample: NDArray[np.void], row: NDArray[np.void], elapsed: float
) -> bool:
    """Runs one tick; returns False if the sample was refused or the result is not usable."""
    for substep in range(state[0].run.substeps):
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
        Count of completed ticks; less than ``samples.size`` if ``whole_tick`` refused one.
    """
    for k in range(samples.size):
        if not whole_tick(state, samples[k : k + 1], row, state[0].run.period):
            return k
        rows[k] = row[0]
    return int(samples.size)


@compiled_for_threads
def simulate_recorded(
    state: NDArray[np.void],
    samples: NDArray[np.void],
    recorded: tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]],
    row: NDArray[np.void],
    rows: NDArray[np.void],
) -> int:
    """Runs the ticks of a recorded run, with the influences from outside the scene.

    Args:
        state: The bound states.
        samples: Device samples by tick and hand, (n, m).
        recorded: ``STALE_SAMPLE`` as recorded, (n, m); the time between two samples in s, one per
            tick; and the wrench that a device with a loop of its own reported, (n, m, 6).
        row: The bound records.
        rows: Receives the records, (n, m).

    Returns:
        Count of completed ticks, as for ``simulate``.
    """
    external_flags, elapsed, reported = recorded
    for k in range(samples.shape[0]):
        for i in range(state.size):
            set_external_flags(state[i].loop, external_flags[k, i])
            for axis in range(6):
                state[i].loop.reported[axis] = reported[k, i, axis]
        if not whole_tick(state, samples[k], row, elapsed[k]):
            return k
        for i in range(state.size):
            rows[k, i] = row[i]
    return int(samples.shape[0])


@compiled_for_threads
def end_scene_step(state: NDArray[np.void], row: NDArray[np.void], substep: int) -> int:
    """Runs ``after_step`` for a scene in a thread of its own, which may take milliseconds."""
    return after_step(state, row, substep)


@compiled
def take_result(
    state: NDArray[np.void], scene: NDArray[np.void], scene_sample: NDArray[np.void]
) -> None:
    """Takes over the step that a slower scene has done, and gives it the present handle pose."""
    if state[0].shown.waits:
        take_over(state, scene)
    hand_over(state, scene_sample)


@compiled
def shown_tick(
    states: tuple[NDArray[np.void], NDArray[np.void]],
    own: tuple[NDArray[np.void], NDArray[np.void], NDArray[np.void]],
    sample: NDArray[np.void],
    elapsed: float,
    is_due: bool,
) -> bool:
    """Runs one tick in front of a slower scene; arguments as for ``simulate_shown``.

    If the result of the scene is due, its step is done first.

    Returns:
        As ``whole_tick``.
    """
    state, scene = states
    row, scene_row, scene_sample = own
    if before_step(state, sample, row, 0, elapsed) != OK:
        return False
    waits = state[0].shown.waits
    if is_due or not waits:
        if waits and not whole_tick(scene, scene_sample, scene_row, scene[0].run.period):
            return False
        take_result(state, scene, scene_sample)
    return after_step(state, row, 0) == OK


@compiled_for_threads
def simulate_shown(
    states: tuple[NDArray[np.void], NDArray[np.void]],
    samples: NDArray[np.void],
    recorded: tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]],
    own: tuple[NDArray[np.void], NDArray[np.void], NDArray[np.void]],
    rows: NDArray[np.void],
) -> int:
    """Runs the ticks of a recorded run in front of a slower scene.

    Args:
        states: The bound states of the loop and of the scene.
        samples: Device samples, one per tick.
        recorded: One each per tick: ``STALE_SAMPLE`` as recorded, the time between two samples in
            s, and ``scene_step`` as recorded. A step is taken over where it rises.
        own: The bound records of loop and scene, and the scene's sample.
        rows: Receives the records; as long as ``samples``.

    Returns:
        Count of completed ticks, as for ``simulate``.
    """
    s, row = states[0][0], own[0]
    external_flags, elapsed, scene_steps = recorded
    for k in range(samples.size):
        s.loop.external_flags = external_flags[k]
        is_due = scene_steps[k] > s.shown.scene_step
        if not shown_tick(states, own, samples[k : k + 1], elapsed[k], is_due):
            return k
        rows[k] = row[0]
    return int(samples.size)


@compiled
def posted_tick(
    state: NDArray[np.void],
    sample: NDArray[np.void],
    post: NDArray[np.void],
    row: NDArray[np.void],
    elapsed: float,
) -> bool:
    """Runs one tick in front of another program's scene.

    ``post`` is taken over in it, if it has an element. Returns as ``whole_tick``.
    """
    if before_step(state, sample, row, 0, elapsed) != OK:
        return False
    if post.size > 0:
        take_posted(state, post)
    return after_step(state, row, 0) == OK


@compiled_for_threads
def simulate_posted(
    state: NDArray[np.void],
    samples: NDArray[np.void],
    recorded: tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]],
    posts: NDArray[np.void],
    row: NDArray[np.void],
    rows: NDArray[np.void],
) -> int:
    """Runs the ticks of a recorded run in front of another program's scene.

    Args:
        state: The bound state.
        samples: Device samples, one per tick.
        recorded: As for ``simulate_shown``.
        posts: All that the program posted, in order; the n-th is taken over where ``scene_step``
            rises to n.
        row: The bound record.
        rows: Receives the records; as long as ``samples``.

    Returns:
        Count of completed ticks, as for ``simulate``.
    """
    s = state[0]
    external_flags, elapsed, scene_steps = recorded
    for k in range(samples.size):
        s.loop.external_flags = external_flags[k]
        place, is_due = s.shown.scene_step, scene_steps[k] > s.shown.scene_step
        post = posts[place : place + is_due]
        if post.size < is_due:
            return k
        if not posted_tick(state, samples[k : k + 1], post, row, elapsed[k]):
            return k
        rows[k] = row[0]
    return int(samples.size)
