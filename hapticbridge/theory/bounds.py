"""Passivity conditions between coupling, sampling period and device damping.

**Damping of the law and effective damping.** An implicit step of period T adds the damping K T to
a spring. The midpoint rule with a backward spring adds K T/2. The law's damping B' is therefore
lower than the effective damping B at the hand:

    B' = max(B − λ K T, 0),     effective: B' + λ K T,     device: b > K T/2 + B'

with λ = 1 for the compensated implicit coupling and λ = ½ for the lossless coupling. In both the
device receives the backward difference f = K e + (B'/T) δe, so eq. (6) holds with B' in place of B:

    compensated   b > B − K T/2          for B >= K T
    lossless      b > B                  for B >= K T/2

**Derivation for the lossless coupling and a free tool of mass m.** With w = z⁻¹ the law is C = K +
B'(1 − w)/T and the tool G = (T²/2m)(1 + w)/(1 − w)², so H = C/(1 + C G). The condition b > (T/2)
Re[(1 − w) H]/(1 − cos θ) is hardest at θ = π. There 1 + w = 0, a tool of any mass stands still, H =
K + 2B'/T, and the right-hand side is K T/2 + B'. At smaller θ the tool yields and less damping is
required. A wall is a tool of infinite mass.

**Derivation for the compensated coupling.** The tool is G = (T²/m)/(1 − w)². At θ = π it yields by
T²/(4m), so H = 1/(1/(K + 2B'/T) + T²/(4m)). The right-hand side is then (T/2) H, below K T/2 + B'.
At no θ does a free tool require more than a wall, and a wall requires K T/2 + B'. In contact the
lossless coupling takes the implicit form with the same B', so its condition does not change there.

**Damping that changes between ticks**, for example when a tool changes to another form in contact.
With B'_k, handle motion d_k, tool motion δx_k, e_k = e_{k−1} + d_k − δx_k and δe_k = d_k − δx_k,

    f_k (d_{k+1} − δx_k) = ½K [(e_k + d_{k+1})² − (e_{k−1} + d_k)² + δx_k² − d_{k+1}²]
                           + (B'_k/T) [(δe_k + ½(d_{k+1} − d_k))² − ¼(d_{k+1} − d_k)²]

and ¼(d_{k+1} − d_k)² <= ½(d_{k+1}² + d_k²). Summed over k, with S_0 of the environment by (14),

    Σ f_k d_{k+1} + Σ (b/T) d_k² >= −S_0 − ½K (e_0 + d_1)²    if b >= K T/2 + (B'_{k−1} + B'_k)/2

for every k. This holds for any order of values if b >= K T/2 + max B'. Changes between unequal B'
therefore create no energy and cause no instability by themselves; the device must only provide
damping for the larger B'. A device with damping for the smaller B' only is unstable in one form and
comes to rest in the other, which is a limit cycle.
"""

from __future__ import annotations

