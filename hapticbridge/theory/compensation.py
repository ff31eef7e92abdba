"""Damping of the coupling law for a desired effective damping, and the device damping it requires.

An implicit step of period T adds the damping K T to a spring. The midpoint rule with a backward
spring adds K T/2. The law's damping B' is therefore lower than the effective damping B at the hand:

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

from hapticbridge.theory.transfer import scalar

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
