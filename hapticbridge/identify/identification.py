"""Identification of a device from about a minute of small motions.

Motion cannot show the origin of a damping. A hand, a glove or a cable that only damps, without
stiffness and without moving by itself, adds its damping to b in the equation of motion. Such a b is
too large, which is the unsafe side. ``UNHELD`` states this wherever b is reported.
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

UNHELD = "the device is assumed to be free: a hand that only damps cannot be distinguished from it"
"""Caveat printed with every measured b."""

DURATION = 12.0
"""Time per axis in s: eight swings of the slowest tone. The half-widths fall with its square
root."""

TRAVEL = (0.015, 0.3)
"""Travel to each side in m and rad: a tenth of a desktop device's workspace, and 300 steps of the
coarsest encoder."""

FORCE_SHARE = 0.5
"""Share of the device's force limit that the signal may use, without unit."""

UNLIKELY_SPRING = (1.0, 1e-3)
"""Stiffness in N/m and N m/rad above which the device counts as held. Our choice: simulated free
devices show less than 0.1, the softest hand tried 3."""

UNEXPLAINED_SHARE = 0.1
"""Largest unexplained share of the applied force, without unit. A simulated free device leaves 0.02
at most, a moving hand 0.7; no real device was measured."""

LOST_GAIN = 0.05
"""Share of the force above half of its maximum whose loss counts as saturation, without unit."""

PRECISION = 0.2
"""Largest usable half-width of the mass, relative to its value, without unit."""

MOST_STALE = 0.5
"""Largest share of ticks without a new sample, without unit. Beyond it the loop is too fast for the
device."""


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """Identified mechanics of a device, axis by axis.

    Attributes:
        info: Data sheet before identification.
        runs: Commanded force and measured motion per axis.
        fits: Identified parameters per axis.
        resolution: Step of the reported position in m; 0 if none was found, None without a
            translational axis.
        period: Mean time between ticks in s.
        period_spread: Standard deviation of the time between ticks in s.
        period_most: 99.9 % quantile of the time between ticks in s.
    """

    info: DeviceInfo
    runs: dict[str, AxisRun]
    fits: dict[str, AxisFit]
    resolution: float | None
    period: float
    period_spread: float
    period_most: float

    def of_all(self, name: str, *, turns: bool, most: bool = False) -> Estimate | None:
        """Returns the most cautious estimate of a field of ``AxisFit`` over all axes of a kind.

        This is the smallest value, or the largest with ``most`` (for a delay); ``turns`` selects
        rotation.
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
    """Measures mass, damping, friction, delay and resolution of a free device.

    Each axis moves in turn while weak springs hold the others. Zero force is commanded at the end
    in every case.

    Args:
        device: Device that is not started; it is started here, and the caller closes it.
        clock: Clock that is not started.
        period: T of the loop in s.
        axes: Axes to move; None: all axes of the device.
        duration: Time per axis in s; None: ``duration_at`` the period.
        travel: Travel to each side, in m and rad.
        force_share: Share of the device's limits that may be used.
        progress: Called with the axis and the completed share of its run.

    Raises:
        IdentificationError: A run is not usable; the message names the reason and the remedy.
        DeviceError: The device failed.
    """
    info = device.info
    if info.is_prescribed:
        raise IdentificationError(
            f"the device '{info.name}' does not react to force, so it has no mechanics to identify"
        )
    chosen = info.axes if axes is None else axes
    allowance = Allowance(
        travel=travel,
        force=(force_share * info.force_limit, force_share * info.torque_limit),
        # rotation is limited to the device's speed at the rim of a handle of 50 mm diameter
        speed=(info.speed_limit, info.speed_limit / 0.025),
    )
    duration = duration_at(period) if duration is None else duration
    device.start(period)
    clock.start(round(period * 1e9))
    runs, fits = {}, {}
    for axis in chosen:
        report = None if progress is None else _for_axis(progress, axis)
        runs[axis] = run = move_axis(
            device,
            clock,
            axis,
            period=period,
            duration=duration,
            allowance=allowance,
            progress=report,
        )
        fits[axis] = _checked_fit(run, info)
    intervals = np.concatenate([run.intervals for run in runs.values()])
    return Identification(
        info=info,
        runs=runs,
        fits=fits,
        resolution=_resolution(info, runs),
        period=float(intervals.mean()),
        # whole nanoseconds, the clock's unit, so that a steady clock gives 0 and not 1e-19 s
        period_spread=1e-9 * float(np.rint(1e9 * intervals).std()),
        period_most=float(np.quantile(intervals, 0.999)),
    )


def duration_at(period: float) -> float:
    """Returns the default time per axis in s for a period in s: 12, and more below 333 Hz."""
    return DURATION * stretch(period)


def _for_axis(progress: Callable[[str, float], None], axis: str) -> Callable[[float], None]:
    return lambda share: progress(axis, share)


def _checked_fit(run: AxisRun, info: DeviceInfo) -> AxisFit:
    """Fits a run and refuses untrustworthy results."""
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
            "--force-share (its motor may be saturated)"
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
    # joint encoders make no even steps in space; then the driver's value is used
    return max(found) or info.resolution or 0.0
