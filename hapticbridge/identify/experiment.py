"""A short, safe run that moves one axis of a device by itself, and what was recorded of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.clock import Clock
from hapticbridge.device import AXES, Device
from hapticbridge.errors import IdentificationError
from hapticbridge.tick import SAMPLE_DTYPE, TickFlag

Array = NDArray[np.float64]

LOWEST, HIGHEST, TONES = 0.7, 12.0, 9
"""In Hz, and how many between them, evenly in their logarithm. Low ones show damping and friction,
high ones mass; above 12 Hz an axis of 1 kg moves less than an encoder sees, below 0.7 Hz a run of
12 s holds too few swings."""

_TILT = -0.3  # amplitude over frequency: all tones then move a damped axis by similar amounts

START_SHARE = 0.03
"""Share of the force limit with which the signal starts. It grows until the axis moves."""

GROWTH, SHRINKING = 0.7, 0.5
"""Time in s in which the signal grows e-fold while the axis moves less than asked, and shrinks
while it moves more. Faster overshoots the travel, slower wastes the run."""

_MEMORY = 0.7  # s for which the largest deflection is remembered: half of the slowest swing

CENTRING = (40.0, 0.1)
"""Stiffness in N/m and N m/rad of the spring that keeps every axis near its start. It is part of
the known force, so it does not disturb the fit. Stiffer leaves less travel to the signal."""

CALMING = (1.0, 1e-3)
"""Damping in N s/m and N m s/rad, of the motion over the last ``_SPAN``, without which a heavy
device of little damping would swing for ever. More would hide the damping that is looked for."""

_SPAN = 0.01  # s: an encoder's steps of 0.1 mm then make 0.01 N of noise

_WEIGHT_TIME = 2.0
"""Time in s in which the centring spring's integral takes over a weight."""

RUNAWAY = 2.5
"""Multiple of the allowed travel at which a run is given up: the device is not doing what the force
says, so no force is better than more of it."""

SPEED_MARGIN = 1.5
"""Multiple of the device's own top speed that counts as a fault."""


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
    """What a run may do, per kind of axis: translation (m, N), then rotation (rad, N m).

    Attributes:
        travel: From the start, to each side.
        force: Largest force or torque.
        speed: Top speed in m/s and rad/s, beyond which a sample is a fault.
    """

    travel: tuple[float, float]
    force: tuple[float, float]
    speed: tuple[float, float]


def signal(axis_index: int, ticks: int, period: float) -> Array:
    """Returns tones of random phase between −1 and 1, another one for each axis, the same always.

    Args:
        axis_index: 0 to 5.
        ticks: n.
        period: T in s.
    """
    generator = np.random.default_rng(axis_index)
    frequencies = np.geomspace(LOWEST, HIGHEST, TONES)
    phases = generator.uniform(0.0, 2.0 * np.pi, TONES)
    time = period * np.arange(ticks)
    tones = np.sin(2.0 * np.pi * frequencies[:, None] * time + phases[:, None])
    summed = (frequencies**_TILT) @ tones
    return np.asarray(summed / np.abs(summed).max())


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
    is_turn = index >= 3
    kind = 1 if is_turn else 0
    tones = signal(index, ticks, period)
    travel, most = allowance.travel[kind], allowance.force[kind]
    springs, dampers = np.repeat(CENTRING, 3), np.repeat(CALMING, 3)
    past = np.zeros((max(round(_SPAN / period), 1), 6))
    present = np.array([name in device.info.axes for name in AXES])
    sample, wrench, weight = np.zeros(1, SAMPLE_DTYPE), np.zeros(6), np.zeros(6)
    position, force, wakes = np.empty(ticks), np.empty(ticks), np.empty(ticks)
    amplitude, reach, stale = START_SHARE * most, 0.0, 0
    device.read(sample)
    start, before = _pose(sample), np.zeros(6)
    turn = Rotation.from_rotvec(start[3:]).inv()
    decay = np.exp(-period / _MEMORY)
    try:
        for k in range(ticks):
            _, wake, skipped = clock.wait()
            news = device.read(sample)
            place = _pose(sample)
            place[:3] -= start[:3]
            place[3:] = (Rotation.from_rotvec(place[3:]) * turn).as_rotvec()
            _refuse_runaway(place, before, period * (1 + skipped), allowance)
            is_new = not news & TickFlag.STALE_SAMPLE and not skipped
            stale += not is_new
            before = place
            deflection = abs(float(place[index]))
            reach = max(deflection, reach * decay)
            rate = (
                -1.0 / SHRINKING
                if reach > 0.6 * travel
                else 1.0 / GROWTH
                if reach < 0.4 * travel
                else 0.0
            )
            amplitude = min(amplitude * np.exp(rate * period), most)
            weight -= springs * place * (period / _WEIGHT_TIME)
            oldest = past[k % len(past)]
            speed = (place - oldest) / (len(past) * period)
            oldest[:] = place
            wrench[:] = np.where(present, weight - springs * place - dampers * speed, 0.0)
            wrench[index] += amplitude * tones[k]
            for part, limit in (
                (slice(0, 3), allowance.force[0]),
                (slice(3, 6), allowance.force[1]),
            ):
                size = float(np.linalg.norm(wrench[part]))
                if size > limit:
                    wrench[part] *= limit / size
            device.write(wrench)
            position[k] = place[index] if is_new else np.nan
            force[k], wakes[k] = wrench[index], wake
            if progress is not None and k % max(round(0.1 / period), 1) == 0:
                progress(k / ticks)
    finally:
        device.write(np.zeros(6))
    return AxisRun(axis, period, position, force, 1e-9 * np.diff(wakes), stale / ticks)


def _pose(sample: NDArray[np.void]) -> Array:
    """Returns position and rotation vector of a sample, shape (6,)."""
    w, x, y, z = sample["quaternion"][0]
    if (
        not np.isfinite(sample["position"]).all()
        or not 0.5 < np.hypot(np.hypot(w, x), np.hypot(y, z)) < 2.0
    ):
        raise IdentificationError("the device's pose is not finite or not a rotation")
    return np.concatenate([sample["position"][0], Rotation.from_quat([x, y, z, w]).as_rotvec()])


def _refuse_runaway(place: Array, before: Array, time: float, allowance: Allowance) -> None:
    for kind, (part, unit, factor) in enumerate(
        ((slice(0, 3), "mm", 1e3), (slice(3, 6), "rad", 1.0))
    ):
        distance = float(np.linalg.norm(place[part]))
        most = RUNAWAY * allowance.travel[kind]
        if distance > most:
            raise IdentificationError(
                f"the device moved {factor * distance:.3g} {unit} from where it started, the limit "
                f"is {factor * most:.3g} {unit}; let go of it, support its weight, or allow more "
                "travel"
            )
        speed = float(np.linalg.norm(place[part] - before[part])) / time
        if speed > SPEED_MARGIN * allowance.speed[kind]:
            raise IdentificationError(
                f"the device's pose jumped at {factor * speed:.3g} {unit}/s, faster than it can be"
            )
