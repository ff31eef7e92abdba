"""Mass, damping, friction and delay of one axis from a recorded run, with what is known of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import IdentificationError
from hapticbridge.identify.axis_fit import AxisFit
from hapticbridge.identify.estimate import Estimate, half_widths, solved
from hapticbridge.identify.excitation import stretch
from hapticbridge.identify.weak_form import Windows, noise_of, windows

Array = NDArray[np.float64]

METHOD_ERROR = 0.001
"""Half-width, relative to the value, that is added to every mass, damping and friction: what shifts
all parts of a run together, which leaving parts out cannot see, beyond what the position's rounding
and noise explain (``noise_share``). Measured on 40 simulated devices in runs of a minute, where
chance has averaged out: mass was off by 0.07 % at most, and by 0.005 % more than the rest of its
interval; friction by 0.05 % of the force; damping by 0.01 % (median)."""

SUM_ERROR = 3e-4
"""Half-width, relative to force over speed (RMS), that is added to every damping: what the sums
make of a mass. Without it a device of no damping was given 0.0012 ± 0.00001 N s/m."""

LENGTHS = (0.04, 0.06, 0.09, 0.13, 0.2)
"""Lengths of windows in s that are tried; that with the narrowest result is taken. Short ones
drown in the rounding of the position, long ones find too few stretches in one direction. Loops
below 333 Hz stretch them (``stretch``)."""

LEAST_WINDOWS = 60
"""Five in each of ``BLOCKS``: fewer say nothing of how much they differ."""

MOST_NOISE = 0.005
"""Largest ``noise_share`` that is worth a result. Below, all intervals grow by what it takes from
the applied force. With 0.03, one good motor in thirty was taken for a saturated one."""

DELAY_ERROR = 1e-5
"""Half-width in s that is added to every delay, for the same reason: a hundredth of a tick."""

MOST_DELAY = 0.02
"""In s. A device later than this cannot be felt through."""

_ROUNDS = 12
"""Of the search for the delay at most; each solves anew at the delay that the last one found."""

_MASS, _DAMPING, _FRICTION, _OFFSET, _DELAY = range(5)


def fit_axis(position: Array, force: Array, period: float, resolution: float = 0.0) -> AxisFit:
    """Fits M x'' + b x' + f_c sign(x') + c = F(t − d) to a run.

    Least squares over the windows of ``weak_form``; d is moved until its own column vanishes. The
    intervals come from leaving out each part of the run in turn (``half_widths``), and from
    ``METHOD_ERROR`` and ``SUM_ERROR``. A spring k x and a drag b_2 x' |x'| are tried too, and join
    the law where they are seen; a drag that is not seen lowers the lower end of b by what it could
    be, because b of small speeds is what the guarantee takes.

    Args:
        position: x in m (or rad) at the samples, shape (n,); NaN where there is none.
        force: F in N (or N m), held from each sample to the next, shape (n,).
        period: T in s.
        resolution: Step of the position in m, 0 where it is exact.

    Raises:
        IdentificationError: The axis hardly moved, or never long enough in one direction, or the
            position is too noisy.

    References:
        Shinbrot 1957, *On the analysis of linear and nonlinear systems* (modulating functions).
    """
    noise = noise_of(position, resolution)
    best: AxisFit | None = None
    for length in LENGTHS:
        fitted = _fitted(position, force, period, stretch(period) * length, resolution, noise)
        if fitted is not None and (best is None or _width(fitted) < _width(best)):
            best = fitted
    if best is not None:
        return best
    if noise > 0.0:
        raise IdentificationError(
            f"its position trembles by {noise:.2g} (RMS, m or rad), too much for so small a "
            "motion; allow more travel or more force, or find what disturbs the position"
        )
    raise IdentificationError(
        "it never moved long enough in one direction to tell mass from damping; allow more "
        "travel, more force or more time"
    )


def _width(fit: AxisFit) -> float:
    """Returns how uncertain a fit is: the intervals of M and b relative to their values."""
    return sum((e.most - e.least) / max(abs(e.value), 1e-12) for e in (fit.mass, fit.damping))


def _fitted(
    position: Array, force: Array, period: float, length: float, resolution: float, noise: float
) -> AxisFit | None:
    def found_at(delay: float) -> Windows | None:
        found = windows(position, force, period, length, resolution, delay, noise)
        is_usable = len(found.begin) >= LEAST_WINDOWS and found.noise_share <= MOST_NOISE
        return found if is_usable else None

    delay, found = 0.0, found_at(0.0)
    for _ in range(_ROUNDS):
        if found is None:
            return None
        change = solved(found.columns, found.right)[_DELAY]
        before, delay = delay, float(np.clip(delay + change, 0.0, MOST_DELAY))
        found = found_at(delay)
        if abs(delay - before) < 1e-9:
            break
    if found is None:
        return None
    area = found.columns[0, _OFFSET]
    speeds = found.columns[:, _DAMPING]
    spring, drag = _last(2, [found.columns, found.position, found.drag], found.right)
    law = [found.columns]
    if spring.is_seen:
        law.append(found.position)  # a weak cable, or it would be taken for less mass
    unbent, drag_speed = np.column_stack(law), 0.0
    if drag.is_seen:
        if drag.value < 0.0:
            drag_speed = float(np.abs(speeds).max()) / area
        law.append(found.drag - drag_speed * speeds)
    columns = np.column_stack(law)
    values, error = solved(columns, found.right), half_widths(columns, found.right)
    rest = (found.right - columns @ values) / area
    trembling = float(values[_MASS]) * found.mass_noise / area

    applied = float(np.sqrt(np.mean((found.right / area) ** 2)))
    # a mass that is too small by a share leaves that share of the force to damping and friction
    taken = found.noise_share * applied
    sums = (SUM_ERROR * applied + taken) / float(np.sqrt(np.mean((speeds / area) ** 2)))
    mass, damping, friction, offset = (float(value) for value in values[:_DELAY])
    return AxisFit(
        mass=Estimate(mass, float(error[_MASS]) + (METHOD_ERROR + found.noise_share) * abs(mass)),
        damping=Estimate(
            damping,
            float(error[_DAMPING]) + METHOD_ERROR * abs(damping) + sums,
            0.0 if drag.is_seen else _unseen(unbent, found, damping - float(error[_DAMPING])),
        ),
        friction=Estimate(friction, float(error[_FRICTION]) + METHOD_ERROR * applied + taken),
        offset=Estimate(offset, float(error[_OFFSET])),
        delay=Estimate(delay, float(error[_DELAY]) + DELAY_ERROR),
        spring=spring,
        drag=drag,
        drag_speed=drag_speed,
        lost_gain=_last(1, [*law, found.excess], found.right)[0],
        unexplained=float(np.sqrt(max(np.mean(rest**2) - trembling**2, 0.0))),
        force=applied,
        window=length,
        count=len(found.begin),
    )


def _last(count: int, columns: list[Array], right: Array) -> list[Estimate]:
    """Returns the factors of the last columns: of what an ordinary device does not have."""
    stacked = np.column_stack(columns)
    found = zip(solved(stacked, right), half_widths(stacked, right), strict=True)
    return [Estimate(float(value), float(half)) for value, half in found][-count:]


def _unseen(columns: Array, found: Windows, least: float) -> float:
    """Returns how much farther down b may lie because of a drag that is too small to be seen."""
    bent = np.column_stack([columns, found.drag])
    value = solved(bent, found.right)[_DAMPING] - half_widths(bent, found.right)[_DAMPING]
    return max(least - float(value), 0.0)
