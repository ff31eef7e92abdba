"""Least-squares fit of mass, damping, friction and delay of one axis, with intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from scipy.stats import t as student

from hapticbridge.errors import IdentificationError
from hapticbridge.identify.excitation import stretch

# Least squares with jackknife intervals

CONFIDENCE = 0.95
"""Probability, without unit, that the true value lies within the interval."""

BLOCKS = 12
"""Number of parts of the run, left out in turn to measure the scatter of the result. With more, a
part would be shorter than the slowest swing and no longer independent."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its interval of ``CONFIDENCE``.

    Attributes:
        value: Estimate in SI units.
        half_width: Largest excess of the true value over ``value``, in the unit of ``value``.
        below: Additional lower width of the interval, >= 0. It covers effects too small to be
            detected that would make the true value smaller.
    """

    value: float
    half_width: float
    below: float = 0.0

    @property
    def least(self) -> float:
        """Lower end of the interval."""
        return self.value - self.half_width - self.below

    @property
    def most(self) -> float:
        """Upper end of the interval."""
        return self.value + self.half_width

    @property
    def is_seen(self) -> bool:
        """Significance: true if the interval excludes zero."""
        return self.least > 0.0 or self.most < 0.0

    def as_text(self) -> str:
        """Returns the value and its interval as text, rounded to the significant digits.

        A significant value has a digit more where its rounded interval would reach zero.
        """
        value, up, down = self.value, self.half_width, self.half_width + self.below
        for digits in (1, 2, 3):
            rounded = value
            if up > 0.0:
                rounded = round(value, digits - 1 - math.floor(math.log10(up))) + 0.0  # no −0
            ends = f"{up:.{digits}g}", f"{down:.{digits}g}"
            if not self.is_seen or float(ends[value > 0.0]) < abs(rounded):
                break
        return (
            f"{rounded:.4g} ± {ends[0]}" if up == down else f"{rounded:.4g} +{ends[0]} −{ends[1]}"
        )


def solved(columns: Array, right: Array) -> Array:
    """Returns the least-squares solution x, shape (k,), of columns · x = right."""
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    return np.asarray(np.linalg.lstsq(columns / scale, right, rcond=None)[0] / scale)


def half_widths(columns: Array, right: Array) -> Array:
    """Returns the half-widths of the least-squares solution by a jackknife over ``BLOCKS`` parts.

    The rows, at least ``BLOCKS``, are in the order of time. The only assumption is that distant
    rows have independent errors.

    References:
        Efron & Stein 1981, *The jackknife estimate of variance*.
    """
    block = np.arange(len(right)) * BLOCKS // len(right)
    without = np.array([solved(columns[block != j], right[block != j]) for j in range(BLOCKS)])
    spread = np.sum((without - without.mean(axis=0)) ** 2, axis=0) * (BLOCKS - 1) / BLOCKS
    return np.asarray(np.sqrt(spread) * student.ppf(0.5 + 0.5 * CONFIDENCE, BLOCKS - 1))


# Identified parameters of one device axis


@dataclass(frozen=True, slots=True)
class AxisFit:
    """Identified parameters of one device axis.

    Attributes:
        mass: M in kg (rotation: kg m²).
        damping: b in N s/m (N m s/rad).
        friction: Coulomb friction f_c in N (N m).
        offset: Constant force c in N (N m): weight, or an offset of the motor.
        delay: Time in s from a write to its effect in a sample, beyond the hold.
        spring: Stiffness k in N/m (N m/rad) that explains the remainder, as of a hand or a cable.
        drag: b_2 in N s²/m² (N m s²/rad²) of a drag b_2 v |v| beside b v, as of oil. It belongs to
            the law if its interval excludes zero.
        drag_speed: Speed v in m/s (rad/s) at which ``damping`` is taken, as (b v + b_2 v |v|)/v. It
            is chosen so that ``damping`` is the smallest over the observed speeds: 0, or the
            largest speed if b_2 < 0.
        lost_gain: Share of the force above half of its maximum that had no effect, without unit: 0
            for a good motor, 1 for one that saturates there.
        unexplained: RMS force in N (N m) left by the law and by the position's noise and rounding.
        force: RMS of the applied force in N (N m).
        window: Length of the windows in s.
        count: Number of windows.
    """

    mass: Estimate
    damping: Estimate
    friction: Estimate
    offset: Estimate
    delay: Estimate
    spring: Estimate
    drag: Estimate
    drag_speed: float
    lost_gain: Estimate
    unexplained: float
    force: float
    window: float
    count: int

    def resistance(self, speed: Array) -> Array:
        """Returns b v + b_2 v |v| + f_c sign(v) in N (N m), with b_2 only if it is significant."""
        bend = self.drag.value * (np.abs(speed) - self.drag_speed) if self.drag.is_seen else 0.0
        return np.asarray(
            (self.damping.value + bend) * speed + self.friction.value * np.sign(speed)
        )


# Weak form of the equation of motion of one axis

_BUMP = Polynomial([0.0, 4.0, -4.0]) ** 6
"""Bump φ over a window of unit length, 1 in its middle. The ends of a window cause an error in sums
of φ'' x that resembles damping. With the 4th power it was 0.06 % of force over speed at 40 samples
a window and 1.5 % at 16; with the 6th 0.003 % and 0.17 %. Higher powers use less of a window."""

MIN_SAMPLES = 24
"""Smallest number of periods in a window. The error of the sums is then below 0.03 %
(``_BUMP``)."""

OVERLAP = 4
"""Number of windows that begin within one window length. More use the samples slightly better,
because neighbours share their errors. Fewer skip part of the run."""

_PARTS = 8
"""Number of parts of a window that must all show motion, so that sticking inside it is detected."""

_SPANS = 12
"""Number of parts of a window over which the speed is taken for the drag. More amplify the rounding
of the position. Fewer smooth the drag: by 0.6 % with twelve, if half a swing fills the window."""

_MEDIAN = 0.6745
"""Median magnitude of a normal deviate divided by its RMS, without unit."""

_ROUNDING = 0.4
"""Largest noise that counts as rounding, as a share of the resolution, without unit. Rounding gives
1/√12 = 0.29."""

_SURE = 2.0
"""Multiple of its own RMS by which a difference of two means must exceed zero, without unit."""

MIN_STEPS = 6
"""Smallest number of steps of resolution that a window must cross. Noise counts as a step of √12
times its RMS. Below this number rounding is no longer small beside the motion."""


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Equations of all windows in which an axis keeps one direction of motion.

    Attributes:
        columns: Factors of M, b, f_c, c and of a change of d, shape (n, 5).
        right: ∫φ F(t − d), in N s, shape (n,).
        begin: First sample of each window, shape (n,).
        position: ∫φ x, in m s, shape (n,): the column of a spring.
        drag: ∫φ x' |x'|, in m²/s, shape (n,): the column of a drag that grows with speed squared.
        excess: ∫φ e(t − d), in N s, shape (n,): the column of a saturating motor. e is the part of
            F above half of its largest distance from its median.
        noise_share: Share of the position's noise and rounding in the squares of the columns of M
            and b, the larger of the two. Least squares underestimate the factor by this share.
        mass_noise: RMS of noise and rounding in the column of M, in m/s.
    """

    columns: Array
    right: Array
    begin: NDArray[np.int64]
    position: Array
    drag: Array
    excess: Array
    noise_share: float
    mass_noise: float


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """Motion of an axis under a force.

    Attributes:
        position: x in m (or an angle in rad) at the samples, shape (n,); NaN without a sample.
        force: F in N (or N m), held from each sample to the next, shape (n,).
        period: T in s.
        resolution: Step of the position in m, 0 if it is exact.
        noise: RMS of the position's noise in m, beyond its rounding; 0: none.
    """

    position: Array
    force: Array
    period: float
    resolution: float
    noise: float


