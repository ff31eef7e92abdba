"""The guard inside a tick: refusal of a sample, re-anchoring of the handle, limits of the wrench.

After a start or a re-anchoring, the guard lets only a share r of the wrench through, and r grows
from tick to tick. A coupling that is stretched meanwhile grows with r. From the identity behind
eq. (6) of Brown & Colgate (1997), with the wrench r_k f_k in the place of f_k, the device receives

    W = Σ (r_k − r_{k−1}) V(e_k),    V(e) = ∫ min(K e, F) de

that no port has supplied: the spring is compressed while r is small and released when r is 1. F is
the force limit in N, V an energy in J. A hand that moves 40 mm into a wall with F = 10 N during the
ramp thus receives 0.2 J, and the guard's energy limit rightly ends the run. Therefore r rises in
equal steps only while V is below V_0 (``ramp_energy``), and more slowly above:

    r_k − r_{k−1} = min(1, V_0/V(e_k)) / (n + 1)

with n the length of the ramp in ticks. This bounds W by V_0 in every n + 1 ticks, for any motion of
the hand. Energy that the scene stored while r was small and releases later is not in V; there the
energy limit alone protects.
"""

from __future__ import annotations

import numpy as np

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import (
    BACKWARDS,
    CLUTCH,
    CLUTCHED,
    FORCE_LIMITED,
    FORCE_OFF,
    GAVE_ENERGY,
    JUMPED,
    RAMPING,
    REANCHORED,
    SLEW_LIMITED,
    STALE_SAMPLE,
    STRETCHED,
    TWISTED,
    Part,
    State,
)
from hapticbridge.kernel.law import releasable_energy
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.pose import (
    Vector,
    add,
    norm,
    quaternion_of,
    rotation_between,
    scaled,
    store_vector,
    subtract,
    vector_of,
)

_FROM_PARAMETERS = (
    "stale_ticks",
    "fade_ticks",
    "clutch",
    "dead_man",
    "reanchors_at_start",
    "force_slew",
    "torque_slew",
    "longest_stall",
    "reach",
    "ramp_energy",
)
_THRESHOLDS = ("speed", "turn_speed", "stretch", "angle", "energy")

GUARD_DTYPE = np.dtype(
    [
        *((name, "<i8") for name in _FROM_PARAMETERS[:5]),
        *((name, "<f8") for name in _FROM_PARAMETERS[5:]),
        *((f"max_{name}", "<f8") for name in _THRESHOLDS),
        ("commanded", "<i8"),
        ("flags", "<i8"),
        ("is_clutched", "<i8"),
        ("is_reanchoring_requested", "<i8"),
        ("consecutive_stale", "<i8"),
        ("fade_ticks_elapsed", "<i8"),
        ("time_since_sample", "<f8"),
        ("ramp_start", "<i8"),
        ("ramp_length", "<i8"),
        ("ramp_progress", "<f8"),
        ("transmitted_share", "<f8"),
        ("ramp_share", "<f8"),
        ("limited_wrench", "<f8", 6),
    ]
)
"""Sub-record ``guard``, written by this module alone.

The first fields are those of ``GuardParameters``, the trips as ``max_*``. ``commanded`` holds
``FORCE_OFF`` and ``CLUTCHED``; ``flags`` are the guard's flags of the present tick;
``time_since_sample`` in s; the ramp's start, length and progress in ticks;
``transmitted_share`` of the requested force, ``ramp_share`` of ramp and fade alone;
``limited_wrench`` in N and N m, before ramp and fade."""

DEVICE_BUTTONS = 2**32 - 1
"""Bits of a record's ``buttons`` that belong to the device; bits above them are commands."""

STILL = 1e-4
"""Largest motion in m of a device between its start and the first tick without a re-anchoring. A
hand at rest moves less. At 2400 N/m it leaves a force of 0.24 N."""

STILL_TURN = 0.02
"""Largest rotation in rad of a device between its start and the first tick without a re-anchoring.
At 2.4 N m/rad it leaves a torque of 0.05 N m."""


