"""Weak form of the equation of motion of one axis."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BUMP = Polynomial([0.0, 4.0, -4.0]) ** 6
"""Bump φ over a window of unit length, 1 in its middle. The ends of a window cause an error in sums
of φ'' x that resembles damping. With the 4th power it was 0.06 % of force over speed at 40 samples
a window and 1.5 % at 16; with the 6th 0.003 % and 0.17 %. Higher powers use less of a window."""

LEAST_SAMPLES = 24
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

LEAST_STEPS = 6
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


def windows(
    position: Array,
    force: Array,
    period: float,
    length: float,
    resolution: float,
    delay: float,
    noise: float = 0.0,
) -> Windows:
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
        position: x in m (or an angle in rad) at the samples, shape (n,).
        force: F in N (or N m), held from each sample to the next, shape (n,).
        period: T in s.
        length: Length of a window in s; at least ``LEAST_SAMPLES`` periods.
        resolution: Step of the position in m, 0 if it is exact.
        delay: d in s, from a write until the force acts, >= 0.
        noise: RMS of the position's noise in m, beyond its rounding; 0: none.
    """
    count = max(round(length / period), LEAST_SAMPLES)
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
    trembling = math.sqrt(noise**2 + resolution**2 / 12.0)
    direction = _direction(x, trembling)
    moves = direction != 0.0
    x, f, e = x[moves], f[moves], e[moves]
    begin, direction = begin[moves], direction[moves]
    x = x - x[:, :1]  # ∫φ' and ∫φ'' vanish, so the offset only adds rounding
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
    is_long = np.abs(x[:, -1] - x[:, 0]) >= LEAST_STEPS * np.sqrt(12.0) * trembling
    up, down = (steps > margin).all(axis=1), (steps < -margin).all(axis=1)
    return np.where(is_long, up.astype(np.float64) - down.astype(np.float64), 0.0)
