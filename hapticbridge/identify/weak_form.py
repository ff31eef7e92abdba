"""The equation of motion of one axis, averaged over windows so that nothing is differentiated.

An axis of a device that nobody holds obeys, under a force F that acts d late,

    M x'' + b x' + f_c sign(x') + c = F(t − d)

with a constant c (weight, an offset of the motor). Multiplied by a bump φ(t) that vanishes with its
derivatives at both ends of a window, and integrated by parts, it is linear in M, b, f_c and c:

    M ∫φ'' x − b ∫φ' x + f_c s ∫φ + c ∫φ = ∫φ F(t − d)

where s = ±1 is the direction of motion, so only windows are used in which the axis keeps moving one
way. F is held over each period, so its integral is exact. The integrals of x are sums over the
samples. x'' jumps at the samples, where F does; but the leading error of such a sum, of second
order in T, telescopes to nothing because x and x' are continuous: what is left is of fourth order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BUMP = Polynomial([0.0, 4.0, -4.0]) ** 6
"""φ over a window of unit length, 1 in its middle. The error that a window's ends make in a sum of
φ'' x over samples looks like damping: with the 4th power it was 0.06 % of force over speed at 40
samples a window and 1.5 % at 16, with the 6th 0.003 % and 0.17 %. Higher powers use less of a
window."""

LEAST_SAMPLES = 24
"""Periods that a window spans at least: the error above is below 0.03 % then."""

OVERLAP = 4
"""Windows begin every 1/OVERLAP of their length, without unit. More use the samples better, by
little: neighbours see the same errors. Fewer leave out what lies between."""

_PARTS = 8
"""Into how many parts of a window must each bring motion, so that a stick within is noticed."""

_SPANS = 12
"""Into how many parts of a window, over which the speed is taken for the drag. More make it of the
rounding of the position; fewer smooth it: by 0.6 % of the drag with twelve, where half a swing
fills the window."""

_MEDIAN = 0.6745  # of the size of a normal deviate, over its RMS

_ROUNDING = 0.4
"""Share of the resolution below which noise is that of rounding, which is 1/√12 = 0.29."""

_SURE = 2.0
"""Times the RMS of the difference of two means by which it must differ from zero."""

LEAST_STEPS = 6
"""Steps of resolution (of noise: √12 times its RMS, as if it were the rounding to such steps) that
a window must cross. Below, the rounding of the position is no longer small beside the motion."""


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """The equations of all windows in which an axis kept moving one way.

    Attributes:
        columns: Factors of M, b, f_c, c and of a change of d, shape (n, 5).
        right: ∫φ F(t − d), in N s, shape (n,).
        begin: First sample of each window, shape (n,).
        position: ∫φ x, in m s, shape (n,): the column of a spring.
        drag: ∫φ x' |x'|, in m²/s, shape (n,): the column of a drag that grows with speed squared.
        excess: ∫φ e(t − d), in N s, where e is what F exceeds half of its largest distance from its
            median by, shape (n,): the column of a motor that gives less than it is told.
        noise_share: Of the squares of the columns of M and b, whichever is more, what the noise and
            the rounding of the position make: by so much least squares make a number too small.
        mass_noise: RMS of what they make of the column of M, in m/s.
    """

    columns: Array
    right: Array
    begin: NDArray[np.int64]
    position: Array
    drag: Array
    excess: Array
    noise_share: float
    mass_noise: float


def windows(
    position: Array,
    force: Array,
    period: float,
    length: float,
    resolution: float,
    delay: float,
    noise: float = 0.0,
) -> Windows:
    """Returns the averaged equations of motion of a run.

    Args:
        position: x in m (or an angle in rad) at the samples, shape (n,).
        force: F in N (or N m), held from each sample to the next, shape (n,).
        period: T in s.
        length: Of a window, in s; at least ``LEAST_SAMPLES`` periods.
        resolution: Step of the position in m, 0 where it is exact.
        delay: d in s, from a write until the force acts, 0 or more.
        noise: RMS of the position's noise in m, beyond its rounding; 0: none.
    """
    count = max(round(length / period), LEAST_SAMPLES)
    length = count * period
    nodes = np.arange(count + 1) / count
    trapezoid = np.full(count + 1, period)
    trapezoid[[0, -1]] *= 0.5
    first, second = _BUMP.deriv(1)(nodes) / length, _BUMP.deriv(2)(nodes) / length**2
    late = delay / period
    held = int(np.ceil(late))  # whole periods before the window whose force still acts within it
    grid = np.arange(-held, count + 1)
    # F(t − d) of sample k acts from (k + late) T to (k + 1 + late) T: the bump's area in between
    inside = np.clip((grid + late) / count, 0.0, 1.0)
    weight = np.diff(_BUMP.integ()(inside)) * length
    slope = np.diff(_BUMP(inside))  # ∫φ' over the same spans
    area = float(_BUMP.integ()(1.0)) * length
    step = max(count // OVERLAP, 1)
    begin = np.arange(held, len(position) - count, step)
    x = np.lib.stride_tricks.sliding_window_view(position, count + 1)[begin]
    # a force that bears a weight is always large: its excess would be the force itself
    swing = force - np.median(force)
    half = 0.5 * float(np.abs(swing).max())
    excess = np.sign(swing) * np.maximum(np.abs(swing) - half, 0.0)
    f, e = (
        np.lib.stride_tricks.sliding_window_view(values, count + held)[begin - held]
        for values in (force, excess)
    )
    trembling = math.sqrt(noise**2 + resolution**2 / 12.0)
    direction = _direction(x, trembling)
    moves = direction != 0.0
    x, f, e = x[moves], f[moves], e[moves]
    begin, direction = begin[moves], direction[moves]
    x = x - x[:, :1]  # ∫φ' and ∫φ'' vanish: only rounding depends on where the window lies
    of_mass, of_damping = trapezoid * second, -trapezoid * first
    columns = np.stack(
        [
            x @ of_mass,
            x @ of_damping,
            direction * area,
            np.full(len(begin), area),
            -(f @ slope),
        ],
        axis=1,
    )
    bump = _BUMP(nodes) * trapezoid
    absolute = position[begin] * area + x @ bump
    # what noise and rounding make of the two columns, RMS
    made = trembling * np.linalg.norm([of_mass, of_damping], axis=1)
    squares = np.mean(columns[:, :2] ** 2, axis=0) if len(begin) else np.ones(2)
    share = float(np.max(made**2 / np.maximum(squares, 1e-300)))
    # speed over a span between samples, which lies in the span's middle
    span = max(count // _SPANS, 1)
    speed = (x[:, span:] - x[:, :-span]) / (span * period)
    middle = (np.arange(count + 1 - span) + 0.5 * span) / count
    drag = (speed * np.abs(speed)) @ (_BUMP(middle) * period)
    return Windows(columns, f @ weight, begin, absolute, drag, e @ weight, share, float(made[0]))


def noise_of(position: Array, resolution: float) -> float:
    """Returns the RMS of a position's noise in m, 0 where it is no more than that of its rounding.

    Sixth differences leave nothing of a smooth motion, and of white noise its RMS times √924. Their
    median is taken, so that the few ticks in which friction turns round count for nothing.

    Args:
        position: x in m at the samples, shape (n,); NaN where there is none.
        resolution: Step of the position in m, 0 where it is exact.
    """
    differences = np.diff(position, 6)
    differences = differences[np.isfinite(differences)]
    if not len(differences):
        return 0.0
    noise = float(np.median(np.abs(differences))) / (_MEDIAN * np.sqrt(924.0))
    return noise if noise > _ROUNDING * resolution + 1e-9 else 0.0


def _direction(x: Array, trembling: float) -> Array:
    """Returns ±1 where a window keeps moving one way, 0 where it does not.

    The mean of each of its parts must go that way, by more than noise and rounding would move it:
    single steps may go back, as they do where joints with encoders make a position in space.
    """
    edges = np.linspace(0, x.shape[1], _PARTS + 1).astype(np.int64)
    lengths = np.diff(edges)
    steps = np.diff(np.add.reduceat(x, edges[:-1], axis=1) / lengths, axis=1)
    margin = _SURE * trembling * np.sqrt(2.0 / lengths.min())
    is_long = np.abs(x[:, -1] - x[:, 0]) >= LEAST_STEPS * np.sqrt(12.0) * trembling
    up, down = (steps > margin).all(axis=1), (steps < -margin).all(axis=1)
    return np.where(is_long, up.astype(np.float64) - down.astype(np.float64), 0.0)