import math
from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.theory.spectrum import (
    LOWEST_ANGLE,
    needed_for_fixed_environment,
    wall_supremum,
)
from hapticbridge.theory.transfer import (
    MAX_DELAY,
    Axis,
    CouplingGrid,
    Discretization,
    SampledLaw,
    checked,
    coupling_transfer,
    plain,
    scalar,
    together,
    whole,
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
    law = SampledLaw.validated(coupling, period, discretization, delay, filter_time)
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

NEEDED_SHARE = STIFFNESS_MARGIN * (1.0 - DAMPING_SHARE) + DAMPING_SHARE
"""Share of the device's damping that a default coupling needs, 0.85, without unit. A larger share
is stiffer and leaves less for an error in b."""

RATIOS = 400
"""Number of ratios B'/K among which the default coupling of a late device is sought. Its stiffness
is flat at the best one; more only take longer."""


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

    The coupling's damper may lower this bound. ``late_minimum_damping`` has the bound for every
    environment.

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
    law = SampledLaw.validated(coupling, period, discretization, delay, filter_time, axis)
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


ANGLES_PER_RIPPLE = 400
"""Number of angles θ at which each ripple of a late device's spectrum is evaluated. The largest
value is missed by a share of at most (π/400)² = 6e-5."""


def late_minimum_damping(
    stiffness: float,
    damping: ArrayLike,
    period: float,
    delay: float = 0.0,
    ticks_per_sample: int = 1,
) -> float | NDArray[np.float64]:
    """Returns the device damping with which a coupling is passive behind a device that is late.

    The device gives a new sample every n ticks and holds one force until the next. That force acts
    a time t_d = (d + φ) n T after its sample, d whole and 0 <= φ < 1. The tool gets its force at
    once. With β = B'/T

        b >= n T max_θ [(1 − φ) sin²((d + 1)θ/2) + φ sin²((d + 2)θ/2)]
                       · [n K²/(4 sin²(θ/2)) + K β + β²] / (K/2 + β),    0 < θ <= π

    without delay   b >= n T [(n − 1) K² + y²]/(2y),    y = K + 2 B'/T
    B' = 0, n = 1   b >= K T/2 (1 + d)² for a whole number of ticks

    The returned bound is the larger one for t_d and for its whole part, and so holds for every
    constant delay up to t_d: a part of a tick may ask less of a damper than none.

    It is sufficient for every passive hand and every discrete-time passive scene, and necessary for
    a spring alone. A sample that comes sooner needs less.

    **Derivation.** The handle moves in one of n ticks. By (12) and the stored energy of the spring,
    the hand gets at most

        E <= S_0 + V_0 + Σ_j (f_j − f_{j−1−d})·δh_j − (b/nT) ‖δh_j‖² − Σ_i (K/2 + β) ‖δe_i‖²

    with j over samples and i over ticks. f_j − f_{j−1−d} is K times the sum of the δe_i between
    them plus β (δe_j − δe_{j−1−d}): a row of n filters. Its squared gain at θ is the bracket above
    times 4 sin²((d + 1)θ/2), and E <= S_0 + V_0 where that is at most 4 (K/2 + β) b/(nT).

    Args:
        stiffness: K of the law in N/m, finite and > 0.
        damping: B' of the law in N s/m, finite and >= 0; an array has many.
        period: T of the loop in s, finite and > 0.
        delay: t_d in s, 0 to 50 n T.
        ticks_per_sample: n, at least 1.

    Returns:
        The bound on b in N s/m, shaped like the damping; units of rotation alike.

    Raises:
        CouplingError: An argument is out of range.

    References:
        Brown & Colgate 1997, eq. (6), for n = 1 without delay.
    """
    k = scalar("coupling stiffness", stiffness, "N/m", positive=True)
    law_damping = checked("coupling damping", damping, "N s/m")
    period = scalar("period", period, "s", positive=True)
    n = whole("ticks per sample", ticks_per_sample, least=1)
    delayed = scalar("delay", delay, "s") / (n * period)
    if delayed > MAX_DELAY:
        raise CouplingError(f"delay is {delay:g} s; it must be at most {MAX_DELAY * n * period:g}")
    samples = int(delayed + SAME)
    part = max(delayed - samples, 0.0)
    theta = np.linspace(0.0, np.pi, ANGLES_PER_RIPPLE * (samples + 2) + 1)
    theta[0] = LOWEST_ANGLE
    ripples = np.sin(0.5 * np.outer([samples + 1, samples + 2], theta)) ** 2
    lag = np.array([[1.0, 0.0], [1.0 - part, part]]) @ ripples  # of the whole part, and of t_d
    slow = lag / np.sin(0.5 * theta) ** 2
    beta = law_damping / period
    # one by one: all at once would hold every ratio at every angle, 133 MB at a delay of 50 samples
    gain = [(0.25 * n * k**2 * slow + (k * each + each**2) * lag).max() for each in beta.flat]
    needed = n * period * np.reshape(gain, beta.shape) / (0.5 * k + beta)
    return plain(np.asarray(needed))


def stiffest_late_coupling(
    device_damping: float, period: float, delay: float, ticks_per_sample: int
) -> tuple[float, float]:
    """Returns K in N/m and B' in N s/m of the default coupling behind a device that is late.

    It is the stiffest one that needs ``NEEDED_SHARE`` of b, with B' of at least b/(4 n). For a
    device in time that is ``stiffest_coupling`` within 1 %. Behind a delay the stiffest one has
    more damping, because the damper lowers the need at low frequencies. Arguments and errors are
    those of ``late_minimum_damping``; b in N s/m must be finite and > 0.
    """
    b = scalar("device damping", device_damping, "N s/m", positive=True)
    largest = 1.0 + ticks_per_sample**0.5 + delay / period
    ratios = np.linspace(0.0, largest, RATIOS) * period  # B'/K in s
    needed = late_minimum_damping(1.0, ratios, period, delay, ticks_per_sample)
    stiffness = NEEDED_SHARE * b / np.asarray(needed)
    is_damped = ratios * stiffness >= DAMPING_SHARE * b / ticks_per_sample * (1.0 - SAME)
    best = int(np.argmax(np.where(is_damped, stiffness, 0.0)))
    return float(stiffness[best]), float(ratios[best] * stiffness[best])


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


def midpoint_damping(stiffness: float, damping: float, period: float, twist: float) -> float:
    """Returns the damping in N m s/rad that a midpoint torque needs about a twist in rad.

        b_r >= T (p + q)²/(2 (K_r + 2 B'_r/T)),    a = K_r φ/4
        p = |K_r + B'_r/T + ja|,    q = |B'_r/T + ja|

    The midpoint form K_r (φ_k + φ_{k−1})/2 differs from the law K_r φ_k + (B'_r/T) δe_k by a part
    A δe_k across the motion, ‖A‖ <= a. Summed by parts, the energy of the loop holds the term
    δe_k·Cᵀ(d_k − d_{k+1}) with C = B'_r/T + A, and its least over δe_k gives the bound. It is
    sufficient for any hand, any strict environment and any A_k, and exact for a constant A. A tool
    that does not turn needs less: K_r T/2 + √(B'_r² + (K_r T φ/4)²) at small twists.

    K_r in N m/rad, B'_r in N m s/rad and T in s must be finite, K_r and T > 0.
    """
    rate, across = damping / period, 0.25 * stiffness * twist
    sides = math.hypot(stiffness + rate, across) + math.hypot(rate, across)
    return period * sides**2 / (2.0 * (stiffness + 2.0 * rate))


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


# Damping that the integration adds

IMPLICIT_SHARE, MIDPOINT_SHARE = 1.0, 0.5
"""λ: damping that the integration adds, divided by K T, without unit. Fixed by the integration
rule."""


def law_damping(stiffness: float, effective: float, period: float, share: float) -> float:
    """Returns B' = max(B − λ K T, 0), the law's damping for an effective damping B (``effective``).

    K, B and λ must be finite and >= 0, the integration period T > 0; otherwise CouplingError is
    raised.
    """
    return max(scalar("damping", effective, "N s/m") - _added(stiffness, period, share), 0.0)


def effective_damping(stiffness: float, damping: float, period: float, share: float) -> float:
    """Returns B' + λ K T, the effective damping of a law with damping B'.

    K, B' and λ must be finite and >= 0, the integration period T > 0; otherwise CouplingError is
    raised.
    """
    return scalar("damping", damping, "N s/m") + _added(stiffness, period, share)


def largest_effective_damping(
    device_damping: float, stiffness: float, period: float, share: float
) -> float:
    """Returns the largest effective B in N s/m beside K on a device of damping b.

        B = b + (λ − ½) K T    for K T/2 <= b;  0 otherwise, because then K alone is not passive

    b must be finite and > 0; other arguments as for ``law_damping``.
    """
    available = scalar("device damping", device_damping, "N s/m", positive=True)
    per_tick = scalar("stiffness", stiffness, "N/m") * _period(period)
    if per_tick > 2 * available:
        return 0.0
    return available + (scalar("share", share, "") - 0.5) * per_tick


def _added(stiffness: float, period: float, share: float) -> float:
    return scalar("share", share) * scalar("stiffness", stiffness, "N/m") * _period(period)


def _period(period: float) -> float:
    return scalar("period", period, "s", positive=True)
