"""Supremum over frequency of the damping that a delayed coupling requires against a wall."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hapticbridge.passivity.spectrum import needed_for_fixed_environment
from hapticbridge.passivity.transfer import Discretization, coupling_transfer

_Array = NDArray[np.float64]

POINTS_PER_RIPPLE = 16
"""Grid points per ripple of the spectrum, which has d + 1 ripples, without unit. The golden section
that follows needs every maximum bracketed. More points only take longer."""

LOWEST_ANGLE = 1e-6
"""θ in rad at which the search starts. The spectrum is even in θ, so its limit at 0 is missed by a
share of about (d θ)² and (τθ/T)². That is 1e-9 up to a delay or low-pass of 30 samples."""

POINTS_PER_SEGMENT = 8
"""Grid cells that share one refinement, without unit: half a ripple, which has one maximum."""

GOLDEN_STEPS = 32
"""Golden-section steps, without unit: 0.618^32 = 2e-7 of a grid cell. The spectrum is flat at its
top, so the value there is exact to 1e-15 of itself. More steps would only compare rounding."""

BATCH = 100_000
"""Values computed at once: about a megabyte, and enough that the overhead of NumPy calls is
negligible."""

_RATIO = (np.sqrt(5) - 1) / 2


def wall_supremum(
    stiffness: _Array,
    damping: _Array,
    period: float,
    scheme: Discretization,
    delay: int,
    filter_time: float,
) -> tuple[_Array, _Array]:
    """Returns the supremum over 0 < θ <= π of (T/2) Re{(1 − e^{−jθ}) C e^{−jdθ}} / (1 − cos θ).

    The grid is even in θ and, with a low-pass, also in log θ down to its corner. The best cell of
    every half ripple is refined by golden section, because ripples can be equally high. The
    discretization (``scheme``) must be finite at Nyquist.

    Returns:
        The supremum in N s/m, and the θ in rad of its first occurrence, to about 1e-7.
    """
    grid = search_grid(delay, filter_time / period)
    # indices of the points of each segment; neighbouring segments share their ends
    firsts = np.arange(0, grid.size - 1, POINTS_PER_SEGMENT)
    points = np.minimum(firsts[:, None] + np.arange(POINTS_PER_SEGMENT + 1), grid.size - 1)
    batch = max(1, BATCH // max(1, stiffness.size * points.shape[1]))
    # one axis for the segments of a batch
    k, b = stiffness[..., None], damping[..., None]

    def needed(theta: _Array) -> _Array:
        more = (1,) * (theta.ndim - k.ndim)
        transfer = coupling_transfer(
            k.reshape(k.shape + more), b.reshape(b.shape + more), period, theta, scheme, filter_time
        )
        delayed = transfer * np.exp(-1j * delay * theta)
        return needed_for_fixed_environment(delayed, period, theta)

    best = np.full(stiffness.shape, -np.inf)
    place = np.full(stiffness.shape, grid[0])
    for first in range(0, len(points), batch):
        values, angles = _refined(needed, grid, points[first : first + batch], k.shape[:-1])
        highest = values.argmax(axis=-1)[..., None]
        value, angle = (
            np.take_along_axis(array, highest, -1)[..., 0] for array in (values, angles)
        )
        place = np.where(value > best, angle, place)
        best = np.maximum(best, value)
    return best, place


def search_grid(delay: int, lag: float) -> _Array:
    """Returns the grid of angles in rad, ascending, that brackets the maxima; ``lag`` is τ/T."""
    grid = np.linspace(LOWEST_ANGLE, np.pi, POINTS_PER_RIPPLE * (delay + 1) + 1)
    # Start at a hundredth of the corner, but stay a factor of two away from both ends of the
    # first cell: points crowded there could differ by rounding alone.
    corner = max(1e-2 / lag, 2.0 * LOWEST_ANGLE) if lag > 0 else np.inf
    if corner < 0.5 * grid[1]:
        low = np.geomspace(corner, grid[1], POINTS_PER_RIPPLE)
        grid = np.concatenate([grid[:1], low[:-1], grid[1:]])
    return grid


def _refined(
    needed: Callable[[_Array], _Array],
    grid: _Array,
    points: NDArray[np.intp],
    shape: tuple[int, ...],
) -> tuple[_Array, _Array]:
    """Returns the largest value around the best grid point of each segment, and its θ."""
    index = (1,) * len(shape)
    theta = np.broadcast_to(grid[points], (*index, *points.shape))
    at_points = needed(theta)
    top = at_points.argmax(axis=-1)
    best = np.take_along_axis(at_points, top[..., None], -1)[..., 0]
    middle = points[np.arange(len(points)), top]
    place = grid[middle]
    lower = grid[np.maximum(middle - 1, 0)]
    upper = grid[np.minimum(middle + 1, grid.size - 1)]
    width = _RATIO * (upper - lower)
    left, right = upper - width, lower + width
    at_left, at_right = needed(left), needed(right)
    for _ in range(GOLDEN_STEPS):
        rising = at_right > at_left
        lower, upper = np.where(rising, left, lower), np.where(rising, upper, right)
        width = _RATIO * (upper - lower)
        # one of the two inner points is kept, the other is new
        fresh = np.where(rising, lower + width, upper - width)
        value = needed(fresh)
        left, right = np.where(rising, right, fresh), np.where(rising, fresh, left)
        at_left, at_right = (
            np.where(rising, at_right, value),
            np.where(rising, value, at_left),
        )
    for value, inner in ((at_left, left), (at_right, right)):
        better = value > best
        best, place = np.where(better, value, best), np.where(better, inner, place)
    return best, place
