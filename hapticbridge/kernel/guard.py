"""Before a sample is used: is it possible, is it new, and does the handle follow the device."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import (
    BACKWARDS,
    CLUTCH,
    CLUTCHED,
    FORCE_OFF,
    GAVE_ENERGY,
    JUMPED,
    RAMPING,
    RESEATED,
    STALE_SAMPLE,
    STRETCHED,
    TWISTED,
)
from hapticbridge.pose import (
    Quaternion,
    Vector,
    norm,
    quaternion_of,
    rotation_between,
    store_quaternion,
    store_vector,
    subtract,
    vector_of,
)

# How the wrench rises after a start or a re-seating, and what that may cost.
#
# A share r of the wrench is let through, and r grows from tick to tick. The coupling that it
# finds stretched grows with it: from the identity behind BC97 (6), with the wrench r_k f_k in
# the place of f_k, the device is given
#
# W = Σ (r_k − r_{k−1}) V(e_k), V(e) = ∫ min(K e, F) de, F the force limit,
#
# that nobody put in: pressed in while r is small, let out when it is one. A hand that goes 40 mm
# into a wall with F = 10 N within the ramp is so given 0.2 J, and the guard's energy limit
# rightly ends the run. So r rises in equal steps only while V is below V_0, and slower where it
# is above,
#
# r_k − r_{k−1} = min(1, V_0/V(e_k)) / (n + 1),
#
# which bounds W by V_0 in every n + 1 ticks, whatever the hand does. What the scene itself took
# up in the meantime at a small r, and gives back later, is not in V; there the energy limit
# stands alone.


@compiled
def _spring(stiffness: float, length: float, limit: float) -> float:
    elastic = min(length, limit / stiffness) if stiffness > 0.0 else 0.0
    return 0.5 * stiffness * elastic * elastic + min(stiffness * length, limit) * (length - elastic)


@compiled
def held_energy(state: NDArray[np.void]) -> float:
    """Returns what the coupling's springs can give to the device, r V(e) + r V(φ) in J.

    r = force_scale/scale; the force of each spring stops growing where its limit is reached.
    """
    s = state[0]
    ratio = s.force_scale / s.scale
    stretch = norm(subtract(vector_of(s.handle_position), vector_of(s.tool_position)))
    tool, handle = quaternion_of(s.tool_quaternion), quaternion_of(s.handle_quaternion)
    twist = norm(rotation_between(tool, handle))
    held = _spring(s.stiffness, stretch, s.force_limit / s.force_scale)
    return float(ratio * (held + _spring(s.rotational_stiffness, twist, s.torque_limit / ratio)))


@compiled
def transmitted_share(state: NDArray[np.void], row: NDArray[np.void]) -> float:
    """Advances ramp and fade by one tick; returns and records the transmitted wrench share."""
    s = state[0]
    share = _rise(state)
    if s.silent_ticks > 0:
        share *= max(0.0, 1.0 - s.silent_ticks / s.fade_ticks)
    row[0].share = share
    return share


@compiled
def _rise(state: NDArray[np.void]) -> float:
    """Advances the ramp by one tick; returns its share of the wrench.

    ``risen`` counts ticks; a tick in which the coupling stores more than ``ramp_energy`` counts in
    part.
    """
    s = state[0]
    full = s.rise_ticks + 1.0
    if s.risen >= full:
        return 1.0
    pace = 1.0
    if s.has_law and s.ramp_energy < np.inf:
        held = held_energy(state)
        if held > s.ramp_energy:
            pace = s.ramp_energy / held
    s.risen += pace
    if s.risen >= full:
        return 1.0
    s.flags |= RAMPING
    return float(s.risen / full)


DEVICE_BUTTONS = 2**32 - 1
"""Bits of a record's ``buttons`` that the device's own buttons have; those above are commands."""

STILL = 1e-4
"""In m. A device that moved by more between its start and the first tick is re-seated; less is what
a hand that holds still does, and leaves a coupling of 2400 N/m with 0.24 N."""

STILL_TURN = 0.02
"""In rad, likewise: 0.05 N m behind 2.4 N m/rad."""


@compiled
def refused(state: NDArray[np.void], moved: Vector, turned: Vector, elapsed: float) -> int:
    """Says why a tick must not be, or 0. Nothing is changed.

    Args:
        state: The bound state, as the tick before left it.
        moved: By how much the new sample is from the last one, in m.
        turned: Likewise as a rotation vector.
        elapsed: Time between the two readings in s.
    """
    s = state[0]
    is_first = s.tick == s.ramp_start
    if elapsed < 0.0 and not is_first:
        return BACKWARDS
    # the device moves on while its samples are old, and between a start and the first tick
    time = max(elapsed, s.period) + s.since_news
    is_fast = norm(moved) > s.most_speed * time or norm(turned) > s.most_turn_speed * time
    if is_fast and not is_first:
        return JUMPED
    stretch = subtract(vector_of(s.handle_position), vector_of(s.tool_position))
    if norm(stretch) > s.most_stretch:
        return STRETCHED
    twist = rotation_between(quaternion_of(s.tool_quaternion), quaternion_of(s.handle_quaternion))
    if norm(twist) > s.most_angle:
        return TWISTED
    return GAVE_ENERGY if s.kicked > s.most_energy else 0


@compiled
def follow(
    state: NDArray[np.void],
    position: Vector,
    quaternion: Quaternion,
    moved: Vector,
    turned: Vector,
    buttons: int,
    elapsed: float,
) -> bool:
    """Decides whether the handle goes where the device went, and how much of the wrench is sent.

    The handle stays where it is while a clutch is held (by a button or by command), a dead-man
    button is not, or the device is beyond its reach (at the edge of its workspace, into whose stops
    it must not be driven), and the wrench fades; it also fades without news for ``stale_ticks``,
    and while the force is off by command. When that is over, and after a stall, the coupling is
    re-seated: the handle is put to the tool, so that nothing is stretched, the device's pose now
    belongs to it, and the wrench rises within ``fade_ticks``. A coupling that was stretched while
    no force was felt would give back what nobody had put in.

    Args:
        state: The bound state.
        position: Of the device, new, in m.
        quaternion: Likewise.
        moved: Since the last sample, in m.
        turned: Likewise as a rotation vector.
        buttons: Bits.
        elapsed: Time since the last sample in s.

    Returns:
        Whether the handle follows the device.
    """
    s = state[0]
    s.watch_flags = 0
    is_stale = (s.outside & STALE_SAMPLE) != 0
    was_silent = s.silent_ticks > 0
    s.stale_run = s.stale_run + 1 if is_stale else 0
    s.since_news = s.since_news + max(elapsed, s.period) if is_stale else 0.0
    was_released = s.is_released != 0
    is_released = (buttons & (s.clutch | CLUTCHED)) != 0
    is_released = is_released or (s.dead_man != 0 and (buttons & s.dead_man) == 0)
    is_released = is_released or norm(position) > s.reach
    s.is_released = is_released
    is_silent = is_released or (buttons & FORCE_OFF) != 0
    is_silent = is_silent or (s.stale_ticks > 0 and s.stale_run > s.stale_ticks)
    s.silent_ticks = s.silent_ticks + 1 if is_silent else 0
    if is_released:
        s.watch_flags = CLUTCH
        return False
    is_first = s.tick == s.ramp_start
    has_stalled = elapsed > s.longest_stall and not is_first
    has_strayed = is_first and s.reseats and (norm(moved) > STILL or norm(turned) > STILL_TURN)
    # after a reset, or in a recorded run that is simulated again
    is_asked = s.is_seated_anew != 0 or (s.outside & RESEATED) != 0
    s.is_seated_anew = 0
    has_news = was_silent and not is_silent
    if was_released or has_news or has_stalled or has_strayed or is_asked:
        s.watch_flags |= RESEATED
        store_vector(s.device_origin[0:3], position)
        store_quaternion(s.device_origin[3:7], quaternion)
        store_vector(s.handle_origin[0:3], vector_of(s.tool_position))
        store_quaternion(s.handle_origin[3:7], quaternion_of(s.tool_quaternion))
        if not is_first:
            s.rise_ticks = s.fade_ticks
        s.ramp_start, s.risen = s.tick, 0.0
        for i in range(6):
            s.slewed[i] = 0.0
    return True
