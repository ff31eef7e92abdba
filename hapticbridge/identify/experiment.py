"""A short, safe run that moves one axis of a device by itself, and what was recorded of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.clock import Clock
from hapticbridge.device import AXES, Device
from hapticbridge.errors import DeviceError, IdentificationError
from hapticbridge.identify.excitation import (
    FAR,
    FAST,
    OK,
    SPAN,
    START_SHARE,
    STATE_DTYPE,
    TURNED_FAR,
    TURNED_FAST,
    next_wrench,
    signal,
)
from hapticbridge.jit import direct
from hapticbridge.tick import SAMPLE_DTYPE, TickFlag

Array = NDArray[np.float64]

RUNAWAY = 3.0
"""Multiple of the allowed travel at which a run is given up: the device is not doing what the force
says, so no force is better than more of it."""

SPEED_MARGIN = 1.5
"""Multiple of the device's own top speed that counts as a fault."""

_TOLD_PER_SECOND = 10
"""How often progress is told."""


@dataclass(frozen=True, slots=True, eq=False)
class AxisRun:
    """What was commanded and seen of one axis.

    Attributes:
        axis: One of ``AXES``.
        period: T in s.
        position: In m or rad from the start, NaN where no new sample came, shape (n,).
        force: In N or N m, held from each sample to the next, shape (n,).
        intervals: Time between wakings in s, shape (n − 1,); with a simulated clock exactly T.
        stale: Share of ticks in which the device had nothing new.
    """

    axis: str
    period: float
    position: Array
    force: Array
    intervals: Array
    stale: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Allowance:
    """What a run may do, per kind of axis: translation (m, N, m/s), rotation (rad, N m, rad/s).

    Attributes:
        travel: From the start, to each side.
        force: Largest force or torque.
        speed: The device's own top speed.
    """

    travel: tuple[float, float]
    force: tuple[float, float]
    speed: tuple[float, float]


def move_axis(
    device: Device,
    clock: Clock,
    axis: str,
    *,
    period: float,
    duration: float,
    allowance: Allowance,
    progress: Callable[[float], None] | None = None,
) -> AxisRun:
    """Moves one axis of a started device and holds the others; ends with zero force in any case.

    The force is F = a(t) s(t) − k q − B q̇ − (k/τ)∫q: tones whose amplitude a follows the travel, a
    spring to the start with a damper, and its integral, which takes over a weight.

    Args:
        device: Started at this period.
        clock: Started.
        axis: One of the device's axes.
        period: T in s.
        duration: In s.
        allowance: Limits on travel, force and speed.
        progress: Called ten times a second with the share that is done.

    Raises:
        IdentificationError: It moved farther or faster than allowed, or its pose is not finite.
        DeviceError: The device failed.
    """
    ticks, index = round(duration / period), AXES.index(axis)
    tones = signal(index, ticks, period)
    state, sample, wrench = np.zeros(1, STATE_DTYPE), np.zeros(1, SAMPLE_DTYPE), np.zeros(6)
    past = np.zeros((max(round(SPAN / period), 1), 6))
    s = state[0]
    s["axis"], s["period"] = index, period
    s["present"] = [float(name in device.info.axes) for name in AXES]
    s["force"], s["travel"] = allowance.force, allowance.travel
    s["farthest"] = RUNAWAY * np.asarray(allowance.travel)
    s["fastest"] = SPEED_MARGIN * np.asarray(allowance.speed)
    s["amplitude"] = START_SHARE * allowance.force[index >= 3]
    compute = direct(next_wrench, state, sample, past, 0.0, 1, wrench)
    position, force, wakes = np.empty(ticks), np.empty(ticks), np.empty(ticks)
    told_every, stale, place = max(round(1.0 / (_TOLD_PER_SECOND * period)), 1), 0, s["place"]
    try:
        for k in range(ticks):
            _, wakes[k], skipped = clock.wait()
            is_new = not device.read(sample) & TickFlag.STALE_SAMPLE and not skipped
            code = compute(state, sample, past, tones[k], 1 + skipped, wrench)
            if code != OK:
                raise IdentificationError(_told(code, s))
            device.write(wrench)
            position[k] = place[index] if is_new else np.nan
            force[k] = wrench[index]
            stale += not is_new
            if progress is not None and k % told_every == 0:
                progress(k / ticks)
    finally:
        _silence(device)
    return AxisRun(axis, period, position, force, 1e-9 * np.diff(wakes), stale / ticks)


def _silence(device: Device) -> None:
    """Commands zero force; a device that is gone has said so already."""
    try:
        device.write(np.zeros(6))
    except DeviceError:
        return


def _told(code: int, s: np.void) -> str:
    """Says why a run was given up."""
    turns = code in (TURNED_FAR, TURNED_FAST)
    part, unit, factor = (slice(3, 6), "rad", 1.0) if turns else (slice(0, 3), "mm", 1e3)
    if code in (FAR, TURNED_FAR):
        distance = factor * float(np.linalg.norm(s["place"][part]))
        return (
            f"the device moved {distance:.3g} {unit} from where it started, the limit is "
            f"{factor * s['farthest'][int(turns)]:.3g} {unit}; let go of it, support its weight, "
            "or allow more travel"
        )
    if code in (FAST, TURNED_FAST):
        step = factor * float(np.linalg.norm(s["place"][part] - s["before"][part]))
        return f"the device's pose jumped by {step:.3g} {unit} in a tick, faster than it can move"
    return "the device's pose is not finite or not a rotation"
