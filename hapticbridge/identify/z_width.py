"""Stiffest virtual wall that a device bears, found by trials on the device.

The wall holds one axis at its position x_0 at the start of the trial,

    F_k = −K (x_k − x_0) − (B/T)(x_k − x_{k−1}),

and a short push sets it swinging. If the swing decays, the device bears the wall. If it grows, or
stays as a limit cycle, device and wall together create energy. K rises until that happens and is
then bisected.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.clock import Clock
from hapticbridge.device import AXES, Device
from hapticbridge.device.base import checked
from hapticbridge.errors import DeviceError, IdentificationError
from hapticbridge.identify.excitation import CALMING, CENTRING
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.theory.z_width import WITHOUT_HAND, ZWidth

# Decay of a device's swing on a virtual wall

NOISE_STEPS = 2.0
"""Amplitude in steps of resolution below which a swing has decayed."""

DIED_DOWN = 1e-3
"""Amplitude relative to the largest deflection, without unit, below which a swing has decayed."""

HALTED = 0.95
"""Share of the allowed force, without unit, at which the wall counts as saturated. It then no
longer acts as a wall."""


@dataclass(frozen=True, slots=True)
class Trial:
    """Result of one wall.

    Attributes:
        stiffness: K in N/m.
        damping: B in N s/m.
        is_borne: True if the swing decayed.
        growth: Amplitude in the last third of the trial over that in the middle third, without
            unit; 0 if nothing swings any more.
        swing: Period of one swing in s; 0 if nothing moved.
        energy: Energy in J from the wall to the device after the push.
        peak: Largest force after the push in N.
    """

    stiffness: float
    damping: float
    is_borne: bool
    growth: float
    swing: float
    energy: float
    peak: float


Array = NDArray[np.float64]

PUSH = 0.003
"""Length of the push in s: shorter than half a swing of any wall that a device bears."""

PUSH_SHARE = 0.3
"""Force of the push as a share of the allowed force, without unit. The wall's own force is then
about as large."""

TRIAL, MAX_TRIAL = 1.2, 6.0
"""Shortest and longest trial in s. The shortest one reveals 1 % below the limit for a device of 0.1
kg and 2 N s/m."""

SWINGS = 15
"""Intended number of swings per trial, within these lengths: five in each third."""

REST = 0.4
"""Time in s between trials, in which soft springs bring the device back."""

PRECISION = 0.02
"""Relative width of the interval of K at which its bisection ends, without unit."""

STEP_UP = 1.25
"""Factor between the first trial stiffnesses, without unit. Larger steps are quicker and shake the
device more when they pass the limit."""


@dataclass(frozen=True, slots=True)
class MeasuredLimit:
    """Stiffest wall at one damping.

    Attributes:
        damping: B in N s/m.
        borne: Largest K in N/m whose swing decayed, 0 if none did.
        not_borne: Smallest K in N/m whose swing did not decay; None if ``max_stiffness`` was
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


