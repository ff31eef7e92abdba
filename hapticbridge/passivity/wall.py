"""The supremum over frequency of what a delayed coupling against a wall needs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hapticbridge.passivity.spectrum import needed_for_fixed_environment

_Array = NDArray[np.float64]

POINTS_PER_RIPPLE = 16
"""Grid points per ripple of the spectrum, which has d + 1 of them, without unit. The golden section
that follows needs each maximum bracketed; more only takes longer."""

LOWEST_ANGLE = 1e-6
"""θ in rad at which the search starts. The spectrum is even in θ, so its limit at 0 is missed by a
share of about (d θ)² and (τθ/T)²: 1e-9 up to a delay or low-pass of 30 samples."""

POINTS_PER_SEGMENT = 8
"""Grid cells that share one refinement, without unit: half a ripple, which has one maximum."""

GOLDEN_STEPS = 44
"""Golden-section steps: 0.618^44 = 6e-10 of a grid cell, beyond which θ does not matter for a
maximum in double precision."""

_RATIO = (np.sqrt(5) - 1) / 2


def wall_supremum(
    transfer: Callable[[_Array, _Array, _Array], NDArray[np.complex128]],
    stiffness: _Array,
    damping: _Array,
    period: float,
    delay: int,
    filter_time: float,
) -> _Array:
    """Returns the supremum over 0 < θ <= π of (T/2) Re{(1 − e^{−jθ}) C e^{−jdθ}} / (1 − cos θ).

    The grid is even in θ and, with a low-pass, also in log θ down to its corner. The best cell of
    every half ripple is then refined by golden section, because ripples can be equally high.

    Args:
        transfer: C(K, B, θ) without the delay.
        stiffness: K in N/m.
        damping: B in N s/m, of the same shape.
        period: T in s.
        delay: d in samples.
        filter_time: τ in s.
    """

    def needed(theta: _Array) -> _Array:
        delayed = transfer(stiffness, damping, theta) * np.exp(-1j * delay * theta)
        return needed_for_fixed_environment(delayed, period, theta)

    grid = np.linspace(LOWEST_ANGLE, np.pi, POINTS_PER_RIPPLE * (delay + 1) + 1)
    if filter_time > 0:
        corner = min(1e-2 * period / filter_time, grid[1])
        low = np.geomspace(max(corner, LOWEST_ANGLE), grid[1], POINTS_PER_RIPPLE)
        grid = np.union1d(grid, low)
    best = np.full(stiffness.shape, -np.inf)
    for first in range(0, grid.size - 1, POINTS_PER_SEGMENT):
        segment = range(first, min(first + POINTS_PER_SEGMENT + 1, grid.size))
        best = np.maximum(best, _refined(needed, grid, segment, stiffness.shape))
    return best


def _refined(
    needed: Callable[[_Array], _Array], grid: _Array, segment: range, shape: tuple[int, ...]
) -> _Array:
    """Returns the largest value around the best grid point of a segment, by golden section."""
    best = np.full(shape, -np.inf)
    lower, upper = np.full(shape, grid[0]), np.full(shape, grid[0])
    for i in segment:
        value = needed(grid[i])
        better = value > best
        best = np.where(better, value, best)
        lower = np.where(better, grid[max(i - 1, 0)], lower)
        upper = np.where(better, grid[min(i + 1, grid.size - 1)], upper)
    for _ in range(GOLDEN_STEPS):
        width = _RATIO * (upper - lower)
        left, right = upper - width, lower + width
        at_left, at_right = needed(left), needed(right)
        best = np.maximum(best, np.maximum(at_left, at_right))
        rising = at_right > at_left
        lower, upper = np.where(rising, left, lower), np.where(rising, upper, right)
    return best
