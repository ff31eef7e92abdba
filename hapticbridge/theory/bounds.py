"""Passivity conditions between coupling, sampling period and device damping."""

from __future__ import annotations

from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.theory.spectrum import needed_for_fixed_environment, wall_supremum
from hapticbridge.theory.transfer import (
    Axis,
    CouplingGrid,
    Discretization,
    SampledLaw,
    checked,
    coupling_transfer,
    plain,
    scalar,
    together,
)

# Frequency at which a coupling requires the most device damping

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
    law = SampledLaw.of(coupling, period, discretization, delay, filter_time)
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


STIFFNESS_MARGIN = 0.8
"""Stiffness of a default coupling divided by the largest passive stiffness, without unit. The rest
covers what is uncertain about a device: its true damping, friction and timing. A value nearer to 1
feels stiffer and leaves less margin."""

DAMPING_SHARE = 0.25
"""Damping of a default coupling divided by the device's damping, without unit. A larger value damps
the tool better against the handle and leaves less stiffness, because K ∝ b − B."""


@overload
def minimum_damping(
    coupling: Coupling,
    period: float,
    *,
    discretization: Discretization = ...,
    delay: int = ...,
    filter_time: float = ...,
    axis: Axis = ...,
) -> float: ...


@overload
def minimum_damping(
    coupling: CouplingGrid,
    period: float,
    *,
    discretization: Discretization = ...,
    delay: int = ...,
    filter_time: float = ...,
    axis: Axis = ...,
) -> float | NDArray[np.float64]: ...


def minimum_damping(
    coupling: Coupling | CouplingGrid,
    period: float,
    *,
    discretization: Discretization = "backward",
    delay: int = 0,
    filter_time: float = 0.0,
    axis: Axis = "translation",
) -> float | NDArray[np.float64]:
    """Returns the least device damping with which a coupling is passive.

        backward     b >= K T/2 + B'                     low-passed: K T/2 + B' T/(T + 2τ)
        tustin       b >= K T/2 for B' = 0, else inf     low-passed: K T/2 + B' T/(2τ)

    B' is the damping of the law, the ``damping`` of the coupling given here. At equality the device
    loses nothing and gains nothing; the paper states the condition with >.

    Without a delay the bound is necessary. It is sufficient for any passive hand and any
    environment that is discrete-time passive (14). With a low-pass, sufficiency is shown for linear
    hands and environments only.

    With a delay of d samples the bound holds against a **wall**, that is for a tool that does not
    move:

        b >= (K T/2) sin((2d + 1)θ/2)/sin(θ/2) − B' cos((d + 1)θ)  for all θ;  B' = 0: K (T/2 + d T)

    The coupling's damper may lower this bound. For a *general* environment behind a delayed
    coupling no damping suffices, so no bound exists (see ``damping_spectrum_of`` of C z⁻ᵈ).

    Args:
        coupling: K, B' and their rotational counterparts; a ``CouplingGrid`` has many of them.
        period: T in s, finite and > 0: duration for which the device holds a wrench.
        discretization: Rule that takes the damper's velocity from sampled positions.
        delay: d, whole samples from position to force, 0 to 50.
        filter_time: τ in s, >= 0, of a first-order low-pass behind the damper, discretised by the
            same rule.
        axis: Kind of axis, which selects the pair of K and B'.

    Returns:
        The bound on b in N s/m (rotation: N m s/rad), shaped like the coupling. It is inf for
        Tustin's damper without low-pass at any delay, because its gain at Nyquist is infinite.

    Raises:
        CouplingError: An argument is out of range, or the axis or discretization is unknown.

    References:
        Brown & Colgate 1997, eqs. (6), (7); Colgate & Schenkel 1997 (wall).
    """
    law = SampledLaw.of(coupling, period, discretization, delay, filter_time, axis)
    stiffness, damping, period, delay, filter_time, unbounded = law
    if delay:
        # without low-pass, Tustin's bound is finite only for B' = 0, where both rules agree
        rule: Discretization = "backward" if unbounded else discretization
        needed, _ = wall_supremum(stiffness, damping, period, rule, delay, filter_time)
    else:
        if unbounded:
            share = 1.0
        elif discretization == "tustin":
            share = period / (2 * filter_time)
        else:
            share = period / (period + 2 * filter_time)
        needed = stiffness * period / 2 + damping * share
    if unbounded:
        needed = np.where(damping > 0, np.inf, needed)
    return plain(np.asarray(needed))


@overload
def maximum_stiffness(device_damping: float, period: float, damping: float = 0.0) -> float: ...


@overload
def maximum_stiffness(
    device_damping: ArrayLike, period: ArrayLike, damping: ArrayLike = 0.0
) -> float | NDArray[np.float64]: ...


def maximum_stiffness(
    device_damping: ArrayLike, period: ArrayLike, damping: ArrayLike = 0.0
) -> float | NDArray[np.float64]:
    """Returns the largest passive stiffness, K = 2 (b − B') / T, in N/m.

    The stiffness of a coupling must not be above it. b in N s/m and T in s must be finite and > 0,
    and 0 <= B' < b; otherwise CouplingError is raised, because for B' >= b no stiffness is passive.
    Arrays broadcast.

    References:
        Brown & Colgate 1997, eq. (6) solved for K.
    """
    available, step, spent = together(
        device_damping=checked("device damping", device_damping, "N s/m", positive=True),
        period=checked("period", period, "s", positive=True),
        coupling_damping=checked("coupling damping", damping, "N s/m"),
    )
    if (spent >= available).any():
        worst = np.argmax(spent - available)
        raise CouplingError(
            f"coupling damping {spent.flat[worst]:g} N s/m is not below the device's "
            f"{available.flat[worst]:g} N s/m, so no stiffness is passive; lower the damping"
        )
    return plain(2 * (available - spent) / step)


def stiffest_coupling(damping: float, rotational_damping: float, period: float) -> Coupling:
    """Returns the default coupling of a device: 80 % of the largest stiffness at B = b/4.

        B = b / 4,    K = 0.8 · 2 (b − B) / T        for translation and for rotation

    The device's b in N s/m and N m s/rad, as seen in the scene (divided by scale · force scale),
    and T in s must be finite and > 0; otherwise CouplingError is raised.
    """
    damping = scalar("device damping", damping, "N s/m", positive=True)
    rotational_damping = scalar("device damping", rotational_damping, "N m s/rad", positive=True)
    translation, rotation = DAMPING_SHARE * damping, DAMPING_SHARE * rotational_damping
    return Coupling(
        stiffness=STIFFNESS_MARGIN * maximum_stiffness(damping, period, translation),
        damping=translation,
        rotational_stiffness=STIFFNESS_MARGIN
        * maximum_stiffness(rotational_damping, period, rotation),
        rotational_damping=rotation,
    )
