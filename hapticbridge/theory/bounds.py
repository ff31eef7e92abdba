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
from collections.abc import Callable
from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.theory.spectrum import (
    LOWEST_ANGLE,
    needed_behind_delay,
    supremum,
    wall_supremum,
)
from hapticbridge.theory.transfer import (
    CouplingGrid,
    Discretization,
    SampledLaw,
    checked,
    delayed_by,
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
    delay: float = 0.0,
    filter_time: float = 0.0,
) -> float | NDArray[np.float64]:
    """Returns the frequency at which ``damping_spectrum`` reaches its supremum.

    Without a delay it is Nyquist's, π/T, for every coupling; the spectrum of a spring alone is
    flat. With a delay, a spring alone leaves it at low frequency. A damper moves it up, at most to
    π/((d + 1) T). Arguments, errors and sources are those of ``minimum_damping``.

    Returns:
        ω in rad/s, shaped like the coupling: 0.0 if the supremum is the limit for ω → 0, π/T if it
        is reached at Nyquist or infinite there. Accurate to about 1e-7 of π/T, because the spectrum
        is flat at its top. Of several equal maxima any one.
    """
    law = SampledLaw.validated(coupling, period, discretization, delay, filter_time)
    if law.delay == 0:
        return plain(np.full(law.stiffness.shape, np.pi / law.period))
    needed = _for_any_environment(law.finite)
    top, angle = supremum(needed, law.finite, 1)
    one = np.ones((1,) * law.stiffness.ndim)
    angle = np.where(needed(LOWEST_ANGLE * one) >= top * (1 - SAME), 0.0, angle)
    angle = np.where(needed(np.pi * one) >= top * (1 - SAME), np.pi, angle)
    if law.rings:
        angle = np.where(law.damping > 0, np.pi, angle)
    return plain(np.asarray(angle / law.period))


