"""Identification of a device from about a minute of small motions.

Motion cannot show the origin of a damping. A hand, a glove or a cable that only damps, without
stiffness and without moving by itself, adds its damping to b in the equation of motion. Such a b is
too large, which is the unsafe side. ``UNHELD`` states this wherever b is reported.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hapticbridge.clock import Clock, RealClock
from hapticbridge.device import AXES, Device, DeviceInfo
from hapticbridge.device.base import JUMP_MARGIN, checked
from hapticbridge.device.profile import Profile, Quantity
from hapticbridge.device.watchdog import SILENCE
from hapticbridge.errors import DeviceError, IdentificationError
from hapticbridge.identify.excitation import (
    FAR,
    FAST,
    LOWEST,
    OK,
    SPAN,
    START_SHARE,
    STATE_DTYPE,
    TURNED_FAR,
    TURNED_FAST,
    next_wrench,
    signal,
    stretch,
)
from hapticbridge.identify.fit import (
    MAX_DELAY,
    AxisFit,
    Estimate,
    Trace,
    fit_axis,
    noise_of,
    windows,
)
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag
from hapticbridge.plotting import new_figure
from hapticbridge.realtime import real_time
from hapticbridge.realtime.realtime import warn_of_refusals
from hapticbridge.units import format_si

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Short, safe run that moves one axis of a device and records it

RUNAWAY = 3.0
"""Multiple of the allowed travel at which a run is aborted, without unit. Such a device does not
follow the commanded force, so zero force is the safer command."""

SAMPLES = 5
"""Samples of a device with a rate of its own that may be missing before it counts as silent."""

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
        duration: Length of the run in s.
    """

    travel: tuple[float, float]
    force: tuple[float, float]
    speed: tuple[float, float]
    duration: float


