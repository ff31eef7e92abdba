"""The guard inside a tick: refusal of a sample, the lever between device and handle, added damping.

A start, a fade, a clutch, a dead-man button, a force switched off and lost samples are one number,
the ratio r of a lever from 0 to 1. The device gets r times the force, and the handle moves by r
times the device's motion:

    w_k = −r_k s Aᵀ f_k,    h_{k+1} = h_k + r_k scale A (p_{k+1} − p_k)

Work at the device and work at the handle are then equal for every course of r, and the tool keeps
what carries it while r is 0.
"""

from __future__ import annotations

import math

import numpy as np

from hapticbridge.kernel.codes import (
    BACKWARDS,
    CLUTCH,
    CLUTCHED,
    FORCE_OFF,
    GAVE_ENERGY,
    JUMPED,
    PROBED,
    RAMPING,
    REANCHORED,
    RUNS_AWAY,
    STALE_SAMPLE,
    STRETCHED,
    TWISTED,
    Part,
    State,
)
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.law import unwound
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.pose import (
    Vector,
    add,
    dot,
    norm,
    quaternion_of,
    rotation_between,
    scaled,
    subtract,
    vector_of,
)

_WHOLE = ("stale_ticks", "fade_ticks", "clutch", "dead_man", "has_hand")
_REAL = ("reach", "full_speed")
_THRESHOLDS = ("speed", "turn_speed", "stretch", "angle", "energy")

GUARD_DTYPE = np.dtype(
    [
        *((name, "<i8") for name in _WHOLE),
        *((name, "<f8") for name in _REAL),
        *((f"max_{name}", "<f8") for name in _THRESHOLDS),
        ("commanded", "<i8"),
        ("flags", "<i8"),
        ("consecutive_stale", "<i8"),
        ("fresh", "<i8"),
        ("time_since_sample", "<f8"),
        ("silence", "<f8"),
        ("longest_silence", "<f8"),
        ("silent_tick", "<i8"),
        ("start_tick", "<i8"),
        ("rise_ticks", "<i8"),
        ("lever", "<f8"),
    ]
)
"""Sub-record ``guard``, written by this module alone.

The first fields are those of ``GuardParameters``, the trips as ``max_*``. ``commanded`` holds
``FORCE_OFF`` and ``CLUTCHED``; ``flags`` are the guard's flags of the present tick;
``time_since_sample`` is the time in s since the last new sample, 0 in a tick with one;
``silence`` the length in s of the last interval without one, 0 once the force has come back;
``longest_silence`` the longest in s of the whole run, and ``silent_tick`` its last tick;
``fresh`` counts the ticks with a new sample; ``lever`` is r, the ratio of the lever between
device and handle; ``rise_ticks`` its time from 0 to 1."""

FARTHEST = 2.0
"""Largest plausible distance in m of a device from the origin of its frame, where its data sheet
names no reach. No desk is larger."""

CATCH_UP = 0.1
"""Greatest ratio r at which a new sample may still belong to the silence before it; no unit. After
a silence a link first delivers what had waited in it, and the newest sample follows within a tick
or two. At a larger r such a jump would move the tool."""

DEVICE_BUTTONS = 2**32 - 1
"""Bits of a record's ``buttons`` that belong to the device; bits above them are commands."""


def bind_guard(guard: Part, parameters: RunParameters) -> None:
    """Fills in the guard's thresholds and its state before the first tick."""
    limits = parameters.guarding
    for name in (*_WHOLE, *_REAL):
        guard[name] = getattr(limits, name)
    for name in _THRESHOLDS:
        guard[f"max_{name}"] = getattr(limits, name)
    restart_ramp(guard, 0, parameters.ramp_ticks)


def restart_ramp(guard: Part, tick: int, length: int) -> None:
    """Lets the lever rise from zero within so many ticks; without a hand it may be 1 at once."""
    guard["start_tick"], guard["rise_ticks"] = tick, length
    guard["lever"] = 0.0 if guard["has_hand"] or length > 0 else 1.0


