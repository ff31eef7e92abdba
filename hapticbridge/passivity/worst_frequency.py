"""Where in frequency a coupling asks most of a device."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.passivity.bounds import minimum_damping
from hapticbridge.passivity.grid import (
    Axis,
    CouplingGrid,
    plain,
    scalar,
    spring_and_damper,
    whole,
)
from hapticbridge.passivity.spectrum import (
    Discretization,
    coupling_transfer,
    needed_for_fixed_environment,
)

CELLS_PER_RIPPLE = 16
"""Cells per ripple of a delayed spectrum, which has d + 1 of them, without unit. The golden section
that follows needs each maximum bracketed; more only takes longer."""

LOWEST_ANGLE = 1e-6
"""θ in rad at which the search starts; a maximum below it counts as the limit at 0."""

GOLDEN_STEPS = 40
"""Golden-section steps: 0.618^40 = 4e-9 of a cell, about what a flat top lets one resolve."""

SAME = 1e-9
"""Relative difference below which an end of the band counts as the supremum, without unit: what the
search itself resolves."""

_RATIO = (np.sqrt(5) - 1) / 2


def worst_frequency(
    coupling: Coupling | CouplingGrid,
    period: float,
    *,
    discretization: Discretization = "backward",
    delay: int = 0,
    filter_time: float = 0.0,
    axis: Axis = "translation",
) -> float | NDArray[np.float64]:
    """Returns the frequency at which the supremum of ``damping_spectrum`` is attained.

    Without a delay it is Nyquist's, π/T, for every coupling (a spring alone asks for the same at
    all frequencies; π/T stands for them). With a delay, against a wall, a soft damper leaves
    it at low frequency and a strong one moves it towards π/((d + 1) T) and its odd multiples.

    Args:
        coupling: K and B; a ``CouplingGrid`` for many at once.
        period: T in s, finite and > 0.
        discretization: Of the damper.
        delay: d, whole samples from position to force.
        filter_time: τ in s of a first-order low-pass behind the damper, >= 0.
        axis: Which pair of K and B is asked for.

    Returns:
        ω in rad/s, shaped like the coupling: 0.0 where the supremum is the limit for ω → 0, π/T
        where it is attained at Nyquist or infinite there. Accurate to about 1e-7 of π/T: the
        spectrum is flat at its top. Of several equal maxima any one.

    Raises:
        CouplingError: An argument is out of range or unknown.

    References:
        Brown & Colgate 1997, eqs. (6), (7); Colgate & Schenkel 1997 (wall).
    """
    period = scalar("period", period, "s", positive=True)
    tau = scalar("filter time", filter_time, "s")
    samples = whole("delay", delay)
    highest = minimum_damping(
        CouplingGrid(*spring_and_damper(coupling, axis)),
        period,
        discretization=discretization,
        delay=samples,
        filter_time=tau,
    )
    k, b = spring_and_damper(coupling, axis)
    nyquist = np.pi / period
    if samples == 0:
        return plain(np.full(k.shape, nyquist))
    unbounded = np.isinf(highest)
    # a spring alone is the same under either rule, and the backward difference is finite at Nyquist
    scheme: Discretization = "tustin" if discretization == "tustin" and tau > 0 else "backward"
    stiffness, damping = k[..., None], b[..., None]

    def needed(theta: NDArray[np.float64]) -> NDArray[np.float64]:
        transfer = coupling_transfer(stiffness, damping, period, theta, scheme, tau)
        return needed_for_fixed_environment(transfer * np.exp(-1j * samples * theta), period, theta)

    grid = np.linspace(LOWEST_ANGLE, np.pi, CELLS_PER_RIPPLE * (samples + 1) + 1)
    if tau > 0:
        corner = max(min(1e-2 * period / tau, grid[1]), LOWEST_ANGLE)
        grid = np.union1d(grid, np.geomspace(corner, grid[1], CELLS_PER_RIPPLE))
    lower, upper = (
        np.broadcast_to(side, (*k.shape, grid.size - 2)) for side in (grid[:-2], grid[2:])
    )
    for _ in range(GOLDEN_STEPS):
        width = _RATIO * (upper - lower)
        rising = needed(lower + width) > needed(upper - width)
        lower, upper = (
            np.where(rising, upper - width, lower),
            np.where(rising, upper, lower + width),
        )
    theta = (lower + upper) / 2
    value = needed(theta)
    best = value.argmax(axis=-1)[..., None]
    top = np.take_along_axis(value, best, -1)[..., 0]
    angle = np.take_along_axis(theta, best, -1)[..., 0]
    # d T K is what the delay adds to K T/2 − B, the limit at ω → 0
    at_zero = (samples + 0.5) * k * period - b
    ends = needed(np.array([np.pi]))[..., 0]
    close = SAME * (k * period * (samples + 1) + b)
    angle = np.where(at_zero >= top - close, 0.0, angle)
    angle = np.where(ends >= np.maximum(top, at_zero) - close, np.pi, angle)
    return plain(np.asarray(np.where(unbounded, np.pi, angle) / period))
