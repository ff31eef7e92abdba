"""Mass, damping, friction and delay of one axis from a recorded run, with what is known of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from hapticbridge.errors import IdentificationError
from hapticbridge.identify.weak_form import Windows, windows

Array = NDArray[np.float64]

CONFIDENCE = 0.95
"""Probability, without unit, that the true value lies within value ± half_width."""

BLOCKS = 12
"""Parts of the run that are left out in turn to see how much the result depends on them. More would
be shorter than the slowest swing, and then no longer independent."""

METHOD_ERROR = 0.004
"""Half-width, relative to the value, that is added to every mass, damping and friction: what the
windows' sums and the rounding of the position can shift all parts of a run together, which leaving
parts out cannot see. Largest seen over 400 simulated devices: 0.3 %."""

SUM_ERROR = 3e-4
"""Half-width, relative to force over speed (RMS), that is added to every damping: what the sums
make of a mass. Without it a device of no damping was given 0.0012 ± 0.00001 N s/m."""

LENGTHS = (0.04, 0.06, 0.09, 0.13, 0.2)
"""Lengths of windows in s that are tried; that with the narrowest result is taken. Short ones
drown in the rounding of the position, long ones find too few stretches in one direction."""

LEAST_WINDOWS = 60
"""Five in each of ``BLOCKS``: fewer say nothing of how much they differ."""

DELAY_ERROR = 1e-5
"""Half-width in s that is added to every delay, for the same reason: a hundredth of a tick."""

MOST_DELAY = 0.02
"""In s. A device later than this cannot be felt through."""

_ROUNDS = 12
_MASS, _DAMPING, _FRICTION, _OFFSET, _DELAY = range(5)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its interval of ``CONFIDENCE``.

    Attributes:
        value: In SI units.
        half_width: The true value lies within value ± half_width, in the same unit.
    """

    value: float
    half_width: float

    @property
    def least(self) -> float:
        """Lower end of the interval."""
        return self.value - self.half_width

    @property
    def most(self) -> float:
        """Upper end of the interval."""
        return self.value + self.half_width

    def told(self) -> str:
        """Returns the value and its half-width, without digits that the half-width makes void."""
        value = self.value
        if self.half_width > 0.0:
            value = round(value, -math.floor(math.log10(self.half_width))) + 0.0  # no −0
        return f"{value:.4g} ± {self.half_width:.1g}"


@dataclass(frozen=True, slots=True)
class AxisFit:
    """What a run tells of one axis.

    Attributes:
        mass: M in kg (rotation: kg m²).
        damping: b in N s/m (N m s/rad).
        friction: Coulomb friction f_c in N (N m).
        offset: Constant force c in N (N m): weight, or an offset of the motor.
        delay: From a write until it shows in a sample, beyond the hold, in s.
        spring: Stiffness k in N/m (N m/rad) that would explain the rest: a hand, a cable.
        lost_gain: Share of the force above half of the largest that did not act, without unit: 0
            for a good motor, 1 for one that saturates there.
        unexplained: RMS of the force that the law does not explain, in N (N m).
        force: RMS of the force that was applied, in N (N m).
        window: Length of the windows used, in s.
        count: How many there were.
    """

    mass: Estimate
    damping: Estimate
    friction: Estimate
    offset: Estimate
    delay: Estimate
    spring: Estimate
    lost_gain: Estimate
    unexplained: float
    force: float
    window: float
    count: int


def fit_axis(position: Array, force: Array, period: float, resolution: float = 0.0) -> AxisFit:
    """Fits M x'' + b x' + f_c sign(x') + c = F(t − d) to a run.

    Least squares over the windows of ``weak_form``; d is moved until its own column vanishes. The
    intervals come from leaving out each of ``BLOCKS`` parts of the run in turn (jackknife), which
    asks nothing of the errors but that distant parts do not share them, and from
    ``METHOD_ERROR`` and ``SUM_ERROR``.

    Args:
        position: x in m (or rad) at the samples, shape (n,).
        force: F in N (or N m), held from each sample to the next, shape (n,).
        period: T in s.
        resolution: Step of the position in m, 0 where it is exact.

    Raises:
        IdentificationError: The axis hardly moved, or never long enough in one direction.

    References:
        Shinbrot 1957, *On the analysis of linear and nonlinear systems* (modulating functions);
        Efron & Stein 1981, *The jackknife estimate of variance*.
    """
    best: AxisFit | None = None
    for length in LENGTHS:
        fitted = _fitted(position, force, period, length, resolution)
        if fitted is not None and (best is None or _width(fitted) < _width(best)):
            best = fitted
    if best is None:
        raise IdentificationError(
            "it never moved long enough in one direction to tell mass from damping; allow more "
            "travel, more force, more time or a higher rate"
        )
    return best