def let_go(guard: Part) -> None:
    """Lets the handle go: it does not follow the device's next motion."""
    guard["lever"], guard["rise_ticks"] = 0.0, guard["fade_ticks"]


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
    is_first = s.loop.tick == guard.start_tick
    if elapsed < 0.0 and not is_first:
        return BACKWARDS
    # the device moves on while its samples are old, and catches up after a silence
    time = max(elapsed, s.run.period) + guard.time_since_sample
    if guard.lever <= CATCH_UP:
        time += guard.silence
    is_fast = norm(moved) > guard.max_speed * time or norm(turned) > guard.max_turn_speed * time
    # between a start and the first tick the device moves for an unknown time
    is_astray = bool(guard.has_hand) and norm(moved) > FARTHEST
    if is_astray if is_first else is_fast:
        return JUMPED
    stretch = subtract(vector_of(pose.handle_position), vector_of(pose.tool_position))
    if norm(stretch) > guard.max_stretch:
        return STRETCHED
    tool, handle = quaternion_of(pose.tool_quaternion), quaternion_of(pose.handle_quaternion)
    if norm(unwound(s, rotation_between(tool, handle))) > guard.max_angle:
        return TWISTED
    return GAVE_ENERGY if s.observer.guarded_energy > guard.max_energy else 0


@compiled
def advance_lever(s: State, position: Vector, buttons: int, elapsed: float) -> None:
    """Advances r by one tick: to 0 while the hand is let go, else to 1 or the watch's cap.

    The hand is let go while a clutch is held (by a button or by command), while a dead-man button
    is not held, while the device is beyond ``reach``, at the edge of its workspace, after
    ``stale_ticks`` ticks without a new sample, and while the force is off by command.

    Args:
        s: The bound state.
        position: New position of the device in m.
        buttons: Bits of buttons and commands.
        elapsed: Time since the last sample in s.
    """
    guard, flags = s.guard, s.loop.external_flags
    guard.flags = 0
    is_stale = (flags & STALE_SAMPLE) != 0
    guard.fresh += 0 if is_stale else 1
    guard.consecutive_stale = guard.consecutive_stale + 1 if is_stale else 0
    waited = guard.time_since_sample + max(elapsed, s.run.period)
    if not is_stale and guard.time_since_sample > 0.0:
        guard.silence = guard.time_since_sample
    guard.time_since_sample = waited if is_stale else 0.0
    if is_stale and waited > guard.longest_silence:
        guard.longest_silence, guard.silent_tick = waited, s.loop.tick
    is_clutched = (buttons & (guard.clutch | CLUTCHED)) != 0
    is_clutched = is_clutched or (guard.dead_man != 0 and (buttons & guard.dead_man) == 0)
    is_clutched = is_clutched or norm(position) > guard.reach
    if is_clutched:
        guard.flags |= CLUTCH
    is_off = is_clutched or (buttons & FORCE_OFF) != 0
    is_off = is_off or (guard.stale_ticks > 0 and guard.consecutive_stale > guard.stale_ticks)
    if is_off:
        guard.lever = max(guard.lever - 1.0 / guard.fade_ticks, 0.0)
        if guard.lever == 0.0:
            guard.rise_ticks = guard.fade_ticks
    elif guard.lever > s.watch.max_lever:
        guard.lever = max(guard.lever - 1.0 / guard.fade_ticks, s.watch.max_lever)
        if s.watch.flags & RUNS_AWAY:  # a reversed force must not last for a fade
            guard.lever = s.watch.max_lever
    elif guard.lever < s.watch.max_lever:
        rise = guard.fade_ticks if s.watch.flags & PROBED else guard.rise_ticks + 1.0
        guard.lever = min(guard.lever + 1.0 / rise, s.watch.max_lever)
    if guard.lever > CATCH_UP:
        guard.silence = 0.0
    if guard.lever < 1.0:
        guard.flags |= RAMPING


@compiled
def note_anchored(guard: Part) -> None:
    """Notes that the handle was anchored anew in this tick."""
    guard.flags |= REANCHORED


@compiled
def send_within(
    s: State, wrench: tuple[Vector, Vector], damped: tuple[Vector, Vector]
) -> tuple[Vector, Vector]:
    """Returns the wrench on the device: the coupling's, and of the added damping what fits.

    The coupling's wrench is at the force level already and passes whole.
    """
    run = s.run
    return (
        within_limit(wrench[0], damped[0], run.force_limit),
        within_limit(wrench[1], damped[1], run.torque_limit),
    )


@compiled
def within_limit(base: Vector, whole: Vector, limit: float) -> Vector:
    """Returns base + β (whole − base) with the largest β <= 1 that keeps the norm."""
    if dot(whole, whole) <= limit * limit:
        return whole
    more = subtract(whole, base)
    a, b, c = dot(more, more), dot(base, more), dot(base, base) - limit * limit
    if a == 0.0:
        return base
    root = max(b * b - a * min(c, 0.0), 0.0)
    share = max((math.sqrt(root) - b) / a, 0.0)
    return add(base, scaled(min(share, 1.0), more))