def move_axis(
    device: Device,
    clock: Clock,
    axis: str,
    *,
    period: float,
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
        allowance: Limits on travel, force, speed and time.
        progress: Called ten times a second with the completed share.

    Raises:
        IdentificationError: The device moved farther or faster than allowed, gave no new sample
            for ``SILENCE``, or its pose is not finite.
        DeviceError: The device failed.
    """
    ticks, index = round(allowance.duration / period), AXES.index(axis)
    tones = signal(index, ticks, period)
    state, sample, wrench = np.zeros(1, STATE_DTYPE), np.zeros(1, SAMPLE_DTYPE), np.zeros(6)
    past = np.zeros((max(round(SPAN / period), 1), 6))
    s = state[0]
    s["axis"], s["period"] = index, period
    s["present"] = [float(name in device.info.axes) for name in AXES]
    s["force"], s["travel"] = allowance.force, allowance.travel
    s["farthest"] = RUNAWAY * np.asarray(allowance.travel)
    s["fastest"] = JUMP_MARGIN * np.asarray(allowance.speed)
    s["amplitude"] = START_SHARE * allowance.force[index >= 3]
    compute = direct(next_wrench, state, sample, past, 0.0, 1, wrench)
    position, force, wakes = np.empty(ticks), np.empty(ticks), np.empty(ticks)
    report_every, place = max(round(1.0 / (_PROGRESS_RATE * period)), 1), s["place"]
    stale = since_new = silent = 0
    patience = max(math.ceil(SILENCE / period), SAMPLES / (period * (device.info.rate or np.inf)))
    try:
        for k in range(ticks):
            _, wakes[k], skipped = clock.wait()
            since_new += 1 + skipped
            has_come = not device.read(sample) & TickFlag.STALE_SAMPLE
            is_new = has_come and not skipped
            code = compute(state, sample, past, tones[k], since_new, wrench)
            if code != OK:
                raise IdentificationError(_fault_message(code, axis, s))
            device.write(wrench)
            position[k] = place[index] if is_new else np.nan
            force[k] = wrench[index]
            stale += not is_new
            since_new = 0 if has_come else since_new
            silent = 0 if has_come else silent + 1
            if silent > patience:
                raise IdentificationError(
                    f"the device gave no new sample for {format_si(silent * period, 's')} while it "
                    f"pushed along {axis}; check its link and its power"
                )
            if progress is not None and k % report_every == 0:
                progress(k / ticks)
    finally:
        with suppress(DeviceError):  # the error of a lost device has been raised already
            device.write(np.zeros(6))
    return AxisRun(axis, period, position, force, 1e-9 * np.diff(wakes), stale / ticks)


def _fault_message(code: int, axis: str, s: np.void) -> str:
    turns = code in (TURNED_FAR, TURNED_FAST)
    part, unit, factor = (slice(3, 6), "rad", 1.0) if turns else (slice(0, 3), "mm", 1e3)
    if code in (FAR, TURNED_FAR):
        distance = factor * float(np.linalg.norm(s["place"][part]))
        return (
            f"pushed along {axis}, the device moved {distance:.3g} {unit} from its "
            f"start, the limit is {factor * s['farthest'][int(turns)]:.3g} {unit}; let go, support "
            "its weight, check the signs of its axes (a reversed one runs away), or allow more "
            "travel (--travel)"
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


# Position resolution, found from positions

MAX_STEPS = 2_000_000
"""Largest number of steps in the travel. A smaller step counts as rounding of a double or a
float."""


def step_of(position: Array) -> float:
    """Returns the step of a reported position in its unit, 0 if it has none.

    All differences between positions must be multiples of the step. The smallest difference is
    refined by all of them: Δ = Σ n d / Σ n² over the differences d = n Δ.

    Args:
        position: Position in m, NaN without a sample.
    """
    values = np.unique(position[np.isfinite(position)])
    if len(values) < 3:
        return 0.0
    gaps = np.diff(values)
    span = float(values[-1] - values[0])
    gaps = gaps[gaps > span / MAX_STEPS]  # smaller gaps are equal positions rounded differently
    if not gaps.size:
        return 0.0
    step = float(gaps.min())
    counts = np.rint(gaps / step)
    if np.abs(gaps / step - counts).max() > 0.02 or len(gaps) < 3:
        return 0.0
    step = float(counts @ gaps / (counts @ counts))
    total = round(span / step)
    return span / total if math.isclose(span / total, step, rel_tol=1e-3) else 0.0


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

LATE = 1.5
"""Longest interval of one in a thousand ticks, relative to the period, from which on the loop is
named beside the device; without unit."""

PRECISION = 0.2
"""Largest usable half-width of the mass, relative to its value, without unit."""

LONGER = 3.0
"""Least ratio of the time at the end of a run without a change of the position, for a position that
has stopped, to each earlier rest; without unit. It is also at least a swing of the slowest tone."""

MAX_STALE = 1 / 3
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
        estimates: list[Estimate] = [getattr(fit, name) for fit in fits]
        if not estimates:
            return None
        return (
            max(estimates, key=lambda e: e.most) if most else min(estimates, key=lambda e: e.least)
        )


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
        duration=duration_at(period) if duration is None else duration,
    )
    device = checked(device)
    device.start(period)
    clock.start(round(period * 1e9))
    runs, fits = {}, {}
    with ExitStack() as stack:
        if info.is_real and clock.name == RealClock.name:
            warn_of_refusals(stack.enter_context(real_time()))
        for axis in chosen:
            report = None if progress is None else partial(progress, axis)
            runs[axis] = run = move_axis(
                device, clock, axis, period=period, allowance=allowance, progress=report
            )
            try:
                fits[axis] = _checked_fit(run, info)
            except IdentificationError as error:
                raise IdentificationError(f"{error}{_late_words(run)}") from None
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


def _late_words(run: AxisRun) -> str:
    """Returns a clause on a loop that did not keep its own period; empty if it did."""
    longest = float(np.quantile(run.intervals, 0.999))
    if longest <= LATE * run.period:
        return ""
    return (
        f"; but the loop itself was late: one tick in a thousand took {format_si(longest, 's')} "
        "and more, see 'hapticbridge doctor'"
    )


def _checked_fit(run: AxisRun, info: DeviceInfo) -> AxisFit:
    """Fits a run and refuses untrustworthy results."""
    turns = len(run.axis) == 2
    unit, spring_unit = ("N m", "N m/rad") if turns else ("N", "N/m")
    where = f"axis {run.axis}"
    if run.stale > MAX_STALE:
        raise IdentificationError(
            f"{where}: {run.stale:.0%} of the ticks brought no new sample; choose a rate near the "
            "device's own"
        )
    largest = float(np.abs(run.force).max())
    if np.nanmin(run.position) == np.nanmax(run.position):
        raise IdentificationError(
            f"{where}: its position did not change under up to {largest:.2g} {unit}; move the "
            "handle by hand: if it does not change then, check its encoders and calibration, and "
            "else the power of its motors, or raise --force-share against friction"
        )
    if (stopped := _stop_of(run)) is not None:
        raise IdentificationError(
            f"{where}: its position stopped changing after {stopped:.2f} s, and the force went on "
            f"for {len(run.position) * run.period - stopped:.2f} s; move the handle by hand: if it "
            "does not change then, check its encoder and cable, and else what holds the handle"
        )
    step = step_of(run.position) or info.resolution or 0.0
    try:
        fit = fit_axis(run.position, run.force, run.period, 0.0 if turns else step)
    except IdentificationError as error:
        raise IdentificationError(f"{where}: {error}") from None
    if fit.delay.value >= MAX_DELAY:  # where the search stops; with less, K would be too stiff
        raise IdentificationError(
            f"{where}: it answers {1e3 * MAX_DELAY:g} ms late or later, and with that it bears no "
            "stiffness worth feeling; use a faster link, or one without buffers on the way"
        )
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
        raise IdentificationError(
            f"{where}: {fit.lost_gain.value:.0%} of the force above {0.5 * largest:.2g} {unit} did "
            f"not act: the motor saturates; lower --force-share"
        )
    if not fit.mass.half_width < PRECISION * fit.mass.value:
        raise IdentificationError(
            f"{where}: mass {fit.mass.value:.2g} ± {fit.mass.half_width:.2g} is not known well "
            "enough; allow more travel (--travel), more force (--force-share) or more time "
            "(--duration)"
        )
    return fit


def _stop_of(run: AxisRun) -> float | None:
    """Returns the time in s after which the position never changed, or None if it went on.

    A device that sticks now and then has rested as long before.
    """
    (fresh,) = np.nonzero(np.isfinite(run.position))
    changed = fresh[1:][np.diff(run.position[fresh]) != 0.0]
    rested = np.diff(changed, prepend=0).max(initial=0)
    silent = int(fresh[-1] - changed[-1])
    if silent * run.period <= max(stretch(run.period) / LOWEST, LONGER * rested * run.period):
        return None
    return float(changed[-1] * run.period)


def _resolution(info: DeviceInfo, runs: dict[str, AxisRun]) -> float | None:
    steps = [step_of(run.position) for axis, run in runs.items() if len(axis) == 1]
    if not steps:
        return None
    # joint encoders make no even steps in space; then the driver's value is used
    return max(steps) or info.resolution or 0.0


# Plot of the identified law: resistance of each axis over its speed


_COLOURS = {"x": "#a51d2d", "y": "#1b7837", "z": "#1a5fb4"}

_WIDTHS = {"x": 5.0, "y": 3.0, "z": 1.2}
"""Line widths in points. Lines of similar axes coincide, and all must remain visible."""


def draw_identification(result: Identification) -> Figure:
    """Draws the force of each axis, less inertia and constant, over the speed.

    Each point is one window: F − M x'' − c over x'. A device that obeys the law lies on the line b
    x' + b_2 x' |x'| + f_c sign(x'), with b_2 only if it is significant.

    Args:
        result: Result of ``identify``.
    """
    kinds = [turns for turns in (False, True) if any((len(a) == 2) == turns for a in result.fits)]
    figure = new_figure(8, 4.0 * len(kinds) + 0.3)
    panels = figure.subplots(len(kinds), 1, squeeze=False)[:, 0]
    for panel, turns in zip(panels, kinds, strict=True):
        for axis, fit in result.fits.items():
            if (len(axis) == 2) == turns:
                _draw_axis(panel, result, axis, fit)
        panel.axhline(0.0, color="#777777", lw=0.8)
        panel.axvline(0.0, color="#777777", lw=0.8)
        panel.set_xlabel("angular velocity (rad/s)" if turns else "velocity (m/s)")
        panel.set_ylabel("torque F − M x'' − c (N m)" if turns else "force F − M x'' − c (N)")
        panel.grid(alpha=0.3)
        panel.legend(fontsize="small", loc="upper left")
    bends = any(fit.drag.is_seen for fit in result.fits.values())
    law = f"b v + {'b_2 v |v| + ' if bends else ''}f_c sign(v)"
    figure.suptitle(
        f"Resistance of {result.info.name}: points measured, lines {law}",
        fontsize="medium",
        parse_math=False,
    )
    return figure


def _draw_axis(panel: Axes, result: Identification, axis: str, fit: AxisFit) -> None:
    run, colour = result.runs[axis], _COLOURS[axis[-1]]
    turns = len(axis) == 2
    step = 0.0 if turns else result.resolution or 0.0
    trace = Trace(run.position, run.force, run.period, step, noise_of(run.position, step))
    windowed = windows(trace, fit.window, fit.delay.value)
    area = windowed.columns[:, 3]
    speed = windowed.columns[:, 1] / area
    rest = windowed.right / area - fit.mass.value * windowed.columns[:, 0] / area - fit.offset.value
    panel.plot(speed, rest, ".", color=colour, ms=3, zorder=3)
    most = float(np.abs(speed).max())
    line = np.linspace(-most, most, 400)
    force = fit.resistance(line)
    units = ("N m s/rad", "N m") if turns else ("N s/m", "N")
    panel.plot(
        line,
        force,
        color=colour,
        lw=_WIDTHS[axis[-1]],
        alpha=0.45,
        label=f"{axis}: b = {fit.damping.as_text()} {units[0]}, "
        f"f_c = {fit.friction.as_text()} {units[1]}",
    )


_FIELDS = {
    "mass": ("mass", False),
    "damping": ("damping", False),
    "friction": ("friction", False),
    "rotational_inertia": ("mass", True),
    "rotational_damping": ("damping", True),
}


def measured_profile(
    result: Identification,
    *,
    device: str,
    serial: str,
    date: str,
    duration: float,
    workspace: tuple[float, float, float] | None = None,
) -> Profile:
    """Returns a profile of the unit with the most cautious values of each kind of axis.

    Args:
        result: Result of ``identify``.
        device: Name of the driver.
        serial: Serial number of the unit; may be empty.
        date: Date of the measurement, as written into the file.
        duration: Time per axis in s, as written into the file.
        workspace: Workspace in m, for a device whose metres are stated by the user. The measured
            values hold only together with it.
    """
    info = result.info
    source = f"identified on {date}: {duration:g} s per axis ({', '.join(result.fits)}); {UNHELD}"
    quantities: dict[str, Quantity] = {}
    for name, (field, turns) in _FIELDS.items():
        estimate = result.of_all(field, turns=turns)
        if estimate is not None:
            quantities[name] = _quantity(estimate, source)
    if result.resolution is not None:
        quantities["resolution"] = Quantity(result.resolution, source)
    late = [
        estimate
        for turns in (False, True)
        if (estimate := result.of_all("delay", turns=turns, most=True)) is not None
    ]
    latest = max(late, key=lambda delay: delay.most)
    quantities["delay"] = replace(
        _quantity(latest, source), value=delay_of(latest, next(iter(result.runs.values())).period)
    )
    for name in ("force_limit", "torque_limit", "speed_limit"):
        quantities[name] = Quantity(float(getattr(info, name)), "from the driver, not measured")
    if info.reach is not None:
        quantities["reach"] = Quantity(info.reach, "as known before, not measured")
    if workspace is not None:
        quantities["workspace"] = Quantity(workspace, "stated or assumed when it was identified")
    return Profile(
        name=f"{info.name} {serial}".strip(),
        device=device,
        serial=serial,
        axes=info.axes,
        about="",
        quantities=quantities,
        models=(info.name,),
    )


def delay_of(estimate: Estimate, period: float) -> float:
    """Returns a measured delay in s: as whole ticks if the interval has a whole number of them.

    A device that answers a request within the tick is a tick late. Its estimate is a little more or
    less than that, and a little more would count as another whole tick.

    Args:
        estimate: The delay as estimated, in s.
        period: T in s of the loop that measured it.
    """
    whole = max(round(estimate.value / period), 0) * period
    return whole if estimate.least <= whole <= estimate.most else max(estimate.value, 0.0)


def _quantity(estimate: Estimate, source: str) -> Quantity:
    # friction and delay are not negative, but a measurement of zero may be
    value = max(estimate.value, 0.0)
    interval = min(max(estimate.least, 0.0), value), max(estimate.most, value)
    return Quantity(value, source, interval)
