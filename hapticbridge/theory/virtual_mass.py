"""Point mass behind the coupling, and the device damping that its integrator requires.

Each scheme is a delay of j samples from the force to the position of the mass:

    j = 0  implicit        v_k = v_{k−1} + (T/m) f_k       x_k = x_{k−1} + T v_k
    j = 1  semi_implicit   v_{k+1} = v_k + (T/m) f_k       x_{k+1} = x_k + T v_{k+1}
    j = 2  explicit        v_k = v_{k−1} + (T/m) f_{k−1}   x_k = x_{k−1} + T v_{k−1}

The response at the device is H = C / (1 − λ C e^{j(1−j)θ}), λ = T²/(4 m sin²(θ/2)).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.theory.transfer import (
    CouplingGrid,
    checked,
    one_of,
    plain,
    scalar,
    spring_and_damper,
    together,
)

Integrator = Literal["implicit", "semi_implicit", "explicit"]
"""Integration scheme of the mass behind the coupling."""

FORCE_DELAY: dict[str, int] = {"implicit": 0, "semi_implicit": 1, "explicit": 2}
"""Samples from force to position, per integrator."""

MAX_PRODUCT = 1e280
"""Largest product of two coefficients, in units of K: the range of a double, less a reserve for
sums of a few products."""

_Array = NDArray[np.float64]


def force_delay(integrator: Integrator) -> int:
    """Returns the samples from force to position.

    Raises:
        CouplingError: The integrator is unknown.
    """
    return FORCE_DELAY[one_of("integrator", integrator, FORCE_DELAY)]


def _smallest_stable_mass(stiffness: _Array, damping: _Array, period: float, delay: int) -> _Array:
    if delay == 0:
        return np.zeros_like(stiffness)
    if delay == 1:
        return period / 2 * (stiffness * period / 2 + damping)
    surplus = damping - stiffness * period
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(surplus > 0, damping**2 * period / surplus, np.inf)


def minimum_mass(
    coupling: Coupling | CouplingGrid, period: float, integrator: Integrator = "implicit"
) -> float | NDArray[np.float64]:
    """Returns the mass in kg above which a tool is stable behind a fixed handle.

        implicit        0
        semi_implicit   (T/2)(K T/2 + B)
        explicit        B² T / (B − K T);  inf for B <= K T

    A light tool on a stiff coupling requires the implicit step. With the explicit step the smallest
    mass for any damper is 4 K T², at B = 2 K T.

    Raises:
        CouplingError: An argument is out of range.

    References:
        Brown & Colgate 1997, stability conditions that belong to eq. (19) (reconstructed).
    """
    period = scalar("period", period, "s", positive=True)
    delay = force_delay(integrator)
    return plain(_smallest_stable_mass(*spring_and_damper(coupling), period, delay))


def _needed(k: _Array, g: _Array, inertia: _Array, delay: int, y: _Array) -> _Array:
    """Returns p(y)/q(y) at points (..., n), inf where q is not positive."""
    coefficients = _polynomials(k, g, inertia, delay)
    top, bottom = (_value(polynomial, y) for polynomial in coefficients)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(bottom > 0, top / bottom, np.inf)


def _value(polynomial: _Array, y: _Array) -> _Array:
    """Evaluates polynomials (..., n), lowest power first, at points (..., p)."""
    total = np.zeros_like(y)
    for power in range(polynomial.shape[-1] - 1, -1, -1):
        total = total * y + polynomial[..., power, None]
    return total


def _polynomials(k: _Array, g: _Array, inertia: _Array, delay: int) -> tuple[_Array, _Array]:
    """Returns p and q, lowest power first, with (19) = (T/2) p(y)/q(y), y = 1 − cos θ.

    With g = B/T and μ = 2m/T², λ = 1/(μy), and both sides of the fraction times (μy)²:

        p = μ²y² (k − 2g(1 − y)) − μy A S        A = |C|² = k² + 2y g(k + g)
        q = μ²y² − 2μy Re{C e^{j(1−j)θ}} + A      S = 3 − 2y, 1, −1 for j = 0, 1, 2
    """
    zero = np.zeros_like(k)
    slope = 2 * g * (k + g)
    shift, tilt = ((3.0, -2.0), (1.0, 0.0), (-1.0, 0.0))[delay]
    real = ((k, -(k + g), zero), (k, g, zero), (k, 3 * g - k, -2 * g))[delay]
    top = [
        zero,
        -inertia * k**2 * shift,
        inertia**2 * (k - 2 * g) - inertia * (slope * shift + k**2 * tilt),
        2 * g * inertia**2 - inertia * slope * tilt,
    ]
    bottom = [
        k**2,
        slope - 2 * inertia * real[0],
        inertia**2 - 2 * inertia * real[1],
        -2 * inertia * real[2],
    ]
    return np.stack(top, axis=-1), np.stack(bottom, axis=-1)


def _stationary_points(top: _Array, bottom: _Array) -> _Array:
    """Returns the real parts of the roots of p'q − pq', shape (..., 4), clipped to (0, 2]."""
    shape = top.shape[:-1]
    derivative = np.zeros((*shape, 5))
    for i in range(4):
        for j in range(4):
            if i != j:  # p'q gives i p_i q_j y^{i+j−1}, pq' the same with j
                derivative[..., i + j - 1] += (i - j) * top[..., i] * bottom[..., j]
    # The companion matrix of 1/y always exists: the lowest coefficient, −μ k⁴ S(0), is never 0,
    # while the highest ones may vanish.
    companion = np.zeros((*shape, 4, 4))
    companion[..., range(1, 4), range(3)] = 1
    companion[..., 0, :] = -derivative[..., 1:] / derivative[..., :1]
    inverse = np.linalg.eigvals(companion)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = (1 / inverse).real
    return np.where(np.isfinite(points), np.clip(points, 1e-12, 2), 2.0)


def environment_minimum_damping(
    coupling: Coupling | CouplingGrid,
    period: float,
    mass: ArrayLike,
    integrator: Integrator = "implicit",
) -> float | NDArray[np.float64]:
    """Returns the device damping that a point mass behind the coupling requires, for any hand.

    It is the supremum over 0 < θ = ωT <= π of the following, with s = sin(θ/2), λ = T²/(4 m s²),
    b0' = KT/2 − B cos θ and A = |C|² = K² + 4s²(B/T)(K + B/T),

        implicit        [b0' − (T/2)λA sin(3θ/2)/s] / |1 − λ C e^{+jθ}|²
        semi_implicit   [b0' − (T/2)λA]             / |1 − λ C|²
        explicit        [b0' + (T/2)λA]             / |1 − λ C e^{−jθ}|²

    found exactly, at the stationary points of a rational function of cos θ. It holds for this
    environment only. A mass in contact with something else requires up to ``minimum_damping``, and
    only the implicit integrator is passive at all.

    Args:
        coupling: K and B.
        period: T in s, finite and > 0.
        mass: m in kg, finite and > 0, broadcast against the coupling.
        integrator: Integration scheme of the mass.

    Returns:
        b in N s/m; inf where the environment itself is not asymptotically stable: at or below
        ``minimum_mass``, and with the semi-implicit step for B = 0.

    Raises:
        CouplingError: An argument is out of range or mis-shaped, or K, B/T and m/T² differ by a
            hundred orders of magnitude.

    References:
        Brown & Colgate 1997, eq. (19) (reconstructed for the explicit scheme).
    """
    period = scalar("period", period, "s", positive=True)
    delay = force_delay(integrator)
    masses = checked("mass", mass, "kg", positive=True)
    k, damping = spring_and_damper(coupling)
    k, damping, masses = together(coupling_stiffness=k, coupling_damping=damping, mass=masses)
    stable = masses > _smallest_stable_mass(k, damping, period, delay)
    if delay == 1:
        stable &= damping > 0
    # work in units of K and of 2m/T² = K to avoid under- and overflow
    g = damping / period / k
    inertia = 2 * masses / period**2 / k
    unit = np.ones_like(k)
    with np.errstate(over="ignore", invalid="ignore"):
        top, bottom = _polynomials(unit, g, inertia, delay)
        size = np.abs(top).max(axis=-1) * np.abs(bottom).max(axis=-1)
    # products of the coefficients must fit a double, and μ k⁴ must not underflow
    is_exact = (size < MAX_PRODUCT) & (inertia > 1 / MAX_PRODUCT)
    if not (is_exact | ~stable).all():
        raise CouplingError(
            "stiffness, damping/period and mass/period² lie too far apart for double precision"
        )
    g, inertia = np.where(is_exact, (g, inertia), 1.0)
    top, bottom = _polynomials(unit, g, inertia, delay)
    points = _stationary_points(top, bottom)
    points = np.concatenate([points, np.full((*k.shape, 1), 2.0)], axis=-1)
    needed = k * period / 2 * _needed(unit, g, inertia, delay, points).max(axis=-1)
    return plain(np.where(stable, needed, np.inf))
