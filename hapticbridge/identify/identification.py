"""Everything that a minute of small motions tells of a device, or why it tells nothing.

What no motion tells: who damps. A hand, a glove or a cable that only damps, without stiffness and
without moving by itself, adds its damping to b in the equation of motion, where nothing sets the
two apart. Such a b is too large, which is the unsafe side; ``UNHELD`` says so wherever b is told.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.clock import Clock
from hapticbridge.device import Device, DeviceInfo
from hapticbridge.errors import IdentificationError
from hapticbridge.identify.axis_fit import AxisFit
from hapticbridge.identify.estimate import Estimate
from hapticbridge.identify.excitation import stretch
from hapticbridge.identify.experiment import Allowance, AxisRun, move_axis
from hapticbridge.identify.fit import fit_axis
from hapticbridge.identify.resolution import step_of

Array = NDArray[np.float64]

UNHELD = (
    "that nobody held it is the user's word: a hand that only damps cannot be told from the device"
)
"""Goes with every b that was measured."""

DURATION = 12.0
"""Seconds per axis: eight swings of the slowest tone. The half-widths fall with its square root."""

TRAVEL = (0.015, 0.3)
"""To each side in m and rad: a tenth of a desktop device's workspace, 300 steps of the coarsest
encoder."""

FORCE_SHARE = 0.5
"""Share of the device's force limit that the signal may use."""

UNLIKELY_SPRING = (1.0, 1e-3)
"""Stiffness in N/m and N m/rad from which on somebody or something holds the device. Our choice:
simulated free devices show less than 0.1, the softest hand tried 3."""

UNEXPLAINED_SHARE = 0.1
"""Share of the applied force that may stay unexplained. A simulated free
device leaves 0.02 at most, a hand that moves 0.7; no real device was measured."""

LOST_GAIN = 0.05
"""Share of the force above half of the largest whose loss counts as saturation."""

PRECISION = 0.2
"""Largest half-width of the mass, relative to its value, that is worth a result."""

MOST_STALE = 0.5
"""Share of ticks without a new sample beyond which the loop runs too fast for the device."""


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """What a device is, axis by axis.

    Attributes:
        info: The data sheet it had before.
        runs: What was commanded and seen, per axis.
        fits: What follows from it, per axis.
        resolution: Step of the reported position in m, 0 where none was seen; None where it does
            not move along any axis.
        period: Mean time between ticks in s.
        period_spread: Its standard deviation in s.
        period_most: The longest but one in a thousand, in s.
    """

    info: DeviceInfo
    runs: dict[str, AxisRun]
    fits: dict[str, AxisFit]
    resolution: float | None
    period: float
    period_spread: float
    period_most: float

    def of_all(self, name: str, *, turns: bool, most: bool = False) -> Estimate | None:
        """Returns an estimate for all axes of a kind: the one that is on the safe side.

        Args:
            name: A field of ``AxisFit``.
            turns: Whether of rotation.
            most: Whether the largest is the safe one (delay); else the smallest.
        """
        fits = [fit for axis, fit in self.fits.items() if (len(axis) == 2) == turns]
        found: list[Estimate] = [getattr(fit, name) for fit in fits]
        if not found:
            return None
        return max(found, key=lambda e: e.most) if most else min(found, key=lambda e: e.least)