@dataclass(frozen=True, slots=True)
class WallBench:
    """A started device that renders virtual walls along one axis.

    Attributes:
        device: Device, started at this period.
        clock: Started clock.
        period: T in s.
        force: Largest force in N.
        axis: One of x, y, z that the device has.
    """

    device: Device
    clock: Clock
    period: float
    force: float
    axis: str = "x"

    def limit(
        self,
        damping: float,
        first_stiffness: float,
        max_stiffness: float,
        progress: Callable[[float], None] | None = None,
    ) -> MeasuredLimit:
        """Finds the stiffest wall that the device bears at one damping.

        Args:
            damping: B in N s/m.
            first_stiffness: First trial K in N/m, > 0.
            max_stiffness: Largest trial K in N/m.
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
            duration = min(max(TRIAL, SWINGS * swing), MAX_TRIAL)
            trials.append(self.try_wall(stiffness, damping, duration))
            return trials[-1].is_borne

        borne, stiffness = 0.0, first_stiffness
        while is_borne(stiffness):
            borne = stiffness
            if stiffness >= max_stiffness:
                return MeasuredLimit(damping, borne, None, tuple(trials))
            stiffness = min(STEP_UP * stiffness, max_stiffness)
        not_borne = stiffness
        # if even the first wall is too stiff, search down to a hundredth of it
        while not_borne - borne > PRECISION * not_borne and not_borne > 0.01 * first_stiffness:
            middle = 0.5 * (borne + not_borne)
            if is_borne(middle):
                borne = middle
            else:
                not_borne = middle
        return MeasuredLimit(damping, borne, not_borne, tuple(trials))

    def try_wall(self, stiffness: float, damping: float, duration: float = TRIAL) -> Trial:
        """Renders one wall after a rest; always ends with zero force."""
        device, period, force, index = self.device, self.period, self.force, AXES.index(self.axis)
        sample, wrench = np.zeros(1, SAMPLE_DTYPE), np.zeros(6)
        place = sample["position"][0]
        try:
            centre = self._rest(sample, wrench)
            origin = before = float(place[index])
            push, ticks = round(PUSH / period), round(duration / period)
            position, applied = np.empty(ticks), np.empty(ticks)
            for k in range(ticks):
                self.clock.wait()
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
            with suppress(DeviceError):  # the error of a lost device has been raised already
                device.write(np.zeros(6))
        return self._judged(position, applied, push, stiffness, damping)

    def _rest(self, sample: NDArray[np.void], wrench: Array) -> Array:
        """Holds the device softly for ``REST``; returns its initial position."""
        self.device.read(sample)
        place, limit = sample["position"][0], self.force
        centre = place.copy()
        before = np.tile(place, (10, 1))
        for k in range(round(REST / self.period)):
            self.clock.wait()
            self.device.read(sample)
            speed = (place - before[k % 10]) / (10 * self.period)
            before[k % 10] = place
            pull = CENTRING[0] * (centre - place) - CALMING[0] * speed
            wrench[:3] = np.clip(pull, -limit, limit)
            self.device.write(wrench)
        return np.asarray(centre)

    def _judged(
        self, position: Array, applied: Array, push: int, stiffness: float, damping: float
    ) -> Trial:
        """Classifies a swing as decaying or not.

        Its squared amplitude is x² + (x'/ω)². For a swing of one frequency ω it does not depend on
        the phase at which a third of the trial begins. The centre of the swing is the mean of the
        last third. A weight pulls the device away from the wall's position, and a slow return
        without swinging is closest to its end there.

        Args:
            position: x − x_0 in m, shape (n,).
            applied: Force on the device in N, shape (n,).
            push: Length of the push in ticks.
            stiffness: K in N/m.
            damping: B in N s/m.
        """
        resolution = self.device.info.resolution or 0.0
        after = position[push:] - np.array_split(position[push:], 3)[2].mean()
        speed = np.diff(after, append=after[-1])
        fastest = float(np.std(speed))
        ratio = float(np.std(after)) / fastest if fastest > 0.0 else 0.0
        thirds = np.array_split(after, 3)
        amplitude = np.array_split(after**2 + (ratio * speed) ** 2, 3)
        middle, last = (float(np.sqrt(np.mean(part))) for part in amplitude[1:])
        is_quiet = last <= max(NOISE_STEPS * resolution, DIED_DOWN * float(np.abs(after).max()))
        growth = 0.0 if is_quiet or middle == 0.0 else last / middle
        is_saturated = np.abs(applied[-len(thirds[2]) :]) >= HALTED * self.force
        return Trial(
            stiffness=stiffness,
            damping=damping,
            is_borne=growth < 1.0 and not is_saturated.any(),
            growth=growth,
            swing=2.0 * np.pi * ratio * self.period,
            energy=float(applied[push:-1] @ np.diff(position[push:])),
            peak=float(np.abs(applied[push:]).max()),
        )


# Measured and predicted Z-width of a device

SHARES = (0.0, 0.15, 0.3, 0.5, 0.75)
"""Trial dampings as shares of the largest damping that is passive for any hand, without unit."""

FIRST_SHARE, MAX_SHARE = 0.2, 6.0
"""Start and end of each search as shares of the predicted stiffness at B = 0, without unit. A free
device bears up to three times the stiffness that is safe for any hand."""

FORCE_SHARE = 0.5
"""Share of the device's force limit that walls and pushes may use, without unit."""


@dataclass(frozen=True, slots=True)
class MeasuredWidth:
    """Stiffness limits measured on a device, beside the predicted ones.

    Attributes:
        limits: One limit per damping, ascending.
        predicted: Smallest predicted K in N/m over all lines of theory at each damping.
        unheld: Predicted K in N/m of the device without a hand; None if its mass is unknown.
    """

    limits: tuple[MeasuredLimit, ...]
    predicted: tuple[float, ...]
    unheld: tuple[float, ...] | None


def measure_width(
    device: Device,
    clock: Clock,
    z: ZWidth,
    *,
    axis: str = "x",
    progress: Callable[[int, int, str], None] | None = None,
) -> MeasuredWidth:
    """Finds the stiffest wall at several dampings; starts the device and leaves it open.

    Args:
        device: Device that is not started.
        clock: Clock that is not started.
        z: Predicted Z-width of the device at the trial rate.
        axis: One of x, y, z that the device has.
        progress: Called with the completed count, the total count and a description of the trial.

    Raises:
        IdentificationError: The pose is not finite.
        DeviceError: The device failed.

    References:
        Colgate & Brown 1994, *Factors affecting the Z-width of a haptic display*.
    """
    device = checked(device)
    device.start(z.period)
    clock.start(round(z.period * 1e9))
    largest = next(line for line in z.lines if line.is_required).largest_damping
    dampings = [share * largest for share in SHARES]
    bench = WallBench(device, clock, z.period, FORCE_SHARE * device.info.force_limit, axis)
    limits = []
    for k, damping in enumerate(dampings):

        def report(stiffness: float, k: int = k, damping: float = damping) -> None:
            if progress is not None:
                progress(k, len(dampings), f"B = {damping:.3g}, K = {stiffness:.4g}")

        first, most = (share * float(z.limit[0]) for share in (FIRST_SHARE, MAX_SHARE))
        limits.append(bench.limit(damping, first, most, report))
    unheld = [line for line in z.lines if line.name == WITHOUT_HAND]
    return MeasuredWidth(
        limits=tuple(limits),
        predicted=tuple(float(np.interp(b, z.damping, z.limit)) for b in dampings),
        unheld=tuple(float(np.interp(b, z.damping, unheld[0].stiffness)) for b in dampings)
        if unheld
        else None,
    )


def measured_points(measured: MeasuredWidth) -> list[tuple[float, float, float]]:
    """Returns (B, K, half-width of K) of every limit found."""
    return [
        (limit.damping, limit.stiffness, 0.5 * (limit.not_borne - limit.borne))
        for limit in measured.limits
        if limit.not_borne is not None
    ]
