"""How stiff a virtual wall the device really bears: tried, step by step, on the device itself.

The wall holds one axis at the place x_0 where it is when the trial begins,

    F_k = −K (x_k − x_0) − (B/T)(x_k − x_{k−1}),

and a short push sets it swinging. While the swing dies down the wall can be shown; where it grows,
or stays as a limit cycle, device and wall together create energy. K rises until that happens, and
is then narrowed down.
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
from hapticbridge.tick import SAMPLE_DTYPE

Array = NDArray[np.float64]

PUSH = 0.003
"""Length of the push in s: shorter than half a swing of any wall that a device bears."""

PUSH_SHARE = 0.3
"""Share of the allowed force that the push takes. The wall's own force is then about as large."""

TRIAL, LONGEST_TRIAL = 1.2, 6.0
"""Least and greatest length of a trial in s. A device of 0.1 kg and 2 N s/m tells 1 % below its
limit from it in the least."""

SWINGS = 15
"""Swings that a trial should hold, within these lengths: five in each third."""

REST = 0.4
"""Time in s between trials, in which soft springs bring the device back."""

STEP_UP = 1.25
"""Factor between the first stiffnesses tried. Larger steps are quicker and shake the device more
when they pass the limit."""

NOISE_STEPS = 2.0
"""Amplitude in steps of resolution below which a swing has died down."""

DIED_DOWN = 1e-3
"""Share of the largest deflection below which a swing has died down, whatever it does then."""

HALTED = 0.95
"""Share of the allowed force at which the wall pushes as hard as it may: it is not a wall then."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One wall.

    Attributes:
        stiffness: K in N/m.
        damping: B in N s/m.
        is_borne: Whether the swing died down.
        growth: Amplitude in the last third of the trial over that in the middle third, without
            unit; 0 where nothing swung any more.
        swing: Time of one swing in s; 0 where nothing moved.
        energy: What the wall gave to the device after the push, in J.
        peak: Largest force after the push in N.
    """

    stiffness: float
    damping: float
    is_borne: bool
    growth: float
    swing: float
    energy: float
    peak: float


@dataclass(frozen=True, slots=True)
class MeasuredLimit:
    """The stiffest wall at one damping.

    Attributes:
        damping: B in N s/m.
        borne: Largest K in N/m that died down, 0 where none did.
        not_borne: Smallest K that did not; None where even ``most_stiffness`` was borne.
        trials: All that were made, in order.
    """

    damping: float
    borne: float
    not_borne: float | None
    trials: tuple[Trial, ...]

    @property
    def stiffness(self) -> float:
        """The middle between the two, or what was borne, in N/m."""
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
        device: Started at this period.
        clock: Started.
        damping: B in N s/m.
        period: T in s.
        force: Largest force in N.
        axis: One of x, y, z that the device has.
        first_stiffness: Where to begin, in N/m, > 0.
        most_stiffness: Where to give up, in N/m.
        precision: Relative width to which K is narrowed down.
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
    # softer than the first: where even that is too stiff, down to a hundredth of it
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
    """Shows one wall for a second, after a rest; ends with zero force in any case.

    Args:
        device: Started at this period.
        clock: Started.
        stiffness: K in N/m.
        damping: B in N s/m.
        period: T in s.
        force: Largest force in N.
        axis: One of x, y, z that the device has.
        duration: In s.

    Raises:
        IdentificationError: The pose is not finite.
        DeviceError: The device failed.
    """
    index = AXES.index(axis)
    sample, wrench = np.zeros(1, SAMPLE_DTYPE), np.zeros(6)
    place = sample["position"][0]
    try:
        centre = _rest(device, clock, sample, wrench, period, force)
        origin = before = float(place[index])
        push, ticks = round(PUSH / period), round(duration / period)
        position, given = np.empty(ticks), np.empty(ticks)
        for k in range(ticks):
            clock.wait()
            device.read(sample)
            x = float(place[index])
            if not np.isfinite(place).all():
                raise IdentificationError("the device's pose is not finite")
            wall = -stiffness * (x - origin) - damping / period * (x - before)
            before = x
            wanted = wall + (PUSH_SHARE * force if k < push else 0.0)
            wrench[:3] = CENTRING[0] * (centre - place)
            wrench[index] = min(max(wanted, -force), force)
            device.write(wrench)
            position[k], given[k] = x - origin, wrench[index]
    finally:
        _silence(device)
    return _judged(
        position,
        given,
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
    """Holds the device softly until it is still; returns where it was at first."""
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


def _judged(
    position: Array,
    given: Array,
    push: int,
    period: float,
    *,
    stiffness: float,
    damping: float,
    force: float,
    resolution: float,
) -> Trial:
    """Tells a swing that dies down from one that does not.

    Its amplitude is that of x² + (x'/ω)², which for a swing of one frequency ω does not depend on
    where in a swing a third of the trial begins. What it swings about is the mean of the last third:
    a weight pulls it off the wall's place, and a slow return that does not swing is nearest there.
    """
    after = position[push:] - np.array_split(position[push:], 3)[2].mean()
    speed = np.diff(after, append=after[-1])
    fastest = float(np.std(speed))
    ratio = float(np.std(after)) / fastest if fastest > 0.0 else 0.0
    thirds = np.array_split(after, 3)
    amplitude = np.array_split(after**2 + (ratio * speed) ** 2, 3)
    middle, last = (float(np.sqrt(np.mean(part))) for part in amplitude[1:])
    peak = float(np.abs(given[push:]).max())
    is_quiet = last <= max(NOISE_STEPS * resolution, DIED_DOWN * float(np.abs(after).max()))
    growth = 0.0 if is_quiet or middle == 0.0 else last / middle
    halted = np.abs(given[-len(thirds[2]) :]) >= HALTED * force
    return Trial(
        stiffness=stiffness,
        damping=damping,
        is_borne=growth < 1.0 and not halted.any(),
        growth=growth,
        swing=2.0 * np.pi * ratio * period,
        energy=float(given[push:-1] @ np.diff(position[push:])),
        peak=peak,
    )