def _for_any_environment(
    law: SampledLaw, count: int = 1
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Returns the spectrum of a law for any environment, with its delay in samples."""
    late = law.delay / count
    return lambda theta: needed_behind_delay(law.transfer, law.period, theta, late, count)


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
    delay: float = ...,
    filter_time: float = ...,
    ticks_per_sample: int = ...,
) -> float: ...


@overload
def minimum_damping(
    coupling: CouplingGrid,
    period: float,
    *,
    discretization: Discretization = ...,
    delay: float = ...,
    filter_time: float = ...,
    ticks_per_sample: int = ...,
) -> float | NDArray[np.float64]: ...


def minimum_damping(
    coupling: Coupling | CouplingGrid,
    period: float,
    *,
    discretization: Discretization = "backward",
    delay: float = 0.0,
    filter_time: float = 0.0,
    ticks_per_sample: int = 1,
) -> float | NDArray[np.float64]:
    """Returns the least device damping with which a coupling is passive, in every scene.

        backward     b >= K T/2 + B'                     low-passed: K T/2 + B' T/(T + 2τ)
        tustin       b >= K T/2 for B' = 0, else inf     low-passed: K T/2 + B' T/(2τ)

    B' is the damping of the law, the ``damping`` of the coupling given here. At equality the device
    loses nothing and gains nothing; the paper states the condition with >.

    A device that is **late** gets a force (d + φ) n T after its sample, d whole and 0 <= φ < 1, and
    holds it for n T. The tool gets its force at once. With C of the coupling, w = e^{−jψ},

        b >= n T max_θ max{ s_d, (1 − φ) s_d + φ s_{d+1} } mean_i 1/Re{(1 − w)/C(e^{jψ})}
        s_d = sin²((d + 1)θ/2),    ψ = (θ + 2πi)/n,  i = 0 … n − 1,    0 < θ <= π

        spring alone, n = 1, φ = 0    b >= (d + 1)² K T/2
        no delay, backward            b >= n T [(n − 1) K² + y²]/(2y),    y = K + 2 B'/T

    The larger of the two s is taken, because a part of a tick may ask less of a damper than none.
    By the backward rule the bound holds for every constant delay up to the given one.
    In rotation a coupling's torque turns with handle and tool, and a late one does not. The bound
    leaves that out; the springs pay for it (``kernel.law.charge_lag``).

    It is **sufficient** for every passive hand and every discrete-time passive scene (14), also
    nonlinear and changing ones. For n = 1 and φ = 0 it is **necessary**: at the worst frequency a
    lossless hand and a lossless tool exist that swing for ever at equality. With a part of a tick
    it is known to be necessary for a spring alone. ``wall_damping`` has the bound of a tool that
    does not move.

    **Derivation.** f acts on the tool at once, so that the scene takes Σ f·δx of the Σ f·δh. With
    j over samples, i over ticks and e = h − x the hand gets at most

        E <= S_0 + Σ_j [(f_j − f_{j−1−d})·δh_j − (b/nT) ‖δh_j‖²] − Σ_i f_i·δe_i
          <= S_0 + Σ_j (nT/4b) ‖f_j − f_{j−1−d}‖² − Σ_i f_i·δe_i

    In frequency, δe = (1 − w) f/C, and a sample of f is the mean of its n aliases; the
    Cauchy-Schwarz inequality gives the condition. A part of a tick splits δh in two. Sums that end
    at a tick N are those of a motion that goes on without end: e stays until the filter has died
    away, then the spring is let go slowly. That adds −½K‖e_N‖² <= 0 to Σ f·δe, and no more.

    Args:
        coupling: K and B' in translation; a ``CouplingGrid`` has many, of either kind of axis.
        period: T in s of the loop, finite and > 0.
        discretization: Rule that takes the damper's velocity from sampled positions.
        delay: (d + φ) n in ticks from a sample to its force on the device, 0 to 50 n, whole or not.
        filter_time: τ in s, >= 0, of a first-order low-pass behind the damper, discretised by the
            same rule.
        ticks_per_sample: n, ticks from one sample of the device to the next, at least 1.

    Returns:
        The bound on b in N s/m (rotation: N m s/rad), shaped like the coupling. It is inf for
        Tustin's damper without low-pass at any delay, because its gain at Nyquist is infinite.

    Raises:
        CouplingError: An argument is out of range, or the discretization is unknown.

    References:
        Brown & Colgate 1997, eqs. (2), (6), (7), for a device in time.
    """
    n = whole("ticks per sample", ticks_per_sample, least=1)
    law = SampledLaw.validated(coupling, period, discretization, delay, filter_time, n)
    if law.delay == 0 and n == 1:
        share = 1.0
        if not law.rings:
            step = law.period if discretization == "backward" else 0.0
            share = law.period / (step + 2 * law.filter_time)
        needed = law.stiffness * law.period / 2 + law.damping * share
    else:
        needed, _ = supremum(_for_any_environment(law.finite, n), law.finite, n)
    if law.rings:
        needed = np.where(law.damping > 0, np.inf, needed)
    return plain(np.asarray(needed))


def wall_damping(
    coupling: Coupling | CouplingGrid,
    period: float,
    *,
    discretization: Discretization = "backward",
    delay: int = 0,
    filter_time: float = 0.0,
) -> float | NDArray[np.float64]:
    """Returns the least device damping with which a coupling is passive against a wall.

        b >= (T/2) Re{(1 − w) C w^d}/(1 − cos θ)  for 0 < θ <= π,    w = e^{−jθ}
        backward     b >= (K T/2) sin((2d + 1)θ/2)/sin(θ/2) − B' cos((d + 1)θ)
        B' = 0       b >= K (T/2 + d T)

    The tool does not move. The bound is necessary and sufficient for any passive hand, and with a
    delay **too low for a tool that moves**: ``minimum_damping`` has the bound for every scene.
    Arguments and errors are those of ``minimum_damping``, with d a whole number of ticks, 0 to 50.

    References:
        Colgate & Schenkel 1997.
    """
    samples = delayed_by(delay)
    law = SampledLaw.validated(coupling, period, discretization, samples, filter_time)
    needed, _ = wall_supremum(law.finite)
    if law.rings:
        needed = np.where(law.damping > 0, np.inf, needed)
    return plain(np.asarray(needed))


def stiffest_late_coupling(
    device_damping: float, period: float, delay: float, ticks_per_sample: int
) -> tuple[float, float]:
    """Returns K in N/m and B' in N s/m of the default coupling behind a device that is late.

    It is the stiffest one that needs ``NEEDED_SHARE`` of b, with B' of at least b/(4 n). For a
    device in time that is ``stiffest_coupling`` within 1 %. Behind a delay the stiffest one has
    more damping, because the damper lowers the need at low frequencies. The delay is in s; other
    arguments and errors are those of ``minimum_damping``. b in N s/m must be finite and > 0.
    """
    b = scalar("device damping", device_damping, "N s/m", positive=True)
    largest = 1.0 + ticks_per_sample**0.5 + delay / period
    ratios = np.linspace(0.0, largest, RATIOS) * period  # B'/K in s
    laws = CouplingGrid(1.0, ratios)
    ticks = delay / period
    needed = minimum_damping(laws, period, delay=ticks, ticks_per_sample=ticks_per_sample)
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
