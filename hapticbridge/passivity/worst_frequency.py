"""Where in frequency a coupling asks most of a device."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.passivity.grid import Axis, CouplingGrid, plain
from hapticbridge.passivity.spectrum import needed_for_fixed_environment
from hapticbridge.passivity.transfer import Discretization, SampledLaw, coupling_transfer
from hapticbridge.passivity.wall import wall_supremum

SAME = 1e-9
"""Relative difference below which an end of the band counts as the supremum, without unit: what the
search itself resolves."""


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
        delay: d, whole samples from position to force, 0 to 50.
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
    law = SampledLaw.of(coupling, period, discretization, delay, filter_time, axis)
    k, b, period, samples, tau, is_ringing = law
    if samples == 0:
        return plain(np.full(k.shape, np.pi / period))
    # a spring alone is the same under either rule, and the backward difference is finite at Nyquist
    scheme: Discretization = "backward" if is_ringing else discretization
    top, angle = wall_supremum(k, b, period, scheme, samples, tau)
    # d T K is what the delay adds to K T/2 − B, the limit at ω → 0
    at_zero = (samples + 0.5) * k * period - b
    nyquist = np.asarray(np.pi)
    transfer = coupling_transfer(k, b, period, nyquist, scheme, tau) * (-1.0) ** samples
    at_end = needed_for_fixed_environment(transfer, period, nyquist)
    close = SAME * (k * period * (samples + 1) + b)
    angle = np.where(at_zero >= top - close, 0.0, angle)
    angle = np.where(at_end >= np.maximum(top, at_zero) - close, np.pi, angle)
    if is_ringing:
        angle = np.where(b > 0, np.pi, angle)
    return plain(np.asarray(angle / period))