def windows(trace: Trace, length: float, delay: float) -> Windows:
    """Returns the equation of motion of a run, averaged over windows without differentiation.

    A free axis under a force F that acts with a delay d obeys

        M x'' + b x' + f_c sign(x') + c = F(t − d)

    with a constant c (weight, an offset of the motor). It is multiplied by a bump φ(t) that
    vanishes with its derivatives at both ends of a window. Integration by parts then gives an
    equation that is linear in M, b, f_c and c:

        M ∫φ'' x − b ∫φ' x + f_c s ∫φ + c ∫φ = ∫φ F(t − d)

    s = ±1 is the direction of motion, so only windows with one direction are used. F is held over
    each period, so its integral is exact. The integrals of x are sums over the samples. x'' jumps
    at the samples together with F. The leading error of such a sum, of second order in T,
    nevertheless telescopes to zero, because x and x' are continuous. The remaining error is of
    fourth order.

    Args:
        trace: The run.
        length: Length of a window in s; at least ``MIN_SAMPLES`` periods.
        delay: d in s, from a write until the force acts, >= 0.
    """
    position, force, period = trace.position, trace.force, trace.period
    count = max(round(length / period), MIN_SAMPLES)
    length = count * period
    nodes = np.arange(count + 1) / count
    trapezoid = np.full(count + 1, period)
    trapezoid[[0, -1]] *= 0.5
    first, second = _BUMP.deriv(1)(nodes) / length, _BUMP.deriv(2)(nodes) / length**2
    late = delay / period
    held = int(np.ceil(late))  # periods before the window whose force acts within it
    grid = np.arange(-held, count + 1)
    # F(t − d) of sample k acts from (k + late) T to (k + 1 + late) T: the bump's area in between
    inside = np.clip((grid + late) / count, 0.0, 1.0)
    weight = np.diff(_BUMP.integ()(inside)) * length
    slope = np.diff(_BUMP(inside))  # ∫φ' over the same spans
    area = float(_BUMP.integ()(1.0)) * length
    step = max(count // OVERLAP, 1)
    begin = np.arange(held, len(position) - count, step)
    x = np.lib.stride_tricks.sliding_window_view(position, count + 1)[begin]
    # remove a constant weight first; otherwise the excess would be the force itself
    swing = force - np.median(force)
    half = 0.5 * float(np.abs(swing).max())
    excess = np.sign(swing) * np.maximum(np.abs(swing) - half, 0.0)
    f, e = (
        np.lib.stride_tricks.sliding_window_view(values, count + held)[begin - held]
        for values in (force, excess)
    )
    trembling = math.sqrt(trace.noise**2 + trace.resolution**2 / 12.0)
    direction = _direction(x, trembling)
    moves = direction != 0.0
    x, f, e = x[moves], f[moves], e[moves]
    begin, direction = begin[moves], direction[moves]
    x = x - x[:, :1]  # ∫φ' and ∫φ'' vanish, so the offset only adds rounding
    of_mass, of_damping = trapezoid * second, -trapezoid * first
    columns = np.stack(
        [x @ of_mass, x @ of_damping, direction * area, np.full(len(begin), area), -(f @ slope)],
        axis=1,
    )
    bump = _BUMP(nodes) * trapezoid
    absolute = position[begin] * area + x @ bump
    # RMS of noise and rounding in the two columns
    column_noise = trembling * np.linalg.norm([of_mass, of_damping], axis=1)
    squares = np.mean(columns[:, :2] ** 2, axis=0) if len(begin) else np.ones(2)
    share = float(np.max(column_noise**2 / np.maximum(squares, 1e-300)))
    # the mean speed over a span belongs to the span's middle
    span = max(count // _SPANS, 1)
    speed = (x[:, span:] - x[:, :-span]) / (span * period)
    middle = (np.arange(count + 1 - span) + 0.5 * span) / count
    drag = (speed * np.abs(speed)) @ (_BUMP(middle) * period)
    return Windows(
        columns, f @ weight, begin, absolute, drag, e @ weight, share, float(column_noise[0])
    )


def noise_of(position: Array, resolution: float) -> float:
    """Returns the RMS of a position's noise, 0 if rounding to ``resolution`` explains it.

    Sixth differences remove a smooth motion and multiply the RMS of white noise by √924. Their
    median ignores the few ticks in which friction reverses.
    """
    differences = np.diff(position, 6)
    differences = differences[np.isfinite(differences)]
    if not len(differences):
        return 0.0
    noise = float(np.median(np.abs(differences))) / (_MEDIAN * np.sqrt(924.0))
    return noise if noise > _ROUNDING * resolution + 1e-9 else 0.0


def _direction(x: Array, trembling: float) -> Array:
    """Returns ±1 for windows that keep one direction, 0 for others.

    The means of successive parts must all move that way, by more than noise and rounding. Single
    steps may go back, as joint encoders make them do in Cartesian space.
    """
    edges = np.linspace(0, x.shape[1], _PARTS + 1).astype(np.int64)
    lengths = np.diff(edges)
    steps = np.diff(np.add.reduceat(x, edges[:-1], axis=1) / lengths, axis=1)
    margin = _SURE * trembling * np.sqrt(2.0 / lengths.min())
    is_long = np.abs(x[:, -1] - x[:, 0]) >= MIN_STEPS * np.sqrt(12.0) * trembling
    up, down = (steps > margin).all(axis=1), (steps < -margin).all(axis=1)
    return np.where(is_long, up.astype(np.float64) - down.astype(np.float64), 0.0)


Array = NDArray[np.float64]

METHOD_ERROR = 0.001
"""Half-width, relative to the value, added to every mass, damping and friction, without unit. It
covers errors that shift all parts of a run together, which the jackknife cannot detect, beyond the
position's rounding and noise (``noise_share``). Measured on 40 simulated devices in runs of a
minute, which average out random errors. The mass was off by 0.07 % at most, and by 0.005 % more
than the rest of its interval; friction by 0.05 % of the force; damping by 0.01 % (median)."""

SUM_ERROR = 3e-4
"""Half-width, relative to force over speed (RMS), added to every damping, without unit. It covers
the part of the mass that the sums attribute to damping. Without it a device without damping was
reported with 0.0012 ± 0.00001 N s/m."""

LENGTHS = (0.04, 0.06, 0.09, 0.13, 0.2)
"""Trial lengths of windows in s; the length with the narrowest interval is used. In short windows
the position's rounding dominates; long ones find too few stretches in one direction. Loops below
333 Hz stretch them (``stretch``)."""

MIN_WINDOWS = 60
"""Smallest number of windows: five in each of ``BLOCKS``. Fewer do not show their scatter."""

MAX_NOISE = 0.005
"""Largest usable ``noise_share``, without unit. Below it all intervals grow by its share of the
applied force. With 0.03, one good motor in thirty was reported as saturated."""

DELAY_ERROR = 1e-5
"""Half-width in s added to every delay, for errors common to all parts of a run: a hundredth of a
tick at 1 kHz."""

MAX_DELAY = 0.04
"""Largest delay in s of the search, which stops there. With 1.5 N s/m a device with more bears less
than 40 N/m."""

_ROUNDS = 12
"""Largest number of iterations of the search for the delay; each solves anew at the last result."""

_MASS, _DAMPING, _FRICTION, _OFFSET, _DELAY = range(5)


def fit_axis(position: Array, force: Array, period: float, resolution: float = 0.0) -> AxisFit:
    """Fits M x'' + b x' + f_c sign(x') + c = F(t − d) to a run.

    The windows (``windows``) are solved by least squares; d is adjusted until the factor of its own
    column vanishes. The intervals come from a jackknife over the parts of the run
    (``half_widths``), ``METHOD_ERROR`` and ``SUM_ERROR``.

    A spring k x and a drag b_2 x' |x'| join the law if they are significant. A drag that is not
    significant extends the interval of b downwards by its possible effect, because the guarantee
    relies on b at small speeds.

    Args:
        position: x in m (or rad) at the samples, shape (n,); NaN without a sample.
        force: F in N (or N m), held from each sample to the next, shape (n,).
        period: T in s.
        resolution: Step of the position in m, 0 if it is exact.

    Raises:
        IdentificationError: The axis hardly moved, never moved long enough in one direction, or its
            position is too noisy.

    References:
        Shinbrot 1957, *On the analysis of linear and nonlinear systems* (modulating functions).
    """
    noise = noise_of(position, resolution)
    trace = Trace(position, force, period, resolution, noise)
    best: AxisFit | None = None
    for length in LENGTHS:
        fitted = _fitted(trace, stretch(period) * length)
        if fitted is not None and (best is None or _width(fitted) < _width(best)):
            best = fitted
    if best is not None:
        return best
    if noise > 0.0:
        raise IdentificationError(
            f"its position has a noise of {noise:.2g} (RMS, m or rad), too much for so small a "
            "motion; allow more travel or more force, or remove the source of the noise"
        )
    raise IdentificationError(
        "it never moved long enough in one direction to separate mass from damping; allow more "
        "travel, more force or more time"
    )


def _width(fit: AxisFit) -> float:
    """Returns the uncertainty of a fit: the intervals of M and b relative to their values."""
    return sum((e.most - e.least) / max(abs(e.value), 1e-12) for e in (fit.mass, fit.damping))


def _fitted(trace: Trace, length: float) -> AxisFit | None:
    def usable_at(delay: float) -> Windows | None:
        usable = windows(trace, length, delay)
        is_usable = len(usable.begin) >= MIN_WINDOWS and usable.noise_share <= MAX_NOISE
        return usable if is_usable else None

    delay, usable = 0.0, usable_at(0.0)
    for _ in range(_ROUNDS):
        if usable is None:
            return None
        change = solved(usable.columns, usable.right)[_DELAY]
        before, delay = delay, float(np.clip(delay + change, 0.0, MAX_DELAY))
        usable = usable_at(delay)
        if abs(delay - before) < 1e-9:
            break
    if usable is None:
        return None
    area = usable.columns[0, _OFFSET]
    speeds = usable.columns[:, _DAMPING]
    spring, drag = _last(2, [usable.columns, usable.position, usable.drag], usable.right)
    law = [usable.columns]
    if spring.is_seen:
        law.append(usable.position)  # without it, a weak cable would reduce the fitted mass
    unbent, drag_speed = np.column_stack(law), 0.0
    if drag.is_seen:
        if drag.value < 0.0:
            drag_speed = float(np.abs(speeds).max()) / area
        law.append(usable.drag - drag_speed * speeds)
    columns = np.column_stack(law)
    values, error = solved(columns, usable.right), half_widths(columns, usable.right)
    rest = (usable.right - columns @ values) / area
    trembling = float(values[_MASS]) * usable.mass_noise / area

    applied = float(np.sqrt(np.mean((usable.right / area) ** 2)))
    # an underestimate of the mass attributes that share of the force to damping and friction
    taken = usable.noise_share * applied
    sums = (SUM_ERROR * applied + taken) / float(np.sqrt(np.mean((speeds / area) ** 2)))
    mass, damping, friction, offset = (float(value) for value in values[:_DELAY])
    return AxisFit(
        mass=Estimate(mass, float(error[_MASS]) + (METHOD_ERROR + usable.noise_share) * abs(mass)),
        damping=Estimate(
            damping,
            float(error[_DAMPING]) + METHOD_ERROR * abs(damping) + sums,
            0.0 if drag.is_seen else _unseen(unbent, usable, damping - float(error[_DAMPING])),
        ),
        friction=Estimate(friction, float(error[_FRICTION]) + METHOD_ERROR * applied + taken),
        offset=Estimate(offset, float(error[_OFFSET])),
        delay=Estimate(delay, float(error[_DELAY]) + DELAY_ERROR),
        spring=spring,
        drag=drag,
        drag_speed=drag_speed,
        lost_gain=_last(1, [*law, usable.excess], usable.right)[0],
        unexplained=float(np.sqrt(max(np.mean(rest**2) - trembling**2, 0.0))),
        force=applied,
        window=length,
        count=len(usable.begin),
    )


def _last(count: int, columns: list[Array], right: Array) -> list[Estimate]:
    """Returns the factors of the last columns, which belong to effects beyond the ordinary law."""
    stacked = np.column_stack(columns)
    estimates = zip(solved(stacked, right), half_widths(stacked, right), strict=True)
    return [Estimate(float(value), float(half)) for value, half in estimates][-count:]


def _unseen(columns: Array, windows: Windows, least: float) -> float:
    """Returns the additional lower width of b due to a drag too small to be significant."""
    bent = np.column_stack([columns, windows.drag])
    value = solved(bent, windows.right)[_DAMPING] - half_widths(bent, windows.right)[_DAMPING]
    return max(least - float(value), 0.0)