def identify(
    device: Device,
    clock: Clock,
    *,
    period: float,
    axes: tuple[str, ...] | None = None,
    duration: float | None = None,
    travel: tuple[float, float] = TRAVEL,
    force_share: float = FORCE_SHARE,
    progress: Callable[[str, float], None] | None = None,
) -> Identification:
    """Measures mass, damping, friction, delay and resolution of a device that nobody holds.

    Each axis is moved by itself for ``duration`` seconds while weak springs hold the others; zero
    force is commanded at the end whatever happens.

    Args:
        device: Not started yet; it is started here, and left to be closed by the caller.
        clock: Not started yet.
        period: T in s of the loop.
        axes: Which; None: all that the device has.
        duration: Seconds per axis; None: ``duration_at`` the period.
        travel: To each side, in m and rad.
        force_share: Share of the device's limits that may be used.
        progress: Called with the axis and the share of its run that is done.

    Raises:
        IdentificationError: A run tells nothing: the reason, and what to change.
        DeviceError: The device failed.
    """
    info = device.info
    if info.is_prescribed:
        raise IdentificationError(
            f"the device '{info.name}' does not react to force; there is nothing to identify"
        )
    chosen = info.axes if axes is None else axes
    allowance = Allowance(
        travel=travel,
        force=(force_share * info.force_limit, force_share * info.torque_limit),
        # a turn is not faster than the rim of a 50 mm handle at the device's speed
        speed=(info.speed_limit, info.speed_limit / 0.025),
    )
    duration = duration_at(period) if duration is None else duration
    device.start(period)
    clock.start(round(period * 1e9))
    runs, fits = {}, {}
    for axis in chosen:
        told = None if progress is None else _bound(progress, axis)
        runs[axis] = run = move_axis(
            device,
            clock,
            axis,
            period=period,
            duration=duration,
            allowance=allowance,
            progress=told,
        )
        fits[axis] = _judged(run, info)
    intervals = np.concatenate([run.intervals for run in runs.values()])
    return Identification(
        info=info,
        runs=runs,
        fits=fits,
        resolution=_resolution(info, runs),
        period=float(intervals.mean()),
        # in whole nanoseconds, as the clock counts: a steady one has no spread, not 1e-19 s
        period_spread=1e-9 * float(np.rint(1e9 * intervals).std()),
        period_most=float(np.quantile(intervals, 0.999)),
    )


def duration_at(period: float) -> float:
    """Returns how many seconds an axis takes unless somebody says otherwise: 12, more below 333 Hz.

    Args:
        period: T in s.
    """
    return DURATION * stretch(period)


def _bound(progress: Callable[[str, float], None], axis: str) -> Callable[[float], None]:
    return lambda share: progress(axis, share)


def _judged(run: AxisRun, info: DeviceInfo) -> AxisFit:
    """Fits a run, and refuses what it cannot be trusted with."""
    turns = len(run.axis) == 2
    unit, spring_unit = ("N m", "N m/rad") if turns else ("N", "N/m")
    where = f"axis {run.axis}"
    if run.stale > MOST_STALE:
        raise IdentificationError(
            f"{where}: {run.stale:.0%} of the ticks brought no new sample; choose a rate near the "
            "device's own"
        )
    step = step_of(run.position) or info.resolution or 0.0
    try:
        fit = fit_axis(run.position, run.force, run.period, 0.0 if turns else step)
    except IdentificationError as error:
        raise IdentificationError(f"{where}: {error}") from None
    if fit.spring.least > UNLIKELY_SPRING[turns]:
        raise IdentificationError(
            f"{where}: a spring of {fit.spring.value:.3g} {spring_unit} holds the device; let go "
            "of it, or free the cable"
        )
    if fit.unexplained > UNEXPLAINED_SHARE * fit.force:
        raise IdentificationError(
            f"{where}: {fit.unexplained:.2g} {unit} of the {fit.force:.2g} {unit} that moved it "
            "were not commanded: let go of it, keep it from touching anything, or lower "
            "--force-share (its motor may be at its end)"
        )
    if fit.lost_gain.least > LOST_GAIN:
        largest = float(np.abs(run.force).max())
        raise IdentificationError(
            f"{where}: {fit.lost_gain.value:.0%} of the force above {0.5 * largest:.2g} {unit} did "
            f"not act: the motor saturates; lower --force-share"
        )
    if not fit.mass.half_width < PRECISION * fit.mass.value:
        raise IdentificationError(
            f"{where}: mass {fit.mass.value:.2g} ± {fit.mass.half_width:.2g} is not known well "
            "enough; allow more travel, more force or more time"
        )
    return fit


def _resolution(info: DeviceInfo, runs: dict[str, AxisRun]) -> float | None:
    found = [step_of(run.position) for axis, run in runs.items() if len(axis) == 1]
    if not found:
        return None
    # joint encoders make no even steps in space; a driver then knows better
    return max(found) or info.resolution or 0.0
