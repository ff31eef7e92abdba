"""Frequency at which a coupling requires the most device damping."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.passivity.grid import Axis, CouplingGrid, plain
from hapticbridge.passivity.spectrum import needed_for_fixed_environment
from hapticbridge.passivity.transfer import Discretization, SampledLaw, coupling_transfer
from hapticbridge.passivity.wall import wall_supremum

SAME = 1e-9
"""Relative difference, without unit, below which an end of the band counts as the supremum: the
resolution of the search."""


def worst_frequency(
    coupling: Coupling | CouplingGrid,
    period: float,
    *,
    discretization: Discretization = "backward",
    delay: int = 0,
    filter_time: float = 0.0,
    axis: Axis = "translation",
) -> float | NDArray[np.float64]:
    """Returns the frequency at which ``damping_spectrum`` reaches its supremum.

    Without a delay it is Nyquist's, π/T, for every coupling; the spectrum of a spring alone is
    flat. With a delay, against a wall, a soft damper leaves it at low frequency. A strong damper
    moves it towards π/((d + 1) T) and its odd multiples. Arguments, errors and sources are those of
    ``minimum_damping``.

    Returns:
        ω in rad/s, shaped like the coupling: 0.0 if the supremum is the limit for ω → 0, π/T if it
        is reached at Nyquist or infinite there. Accurate to about 1e-7 of π/T, because the spectrum
        is flat at its top. Of several equal maxima any one.
    """
    law = SampledLaw.of(coupling, period, discretization, delay, filter_time, axis)
    k, b, period, samples, tau, is_ringing = law
    if samples == 0:
        return plain(np.full(k.shape, np.pi / period))
    # both rules agree for a spring alone, and the backward difference is finite at Nyquist
    scheme: Discretization = "backward" if is_ringing else discretization
    top, angle = wall_supremum(k, b, period, scheme, samples, tau)
    # limit at ω → 0: K T/2 − B plus d T K for the delay
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
