"""Stability of a free device, without a hand, against a wall behind the coupling.

In units of the period and of the device's mass, x = b T/m, κ = K T²/m, β = B T/m, ν = τ/T, with d
samples of delay, an exact zero-order hold gives the closed loop

    p(z) = (z − 1)(z − e^{−x}) z^d F(z) + [φ₂ (z − e^{−x}) + φ₁²] [κ F(z) + β (z − 1)]
    F(z) = (1 + ν) z − ν,    φ₁ = (1 − e^{−x})/x,    φ₂ = (1 − φ₁)/x

The loop is stable if all roots of p lie inside the unit circle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.theory.transfer import checked, delayed_by, plain, scalar, single, together

# Stiffness limits from position resolution and Coulomb friction

Region = Literal["passive", "locally stable", "bounded limit cycle", "unstable"]
"""Regions of (β, σ) after Diolaiti et al. 2006."""


@dataclass(frozen=True, slots=True)
class QuantizationLimit:
    """Limits of a coupling on a device that quantises its position.

    Attributes:
        stiffness: Largest K in N/m that damping and friction both allow; 0 if the damper alone
            exceeds them. Always finite, because the damping bounds it.
        limited_by: The line that limits it: ``damping`` or ``friction``.
        beta: β = b / (K T), without unit.
        sigma: σ = f_c / (K Δ), without unit; inf for Δ = 0.
        region: ``passive`` (β and σ above ½), ``locally stable`` (only σ), ``bounded limit cycle``
            (only β), ``unstable`` (neither). Defined for a coupling without damper.
        friction_needed: K Δ/2 + B Δ/T in N.
    """

    stiffness: float
    limited_by: Literal["damping", "friction"]
    beta: float
    sigma: float
    region: Region
    friction_needed: float


def quantization_limit(
    damping: float, friction: float, resolution: float, coupling: Coupling, period: float
) -> QuantizationLimit:
    """Returns the stiffness that friction and resolution allow, and the region of a coupling.

        K <= min( 2(b − B)/T,  2(f_c/Δ − B/T) ),      f_c >= K Δ/2 + B Δ/T

    Friction sets a line of its own, because motion over one quantum may be arbitrarily slow.

    Args:
        damping: Damping b of one axis of the device in N s/m, >= 0.
        friction: Its Coulomb friction f_c in N, >= 0.
        resolution: Its position quantum Δ in m, >= 0.
        coupling: K and B in translation.
        period: T in s, finite and > 0.

    Raises:
        CouplingError: A value is not finite or out of range.

    References:
        Abbott & Okamura 2005 (friction and damping bounds); Diolaiti et al. 2006 (regions).
    """
    period = scalar("period", period, "s", positive=True)
    b = scalar("device damping", damping, "N s/m")
    friction = scalar("device friction", friction, "N")
    quantum = scalar("device resolution", resolution, "m")
    k, law_damping = single(coupling)
    by_damping = 2 * (b - law_damping) / period
    by_friction = 2 * (friction / quantum - law_damping / period) if quantum else float("inf")
    beta = b / (k * period)
    sigma = friction / (k * quantum) if quantum else float("inf")
    region: Region
    if beta > 0.5:
        region = "passive" if sigma > 0.5 else "bounded limit cycle"
    else:
        region = "locally stable" if sigma > 0.5 else "unstable"
    return QuantizationLimit(
        stiffness=max(0.0, min(by_damping, by_friction)),
        limited_by="damping" if by_damping <= by_friction else "friction",
        beta=beta,
        sigma=sigma,
        region=region,
        friction_needed=k * quantum / 2 + law_damping * quantum / period,
    )


_Array = NDArray[np.float64]

FIRST_SHARE = 1e-6
"""Start of the search, without unit, as a share of (b + B)/T in stiffness or of b + m/T in damping.
A limit below it is returned as 0; no real device is that soft. A smaller value takes longer."""

SMALL = 1e-2
"""Value of b T/m, without unit, below which φ₂ is summed as a series. Five terms leave an error of
1e-14 there. Below it the closed form loses as many digits to cancellation."""

BISECTIONS = 27
"""Number of halvings of an octave: 2^-27 = 7e-9. This is a hundredth of the accuracy of the
boundary, 1e-6, which double roots near 1 limit. More halvings only take longer."""

OCTAVES = 200
"""Number of doublings after which the search ends. The end, 2^200 times the start, lies beyond
every limit."""


def _plant(x: _Array) -> tuple[_Array, _Array, _Array]:
    """Returns e^{−x}, φ₁ and φ₂ of a damped mass under an exact zero-order hold."""
    safe = np.where(x > 0, x, 1.0)
    first = np.where(x > 0, -np.expm1(-safe) / safe, 1.0)
    series = 1 / 2 - x / 6 * (1 - x / 4 * (1 - x / 5 * (1 - x / 6)))
    return np.exp(-x), first, np.where(x < SMALL, series, (1 - first) / safe)


def _product(first: list[_Array], second: list[_Array]) -> list[_Array]:
    """Multiplies polynomials whose coefficient arrays start with the highest power."""
    result = [np.zeros_like(first[0]) for _ in range(len(first) + len(second) - 1)]
    for i, left in enumerate(first):
        for j, right in enumerate(second):
            result[i + j] = result[i + j] + left * right
    return result


def _is_stable(coefficients: list[_Array]) -> NDArray[np.bool_]:
    degree = len(coefficients) - 1
    companion = np.zeros((*coefficients[0].shape, degree, degree))
    companion[..., range(1, degree), range(degree - 1)] = 1
    companion[..., 0, :] = -np.stack(coefficients[1:], -1) / coefficients[0][..., None]
    stable: NDArray[np.bool_] = np.abs(np.linalg.eigvals(companion)).max(axis=-1) < 1
    return stable


def _first_unstable(stable_at: Callable[[_Array], NDArray[np.bool_]], start: _Array) -> _Array:
    """Returns the end of the stable range from the start value on; 0 if the start is unstable."""
    low, high = np.zeros_like(start), start
    growing = stable_at(start)
    for _ in range(OCTAVES):
        if not growing.any():
            break
        low = np.where(growing, high, low)
        high = np.where(growing, 2 * high, high)
        growing = growing & stable_at(high)
    found = low > 0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        stable = stable_at(middle) & found
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    return np.where(found, low, 0.0)


def _loop(
    device_damping: _Array, mass: _Array, damping: _Array, period: float, delay: int, lag: float
) -> Callable[[_Array], list[_Array]]:
    """Returns p(z) as a function of κ; for κ = 0 its trivial root z = 1 is divided out."""
    x, beta = device_damping * period / mass, damping * period / mass
    decay, first, second = _plant(x)
    one, zero = np.ones_like(x), np.zeros_like(x)
    filtering = [(1 + lag) * one, -lag * one]
    plant = [second, first**2 - second * decay]
    still = [*_product([one, -decay], filtering), *[zero] * delay]
    with_damper = _sum(still, [beta * value for value in plant])
    spring = _product(plant, filtering)
    moving = _product([one, -one], with_damper)

    def polynomial(kappa: _Array) -> list[_Array]:
        if not kappa.any():
            return with_damper
        return _sum(moving, [kappa * value for value in spring])

    return polynomial


def _sum(long: list[_Array], short: list[_Array]) -> list[_Array]:
    """Adds two polynomials; the second has the lower degree."""
    head = len(long) - len(short)
    return [*long[:head], *(a + b for a, b in zip(long[head:], short, strict=True))]


def free_device_stiffness(
    device_damping: ArrayLike,
    period: float,
    mass: ArrayLike,
    damping: ArrayLike = 0.0,
    *,
    delay: int = 0,
    filter_time: float = 0.0,
) -> float | NDArray[np.float64]:
    """Returns the stiffness up to which a free device is stable against a wall.

    The device is a mass with viscous damping, m_d v' = −b v − f, without a hand. The coupling's
    force f is held for a period (exact zero-order hold). The tool does not move. Friction and
    quantisation are left out.

    This is a *stability* limit of one loop. A hand that stores energy can lower it down to
    ``maximum_stiffness``; a little damping of the hand raises it. The coupling's damper raises it
    until B reaches about m_d/T.

    The boundary is exact to 1e-6 for b T/m_d > 1e-6. The roots of a heavier device lie so near to 1
    that double precision no longer resolves its damping.

    Args:
        device_damping: b in N s/m, finite and >= 0.
        period: T in s, finite and > 0.
        mass: m_d in kg, finite and > 0.
        damping: B in N s/m, finite and >= 0.
        delay: d, whole samples from position to force, 0 to 50.
        filter_time: τ in s, >= 0, of a first-order low-pass behind the damper (backward).

    Returns:
        K in N/m, of the broadcast shape of the arguments. Every smaller stiffness is stable too. 0
        if none is stable, as for b = B = 0.

    Raises:
        CouplingError: An argument is out of range or mis-shaped.

    References:
        Gil, Avello, Rubio, Flórez 2004, Stability analysis of a 1 DOF haptic interface using the
        Routh-Hurwitz criterion (this loop without a low-pass).
    """
    period = scalar("period", period, "s", positive=True)
    lag = scalar("filter time", filter_time, "s") / period
    b, masses, dampings = together(
        device_damping=checked("device damping", device_damping, "N s/m"),
        mass=checked("mass", mass, "kg", positive=True),
        coupling_damping=checked("coupling damping", damping, "N s/m"),
    )
    polynomial = _loop(b, masses, dampings, period, delayed_by(delay), lag)
    available = (b + dampings) * period / masses
    start = FIRST_SHARE * np.where(available > 0, available, 1.0)
    kappa = _first_unstable(lambda value: _is_stable(polynomial(value)), start)
    stiffness = np.where(available > 0, kappa, 0.0) * masses / period**2
    return plain(np.asarray(stiffness))


def free_device_damping(
    device_damping: ArrayLike,
    period: float,
    mass: ArrayLike,
    *,
    delay: int = 0,
    filter_time: float = 0.0,
) -> float | NDArray[np.float64]:
    """Returns the coupling damping at which ``free_device_stiffness`` falls to 0, the limit K → 0.

    Arguments, errors and source as for ``free_device_stiffness``.

    Returns:
        B in N s/m, of the broadcast shape of the arguments.
    """
    period = scalar("period", period, "s", positive=True)
    lag = scalar("filter time", filter_time, "s") / period
    samples = delayed_by(delay)
    b, masses = together(
        device_damping=checked("device damping", device_damping, "N s/m"),
        mass=checked("mass", mass, "kg", positive=True),
    )
    zero = np.zeros_like(b)

    def stable_at(beta: _Array) -> NDArray[np.bool_]:
        loop = _loop(b, masses, beta * masses / period, period, samples, lag)
        return _is_stable(loop(zero))

    beta = _first_unstable(stable_at, FIRST_SHARE * (1 + b * period / masses))
    return plain(np.asarray(beta * masses / period))