def bind_guard(guard: Part, parameters: RunParameters) -> None:
    """Fills in the guard's thresholds and its state before the first tick."""
    limits = parameters.guarding
    for name in _FROM_PARAMETERS:
        guard[name] = getattr(limits, name)
    for name in _THRESHOLDS:
        guard[f"max_{name}"] = getattr(limits, name)
    guard["ramp_length"] = parameters.ramp_ticks
    # before the first tick, a device with a dead-man button counts as released
    guard["is_clutched"] = limits.dead_man != 0


def restart_ramp(guard: Part, tick: int, length: int) -> None:
    """Lets the wrench rise from zero again, from a tick on and within so many ticks."""
    guard["ramp_start"], guard["ramp_length"], guard["ramp_progress"] = tick, length, 0.0
    guard["limited_wrench"] = 0.0


def request_reanchoring(guard: Part) -> None:
    """Re-anchors the handle at the next tick in which it follows the device."""
    guard["is_reanchoring_requested"] = 1


def set_commanded(guard: Part, bits: int) -> None:
    """Sets the commands in force, of ``FORCE_OFF`` and ``CLUTCHED``."""
    guard["commanded"] = bits


@compiled
def refusal(s: State, moved: Vector, turned: Vector, elapsed: float) -> int:
    """Returns the reason to refuse a tick, or 0; the state is unchanged.

    Args:
        s: The bound state, as the previous tick left it.
        moved: Motion of the device since the last sample in m.
        turned: Its rotation vector in rad.
        elapsed: Time between the two readings in s.
    """
    guard, pose = s.guard, s.pose
    is_first = s.loop.tick == guard.ramp_start
    if elapsed < 0.0 and not is_first:
        return BACKWARDS
    # the device moves on while its samples are old, and between a start and the first tick
    time = max(elapsed, s.run.period) + guard.time_since_sample
    is_fast = norm(moved) > guard.max_speed * time or norm(turned) > guard.max_turn_speed * time
    if is_fast and not is_first:
        return JUMPED
    stretch = subtract(vector_of(pose.handle_position), vector_of(pose.tool_position))
    if norm(stretch) > guard.max_stretch:
        return STRETCHED
    tool, handle = quaternion_of(pose.tool_quaternion), quaternion_of(pose.handle_quaternion)
    if norm(rotation_between(tool, handle)) > guard.max_angle:
        return TWISTED
    return GAVE_ENERGY if s.observer.excess_device_energy > guard.max_energy else 0


@compiled
def follow(
    s: State, position: Vector, moved: Vector, turned: Vector, buttons: int, elapsed: float
) -> bool:
    """Decides if the handle follows the device, is re-anchored, and if the wrench fades.

    The handle stays while a clutch is held (by a button or by command), while a dead-man button is
    not held, and while the device is beyond ``reach``, at the edge of its workspace. The wrench
    then fades. It also fades after ``stale_ticks`` ticks without a new sample, and while the force
    is off by command. Afterwards, and after a stall, the handle is re-anchored (flag
    ``REANCHORED``): it is placed at the tool, the device's pose belongs to it from then on, and the
    wrench rises within ``fade_ticks``. A coupling that stayed stretched would release energy that
    no hand supplied.

    Args:
        s: The bound state.
        position: New position of the device in m.
        moved: Its motion since the last sample in m.
        turned: Its rotation vector since the last sample in rad.
        buttons: Bits of buttons and commands.
        elapsed: Time since the last sample in s.

    Returns:
        True if the handle follows the device.
    """
    guard, flags = s.guard, s.loop.external_flags
    guard.flags = 0
    is_stale = (flags & STALE_SAMPLE) != 0
    was_force_off = guard.fade_ticks_elapsed > 0
    guard.consecutive_stale = guard.consecutive_stale + 1 if is_stale else 0
    waited = guard.time_since_sample + max(elapsed, s.run.period)
    guard.time_since_sample = waited if is_stale else 0.0
    was_clutched = guard.is_clutched != 0
    is_clutched = (buttons & (guard.clutch | CLUTCHED)) != 0
    is_clutched = is_clutched or (guard.dead_man != 0 and (buttons & guard.dead_man) == 0)
    is_clutched = is_clutched or norm(position) > guard.reach
    guard.is_clutched = is_clutched
    is_force_off = is_clutched or (buttons & FORCE_OFF) != 0
    is_force_off = is_force_off or (
        guard.stale_ticks > 0 and guard.consecutive_stale > guard.stale_ticks
    )
    guard.fade_ticks_elapsed = guard.fade_ticks_elapsed + 1 if is_force_off else 0
    if is_clutched:
        guard.flags = CLUTCH
        return False
    is_first = s.loop.tick == guard.ramp_start
    has_stalled = elapsed > guard.longest_stall and not is_first
    has_moved = norm(moved) > STILL or norm(turned) > STILL_TURN
    has_strayed = is_first and guard.reanchors_at_start and has_moved
    # after a reset, or in the re-simulation of a recorded run
    is_requested = guard.is_reanchoring_requested != 0 or (flags & REANCHORED) != 0
    guard.is_reanchoring_requested = 0
    is_force_on_again = was_force_off and not is_force_off
    if was_clutched or is_force_on_again or has_stalled or has_strayed or is_requested:
        guard.flags |= REANCHORED
        if not is_first:
            guard.ramp_length = guard.fade_ticks
        guard.ramp_start, guard.ramp_progress = s.loop.tick, 0.0
        for i in range(6):
            guard.limited_wrench[i] = 0.0
    return True