def _width(fit: AxisFit) -> float:
    """Returns how uncertain a fit is: the half-widths of M and b relative to their values."""
    return sum(e.half_width / max(abs(e.value), 1e-12) for e in (fit.mass, fit.damping))


def _fitted(
    position: Array, force: Array, period: float, length: float, resolution: float
) -> AxisFit | None:
    delay = 0.0
    for _ in range(_ROUNDS):
        found = windows(position, force, period, length, resolution, delay)
        if len(found.begin) < LEAST_WINDOWS:
            return None
        change = _solved(found.columns, found.right)[_DELAY]
        before, delay = delay, float(np.clip(delay + change, 0.0, MOST_DELAY))
        if abs(delay - before) < 1e-9:
            break
    found = windows(position, force, period, length, resolution, delay)
    if len(found.begin) < LEAST_WINDOWS:
        return None
    spring = _suspect(found, found.position)
    # a weak cable is left in the law, or it would be taken for less mass
    is_pulled = abs(spring.value) > spring.half_width
    columns = np.column_stack([found.columns, found.position]) if is_pulled else found.columns
    values = _solved(columns, found.right)
    error = _jackknife(columns, found.right)
    area = found.columns[0, _OFFSET]
    rest = (found.right - columns @ values) / area

    applied = float(np.sqrt(np.mean((found.right / area) ** 2)))
    speed = float(np.sqrt(np.mean((columns[:, _DAMPING] / area) ** 2)))
    sums = SUM_ERROR * applied / speed
    mass, damping, friction, offset = (float(value) for value in values[:_DELAY])
    return AxisFit(
        mass=Estimate(mass, float(error[_MASS]) + METHOD_ERROR * abs(mass)),
        damping=Estimate(damping, float(error[_DAMPING]) + METHOD_ERROR * abs(damping) + sums),
        friction=Estimate(friction, float(error[_FRICTION]) + METHOD_ERROR * applied),
        offset=Estimate(offset, float(error[_OFFSET])),
        delay=Estimate(delay, float(error[_DELAY]) + DELAY_ERROR),
        spring=spring,
        lost_gain=_suspect(found, found.excess),
        unexplained=float(np.sqrt(np.mean(rest**2))),
        force=applied,
        window=length,
        count=len(found.begin),
    )


def _suspect(found: Windows, column: Array) -> Estimate:
    """Returns the factor of a column that a free device with a good motor does not have."""
    scale = float(np.abs(column).max())
    if scale == 0.0:
        return Estimate(0.0, 0.0)
    columns = np.column_stack([found.columns, column])
    value = _solved(columns, found.right)[-1]
    return Estimate(float(value), float(_jackknife(columns, found.right)[-1]))


def _solved(columns: Array, right: Array) -> Array:
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    return np.asarray(np.linalg.lstsq(columns / scale, right, rcond=None)[0] / scale)


def _jackknife(columns: Array, right: Array) -> Array:
    """Returns the half-widths that leaving out each part of the windows in turn shows."""
    block = np.arange(len(right)) * BLOCKS // len(right)
    without = np.array([_solved(columns[block != j], right[block != j]) for j in range(BLOCKS)])
    spread = np.sum((without - without.mean(axis=0)) ** 2, axis=0) * (BLOCKS - 1) / BLOCKS
    return np.asarray(np.sqrt(spread) * student.ppf(0.5 + 0.5 * CONFIDENCE, BLOCKS - 1))
