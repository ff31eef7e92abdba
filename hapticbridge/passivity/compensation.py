"""Couplings that are asked for as they feel: the damping of their law, and what the device needs.

An implicit step at period T adds the damping K T to a spring, the midpoint rule with a backward
spring adds K T/2. Who wants to feel B takes that off the law:

    B' = max(B − λ K T, 0),     felt: B' + λ K T,     device: b > K T/2 + B'

with λ = 1 for the compensated implicit coupling and ½ for the lossless one. The device sees the
backward difference f = K e + (B'/T) δe in both, so (6) holds with B' in the place of B:

    compensated   b > B − K T/2          for B >= K T
    lossless      b > B                  for B >= K T/2

**Derivation for the lossless coupling and a free tool of mass m.** With w = z⁻¹ its law is
C = K + B'(1 − w)/T and its tool G = (T²/2m)(1 + w)/(1 − w)², so H = C/(1 + C G). The condition
b > (T/2) Re[(1 − w) H]/(1 − cos θ) is hardest at θ = π: there 1 + w = 0, the tool stands still
whatever it weighs, H = K + 2B'/T, and the right-hand side is K T/2 + B'. Below it the tool yields
and needs less. A wall is the tool of infinite mass.

**And for the compensated one.** Its tool is G = (T²/m)/(1 − w)². At θ = π it yields by T²/(4m), so
that H = 1/(1/(K + 2B'/T) + T²/(4m)) and the right-hand side is (T/2) H, below K T/2 + B'; at no θ
does a free tool ask for more than a wall, for which it is K T/2 + B' again. In contact the lossless
coupling is the implicit form with the same B', so its condition does not change there.

**Damping that changes from tick to tick**, as where a tool goes over to another form in contact.
With B'_k, handle motion d_k, tool motion δx_k, e_k = e_{k−1} + d_k − δx_k and δe_k = d_k − δx_k,

    f_k (d_{k+1} − δx_k) = ½K [(e_k + d_{k+1})² − (e_{k−1} + d_k)² + δx_k² − d_{k+1}²]
                           + (B'_k/T) [(δe_k + ½(d_{k+1} − d_k))² − ¼(d_{k+1} − d_k)²]

and ¼(d_{k+1} − d_k)² <= ½(d_{k+1}² + d_k²). Summed over k, with S_0 of the environment by (14),

    Σ f_k d_{k+1} + Σ (b/T) d_k² >= −S_0 − ½K (e_0 + d_1)²    if b >= K T/2 + (B'_{k−1} + B'_k)/2

for every k, so if b >= K T/2 + max B', in whatever order they come. Change-overs between unequal B'
therefore create nothing and are not unstable by themselves: their cost is that the device must bear
the larger B'. One that bears only the smaller is unstable in that form and comes to rest in the
other: a limit cycle.
"""

from __future__ import annotations

from hapticbridge.passivity.grid import scalar

IMPLICIT_LAG, MIDPOINT_LAG = 1.0, 0.5
"""λ: share of K T that the integration adds to the damping, no unit."""


def law_damping(stiffness: float, felt: float, period: float, lag: float) -> float:
    """Returns B' = max(B − λ K T, 0), the damping of a law under which B is felt.

    Args:
        stiffness: K in N/m (rotation: N m/rad), finite and >= 0.
        felt: B in N s/m, finite and >= 0.
        period: T in s, finite and > 0: of the integration.
        lag: λ, finite and >= 0.

    Raises:
        CouplingError: An argument is out of range.
    """
    stiffness, felt = scalar("stiffness", stiffness, "N/m"), scalar("damping", felt, "N s/m")
    return max(felt - scalar("lag", lag, "") * stiffness * _period(period), 0.0)


def felt_damping(stiffness: float, damping: float, period: float, lag: float) -> float:
    """Returns B' + λ K T, what is felt where B' is the damping of the law.

    Args:
        stiffness: K in N/m (rotation: N m/rad), finite and >= 0.
        damping: B' in N s/m, finite and >= 0.
        period: T in s, finite and > 0: of the integration.
        lag: λ, finite and >= 0.

    Raises:
        CouplingError: An argument is out of range.
    """
    stiffness, damping = scalar("stiffness", stiffness, "N/m"), scalar("damping", damping, "N s/m")
    return damping + scalar("lag", lag, "") * stiffness * _period(period)


def needed_for_felt(stiffness: float, felt: float, period: float, lag: float) -> float:
    """Returns the damping b in N s/m that a device needs to show K and B: K T/2 + B'.

    Sufficient for any passive hand and any environment that is discrete-time passive (14);
    necessary against a wall, and for λ = ½ against a free tool of any mass.

    Args:
        stiffness: K in N/m (rotation: N m/rad), finite and >= 0.
        felt: B in N s/m, finite and >= 0.
        period: T in s, finite and > 0: of the device and of the integration.
        lag: λ, finite and >= 0.

    Raises:
        CouplingError: An argument is out of range.

    References:
        Brown & Colgate 1997, eq. (6), for the law with B'; derived above.
    """
    return 0.5 * stiffness * _period(period) + law_damping(stiffness, felt, period, lag)


def largest_felt_damping(
    device_damping: float, stiffness: float, period: float, lag: float
) -> float:
    """Returns the largest B in N s/m that a device of damping b can show beside K.

        B = b + (λ − ½) K T    for K T/2 <= b, else 0: no damping is low enough

    Args:
        device_damping: b in N s/m, finite and > 0.
        stiffness: K in N/m, finite and >= 0.
        period: T in s, finite and > 0: of the device and of the integration.
        lag: λ, finite and >= 0.

    Raises:
        CouplingError: An argument is out of range.
    """
    available = scalar("device damping", device_damping, "N s/m", positive=True)
    per_tick = scalar("stiffness", stiffness, "N/m") * _period(period)
    if per_tick > 2 * available:
        return 0.0
    return available + (scalar("lag", lag, "") - 0.5) * per_tick


def _period(period: float) -> float:
    return scalar("period", period, "s", positive=True)