@compiled
def advance_ramp(s: State) -> float:
    """Advances the ramp by one tick, and returns the share of the wrench that is let through.

    ``ramp_progress`` counts ticks; a tick counts in part if the coupling holds more than
    ``ramp_energy``.
    """
    guard = s.guard
    full = guard.ramp_length + 1.0
    if guard.ramp_progress >= full:
        return 1.0
    pace = 1.0
    if s.run.has_law and guard.ramp_energy < np.inf:
        stored = releasable_energy(s)
        if stored > guard.ramp_energy:
            pace = guard.ramp_energy / stored
    guard.ramp_progress += pace
    if guard.ramp_progress >= full:
        return 1.0
    guard.flags |= RAMPING
    return float(guard.ramp_progress / full)


@compiled
def _limited(v: Vector, limit: float) -> tuple[Vector, bool]:
    length = norm(v)
    if length > limit:
        return scaled(limit / length, v), True
    return v, False


@compiled
def _slew_limited(v: Vector, before: Vector, rise: float) -> tuple[Vector, bool]:
    change = subtract(v, before)
    length = norm(change)
    if length > rise:
        return add(before, scaled(rise / length, change)), True
    return v, False


@compiled
def limit_wrench(
    s: State, force: Vector, torque: Vector, requested: float
) -> tuple[Vector, Vector]:
    """Limits a wrench on the device by norm and by change, then applies ramp and fade.

    Args:
        s: The bound state.
        force: In N, in the device's frame.
        torque: In N m, in the device's frame.
        requested: Norm in N of the force before the passivity controller.

    Returns:
        The wrench to send.
    """
    guard, run = s.guard, s.run
    force, is_limited = _limited(force, run.force_limit)
    torque, is_torque_limited = _limited(torque, run.torque_limit)
    if is_limited or is_torque_limited:
        guard.flags |= FORCE_LIMITED
    last, last_torque = vector_of(guard.limited_wrench), vector_of(guard.limited_wrench[3:6])
    force, is_slewed = _slew_limited(force, last, guard.force_slew)
    torque, is_torque_slewed = _slew_limited(torque, last_torque, guard.torque_slew)
    if is_slewed or is_torque_slewed:
        guard.flags |= SLEW_LIMITED
    store_vector(guard.limited_wrench[0:3], force)
    store_vector(guard.limited_wrench[3:6], torque)
    share = advance_ramp(s)
    if guard.fade_ticks_elapsed > 0:
        share *= max(0.0, 1.0 - guard.fade_ticks_elapsed / guard.fade_ticks)
    guard.ramp_share = share
    if share != 1.0:
        force, torque = scaled(share, force), scaled(share, torque)
    guard.transmitted_share = min(norm(force) / requested, 1.0) if requested > 0.0 else share
    return force, torque
