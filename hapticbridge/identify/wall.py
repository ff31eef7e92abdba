"""Stiffest virtual wall that a device bears, found by trials on the device.

The wall holds one axis at its position x_0 at the start of the trial,

    F_k = −K (x_k − x_0) − (B/T)(x_k − x_{k−1}),

and a short push sets it swinging. If the swing decays, the device bears the wall. If it grows, or
stays as a limit cycle, device and wall together generate energy. K rises until that happens and is
then bisected.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.clock import Clock
from hapticbridge.device import AXES, Device
from hapticbridge.errors import DeviceError, IdentificationError
from hapticbridge.identify.excitation import CALMING, CENTRING
from hapticbridge.identify.swing import Trial, judged
from hapticbridge.tick import SAMPLE_DTYPE

Array = NDArray[np.float64]

PUSH = 0.003
"""Length of the push in s: shorter than half a swing of any wall that a device bears."""

PUSH_SHARE = 0.3
"""Force of the push as a share of the allowed force, without unit. The wall's own force is then
about as large."""

TRIAL, LONGEST_TRIAL = 1.2, 6.0
"""Shortest and longest trial in s. The shortest one reveals 1 % below the limit for a device of 0.1
kg and 2 N s/m."""

SWINGS = 15
"""Intended number of swings per trial, within these lengths: five in each third."""

REST = 0.4
"""Time in s between trials, in which soft springs bring the device back."""

STEP_UP = 1.25
"""Factor between the first trial stiffnesses, without unit. Larger steps are quicker and shake the
device more when they pass the limit."""


@dataclass(frozen=True, slots=True)
class MeasuredLimit:
    """Stiffest wall at one damping.

    Attributes:
        damping: B in N s/m.
        borne: Largest K in N/m whose swing decayed, 0 if none did.
        not_borne: Smallest K in N/m whose swing did not decay; None if ``most_stiffness`` was
            borne.
        trials: All trials, in order.
    """

    damping: float
    borne: float
    not_borne: float | None
    trials: tuple[Trial, ...]

    @property
    def stiffness(self) -> float:
        """Middle between the two in N/m, or the borne stiffness."""
        return self.borne if self.not_borne is None else 0.5 * (self.borne + self.not_borne)


def measure_limit(
    device: Device,
    clock: Clock,
    *,
    damping: float,
    period: float,
    force: float,
    axis: str = "x",
    first_stiffness: float,
    most_stiffness: float,
    precision: float = 0.02,
    progress: Callable[[float], None] | None = None,
) -> MeasuredLimit:
    """Finds the stiffest wall that a started device bears at one damping.

    Args:
        device: Device, started at this period.
        clock: Started clock.
        damping: B in N s/m.
        period: T in s.
        force: Largest force in N.
        axis: One of x, y, z that the device has.
        first_stiffness: First trial K in N/m, > 0.
        most_stiffness: Largest trial K in N/m.
        precision: Relative width at which the bisection of K ends.
        progress: Called before each trial with its stiffness.

    Raises:
        IdentificationError: The pose is not finite.
        DeviceError: The device failed.
    """
    trials: list[Trial] = []

    def is_borne(stiffness: float) -> bool:
        if progress is not None:
            progress(stiffness)
        swing = trials[-1].swing if trials else 0.0
        trials.append(
            try_wall(
                device,
                clock,
                stiffness,
                damping,
                period=period,
                force=force,
                axis=axis,
                duration=min(max(TRIAL, SWINGS * swing), LONGEST_TRIAL),
            )
        )
        return trials[-1].is_borne

    borne, stiffness = 0.0, first_stiffness
    while is_borne(stiffness):
        borne = stiffness
        if stiffness >= most_stiffness:
            return MeasuredLimit(damping, borne, None, tuple(trials))
        stiffness = min(STEP_UP * stiffness, most_stiffness)
    not_borne = stiffness
    # if even the first wall is too stiff, search down to a hundredth of it
    while not_borne - borne > precision * not_borne and not_borne > 0.01 * first_stiffness:
        middle = 0.5 * (borne + not_borne)
        if is_borne(middle):
            borne = middle
        else:
            not_borne = middle
    return MeasuredLimit(damping, borne, not_borne, tuple(trials))


def try_wall(
    device: Device,
    clock: Clock,
    stiffness: float,
    damping: float,
    *,
    period: float,
    force: float,
    axis: str = "x",
    duration: float = TRIAL,
) -> Trial:
    """Renders one wall after a rest, as for ``measure_limit``; always ends with zero force."""
    index = AXES.index(axis)
    sample, wrench = np.zeros(1, SAMPLE_DTYPE), np.zeros(6)
    place = sample["position"][0]
    try:
        centre = _rest(device, clock, sample, wrench, period, force)
        origin = before = float(place[index])
        push, ticks = round(PUSH / period), round(duration / period)
        position, applied = np.empty(ticks), np.empty(ticks)
        for k in range(ticks):
            clock.wait()
            device.read(sample)
            x = float(place[index])
            if not np.isfinite(place).all():
                raise IdentificationError(
                    "the device's pose is not finite; check its encoders and its connection"
                )
            wall = -stiffness * (x - origin) - damping / period * (x - before)
            before = x
            requested = wall + (PUSH_SHARE * force if k < push else 0.0)
            wrench[:3] = CENTRING[0] * (centre - place)
            wrench[index] = min(max(requested, -force), force)
            device.write(wrench)
            position[k], applied[k] = x - origin, wrench[index]
    finally:
        _silence(device)
    return judged(
        position,
        applied,
        push,
        period,
        stiffness=stiffness,
        damping=damping,
        force=force,
        resolution=device.info.resolution or 0.0,
    )


def _rest(
    device: Device,
    clock: Clock,
    sample: NDArray[np.void],
    wrench: Array,
    period: float,
    force: float,
) -> Array:
    """Holds the device softly for ``REST``; returns its initial position."""
    device.read(sample)
    place = sample["position"][0]
    centre = place.copy()
    before = np.tile(place, (10, 1))
    for k in range(round(REST / period)):
        clock.wait()
        device.read(sample)
        speed = (place - before[k % 10]) / (10 * period)
        before[k % 10] = place
        wrench[:3] = np.clip(CENTRING[0] * (centre - place) - CALMING[0] * speed, -force, force)
        device.write(wrench)
    return np.asarray(centre)


def _silence(device: Device) -> None:
    try:
        device.write(np.zeros(6))
    except DeviceError:
        return
