"""Device damping required at each frequency, for any transfer function.

Notation: θ = ωT, u = 1 − e^{−jθ}. Because u / (1 − cos θ) = 1 + j cot(θ/2), both conditions need
only the real and imaginary parts of a transfer function and cot(θ/2). They lose no digits at low
frequency.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.arguments import LARGEST, shown
from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.theory.transfer import (
    ROUNDING,
    CouplingGrid,
    Discretization,
    SampledLaw,
    angles,
    late_by,
    plain,
    scalar,
)

Transfer = Callable[[NDArray[np.complex128]], Any]
"""Transfer function of z, from the handle's position in m to the force in N."""


def needed_for_any_environment(
    transfer: NDArray[np.complex128], period: float, theta: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns (T/2)(1 − cos θ) / Re{(1 − e^{−jθ})/C}; inf where the real part is not positive.

    This is the requirement for the worst hand together with the worst discrete-time passive
    environment behind the coupling.

    References:
        Brown & Colgate 1997, eq. (2).
    """
    power = transfer.real + transfer.imag / np.tan(theta / 2)
    size = np.abs(transfer) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        needed = period / 2 * size / power
    # a coupling without force requires no damping
    return np.where(size == 0, 0.0, np.where(power > 0, needed, np.inf))


def needed_for_fixed_environment(
    transfer: NDArray[np.complex128], period: float, theta: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns (T/2) Re{(1 − e^{−jθ}) H} / (1 − cos θ) for a response H at the device.

    References:
        Colgate & Schenkel 1997, necessary and sufficient for any passive hand.
    """
    needed: NDArray[np.float64] = period / 2 * (transfer.real - transfer.imag / np.tan(theta / 2))
    return needed


def needed_behind_delay(
    transfer: Callable[[NDArray[np.float64]], NDArray[np.complex128]],
    period: float,
    theta: NDArray[np.float64],
    delay: float,
    count: int = 1,
) -> NDArray[np.float64]:
    """Returns the requirement for any environment of a device that is late, in N s/m.

        max{ s_d, (1 − φ) s_d + φ s_{d+1} } Σ_i b(ψ_i)/sin²(ψ_i/2),    s_d = sin²((d + 1)θ/2)

    b(ψ) is that of ``needed_for_any_environment`` at ψ_i = (θ + 2πi)/n, i = 0 … n − 1. The force
    acts (d + φ) n T after its sample, d whole and 0 <= φ < 1, and is held for n T.

    Args:
        transfer: C in N/m as a function of ψ in rad.
        period: T in s.
        theta: θ in rad per sample.
        delay: d + φ in samples.
        count: n in ticks per sample.
    """
    samples = int(delay + ROUNDING)
    part = max(delay - samples, 0.0)
    first, second = (np.sin(0.5 * (samples + i) * theta) ** 2 for i in (1, 2))
    lag = np.maximum(first, (1.0 - part) * first + part * second)
    total: NDArray[np.float64] = np.zeros(())
    for i in range(count):
        psi = (theta + 2.0 * np.pi * i) / count
        needed = needed_for_any_environment(transfer(psi), period, psi)
        total = total + needed / np.sin(0.5 * psi) ** 2
    needed_late: NDArray[np.float64] = lag * total
    return needed_late


def damping_spectrum(
    coupling: Coupling | CouplingGrid,
    period: float,
    frequency: ArrayLike,
    *,
    discretization: Discretization = "backward",
    delay: float = 0.0,
    filter_time: float = 0.0,
) -> NDArray[np.float64]:
    """Returns the device damping that a coupling requires at each frequency, for any environment.

        b(ω) = (T/2) [1 − cos((d + 1) ωT)] / Re{(1 − e^{−jωT}) / C(e^{jωT})}

    ``minimum_damping`` is the supremum over 0 < ω <= π/T; its arguments and errors apply here, as
    does its form for a part of a tick. For a wall, ``SampledLoop.damping_spectrum`` has it.

    Returns:
        b in N s/m, shape S + F for couplings of shape S and frequencies ω in
        rad/s of shape F; inf where none suffices.

    References:
        Brown & Colgate 1997, eqs. (2), (4), (5), for d = 0.
    """
    law = SampledLaw.validated(coupling, period, discretization, delay, filter_time)
    theta = angles(frequency, law.period)
    theta = theta.reshape((1,) * law.stiffness.ndim + theta.shape)
    needed = needed_behind_delay(law.transfer, law.period, theta, law.delay)
    if law.rings:
        # tan(π/2) is finite in floating point; the limit at Nyquist is not
        is_damped = law.damping.reshape(law.damping.shape + (1,) * (theta.ndim - law.damping.ndim))
        needed = np.where((theta == np.pi) & (is_damped > 0), np.inf, needed)
    return needed


def damping_spectrum_of(
    transfer: Transfer, period: float, frequency: ArrayLike, *, delay: float = 0.0
) -> float | NDArray[np.float64]:
    """Returns the device damping that any coupling requires at each frequency.

        b(ω) = (T/2) [1 − cos((d + 1) ωT)] / Re{(1 − e^{−jωT}) / C(e^{jωT})}

    The result holds for every passive hand and every discrete-time passive environment, if C is
    stable but for the pole of its spring at z = 1, and C(1) is not negative.

    Args:
        transfer: C from h − x in m to the force on the tool in N: a function of an array of
            complex z; of a ``scipy.signal`` system ``lambda z: np.polyval(num, z) / np.polyval(den,
            z)``.
        period: T in s, finite and > 0.
        frequency: ω in rad/s, 0 < ω <= π/T, any shape.
        delay: d in ticks from a sample to its force on the device, as for ``minimum_damping``.

    Returns:
        b in N s/m, shaped like the frequency; inf where no damping suffices.

    Raises:
        CouplingError: An argument is out of range, or C is not finite at a frequency.

    References:
        Brown & Colgate 1997, eq. (2), for d = 0.
    """
    period = scalar("period", period, "s", positive=True)
    delay = late_by(delay)
    theta = angles(frequency, period)
    if not callable(transfer):
        raise CouplingError(f"transfer is {shown(transfer)}; it must be a callable of z")
    value = transfer(np.exp(1j * theta))
    try:
        returned = np.asarray(value)
    except (TypeError, ValueError):  # for example rows of different lengths
        returned = np.empty(0, dtype=object)
    if returned.dtype.kind not in "iufc":
        raise CouplingError(f"transfer returned {shown(value)}; it must return numbers in N/m")
    response: NDArray[np.complex128] = returned.astype(np.complex128)
    if response.shape not in {(), theta.shape}:
        raise CouplingError(
            f"transfer returned shape {response.shape}; it must have z's shape {theta.shape}"
        )
    if not (np.abs(response) <= LARGEST**2).all():
        raise CouplingError("the transfer function is not finite at one of the frequencies")
    return plain(needed_behind_delay(lambda _: response, period, theta, delay))


# Supremum over frequency of the damping that a delayed coupling requires

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


def wall_supremum(law: SampledLaw) -> tuple[_Array, _Array]:
    """Returns the supremum over 0 < θ <= π of (T/2) Re{(1 − e^{−jθ}) C e^{−jdθ}} / (1 − cos θ).

    The discretization must be finite at Nyquist, and the delay whole. Results are those of
    ``supremum``.
    """

    def needed(theta: _Array) -> _Array:
        delayed = law.transfer(theta) * np.exp(-1j * law.delay * theta)
        return needed_for_fixed_environment(delayed, law.period, theta)

    return supremum(needed, law, 1)


def supremum(
    needed: Callable[[_Array], _Array], law: SampledLaw, count: int
) -> tuple[_Array, _Array]:
    """Returns the supremum of a spectrum over 0 < θ <= π, for each coupling of a law.

    The grid is even in θ and, with a low-pass, also in log θ down to its corner. The best cell of
    every half ripple is refined by golden section, because ripples can be equally high.

    Args:
        needed: The spectrum, of θ with the axes of the coupling and further ones.
        law: The law; its shape, delay and low-pass count.
        count: n in ticks per sample.

    Returns:
        The supremum in N s/m, and the θ in rad of its first occurrence, to about 1e-7.
    """
    shape, held = law.stiffness.shape, count * law.period
    samples = math.ceil(law.delay / count - ROUNDING)
    grid = search_grid(samples, law.filter_time / held)
    # indices of the points of each segment; neighbouring segments share their ends
    firsts = np.arange(0, grid.size - 1, POINTS_PER_SEGMENT)
    points = np.minimum(firsts[:, None] + np.arange(POINTS_PER_SEGMENT + 1), grid.size - 1)
    batch = max(1, BATCH // max(1, law.stiffness.size * points.shape[1]))
    best = np.full(shape, -np.inf)
    place = np.full(shape, grid[0])
    for first in range(0, len(points), batch):
        values, angles = _refined(needed, grid, points[first : first + batch], shape)
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
        at_left, at_right = (np.where(rising, at_right, value), np.where(rising, value, at_left))
    for value, inner in ((at_left, left), (at_right, right)):
        better = value > best
        best, place = np.where(better, value, best), np.where(better, inner, place)
    return best, place
