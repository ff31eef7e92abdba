"""Least-squares fit of mass, damping, friction and delay of one axis, with intervals."""

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

LEAST_WINDOWS = 60
"""Smallest number of windows: five in each of ``BLOCKS``. Fewer do not show their scatter."""

MOST_NOISE = 0.005
"""Largest usable ``noise_share``, without unit. Below it all intervals grow by its share of the
applied force. With 0.03, one good motor in thirty was reported as saturated."""

DELAY_ERROR = 1e-5
"""Half-width in s added to every delay, for errors common to all parts of a run: a hundredth of a
tick at 1 kHz."""

MOST_DELAY = 0.02
"""Largest delay in s of the search. A device with more delay is of no use for haptics."""

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
    best: AxisFit | None = None
    for length in LENGTHS:
        fitted = _fitted(position, force, period, stretch(period) * length, resolution, noise)
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
        law.append(found.position)  # without it, a weak cable would reduce the fitted mass
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
    # an underestimate of the mass attributes that share of the force to damping and friction
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
    """Returns the factors of the last columns, which belong to effects beyond the ordinary law."""
    stacked = np.column_stack(columns)
    found = zip(solved(stacked, right), half_widths(stacked, right), strict=True)
    return [Estimate(float(value), float(half)) for value, half in found][-count:]


def _unseen(columns: Array, found: Windows, least: float) -> float:
    """Returns the additional lower width of b due to a drag too small to be significant."""
    bent = np.column_stack([columns, found.drag])
    value = solved(bent, found.right)[_DAMPING] - half_widths(bent, found.right)[_DAMPING]
    return max(least - float(value), 0.0)
