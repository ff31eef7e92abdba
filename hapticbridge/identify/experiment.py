"""Short, safe run that moves one axis of a device and records it."""

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
"""Multiple of the allowed travel at which a run is aborted, without unit. Such a device does not
follow the commanded force, so zero force is the safer command."""

SPEED_MARGIN = 1.5
"""Multiple of the device's own top speed that counts as a fault, without unit."""

_PROGRESS_RATE = 10
"""Rate of progress reports in Hz."""


@dataclass(frozen=True, slots=True, eq=False)
class AxisRun:
    """Commanded force and measured motion of one axis.

    Attributes:
        axis: One of ``AXES``.
        period: T in s.
        position: Displacement from the start in m or rad, NaN without a new sample, shape (n,).
        force: Force in N or N m, held from each sample to the next, shape (n,).
        intervals: Time between ticks in s, shape (n − 1,); exactly T with a simulated clock.
        stale: Share of ticks without a new sample.
    """

    axis: str
    period: float
    position: Array
    force: Array
    intervals: Array
    stale: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Allowance:
    """Limits of a run per kind of axis: translation (m, N, m/s), rotation (rad, N m, rad/s).

    Attributes:
        travel: Distance from the start, to each side.
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
    """Moves one axis of a started device and holds the others; always ends with zero force.

    The force is F = a(t) s(t) − k q − B q̇ − (k/τ)∫q: tones whose amplitude a follows the travel, a
    spring to the start, a damper, and an integral that takes over a weight.

    Args:
        device: Device, started at this period.
        clock: Started clock.
        axis: One of the device's axes.
        period: T in s.
        duration: Length of the run in s.
        allowance: Limits on travel, force and speed.
        progress: Called ten times a second with the completed share.

    Raises:
        IdentificationError: The device moved farther or faster than allowed, or its pose is not
            finite.
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
    report_every, stale, place = max(round(1.0 / (_PROGRESS_RATE * period)), 1), 0, s["place"]
    try:
        for k in range(ticks):
            _, wakes[k], skipped = clock.wait()
            is_new = not device.read(sample) & TickFlag.STALE_SAMPLE and not skipped
            code = compute(state, sample, past, tones[k], 1 + skipped, wrench)
            if code != OK:
                raise IdentificationError(_fault_message(code, s))
            device.write(wrench)
            position[k] = place[index] if is_new else np.nan
            force[k] = wrench[index]
            stale += not is_new
            if progress is not None and k % report_every == 0:
                progress(k / ticks)
    finally:
        _silence(device)
    return AxisRun(axis, period, position, force, 1e-9 * np.diff(wakes), stale / ticks)


def _silence(device: Device) -> None:
    """Commands zero force; the error of a lost device has been raised already."""
    try:
        device.write(np.zeros(6))
    except DeviceError:
        return


def _fault_message(code: int, s: np.void) -> str:
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
        limit = factor * float(s["fastest"][int(turns)])
        return (
            f"the device's pose jumped by {step:.3g} {unit} in a tick, faster than the limit of "
            f"{limit:.3g} {unit}/s; check its encoders and its connection"
        )
    return (
        "the device's pose is not finite or not a rotation; check its encoders and its connection"
    )
