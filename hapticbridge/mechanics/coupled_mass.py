"""Point mass driven by a handle through the coupling, with four integrators."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.errors import MechanicsError
from hapticbridge.mechanics.arguments import (
    chosen,
    common_shape,
    finite,
    positive,
    spring_and_damper,
    step,
)
from hapticbridge.mechanics.particle import ParticleMotion

CoupledScheme = Literal["held", "implicit", "compensated", "midpoint"]
COUPLED_SCHEMES = ("held", "implicit", "compensated", "midpoint")


class CoupledMotion(ParticleMotion):
    """Motion of a mass behind a coupling at the samples 0 … N.

    ``force`` acts on the mass; the device receives −f_k. f_0 acts only in the ``held`` scheme.
    ``energy_gain`` is 0 under ``midpoint``, and −½ m (v_k − v_{k−1})² under ``implicit`` and
    ``compensated``.
    """

    __slots__ = ()


def drive_mass(
    coupling: Coupling,
    mass: ArrayLike,
    handle: ArrayLike,
    period: float,
    scheme: CoupledScheme,
    *,
    position: ArrayLike | None = None,
    velocity: ArrayLike = 0.0,
) -> CoupledMotion:
    """Moves a free mass by the translational coupling to a handle with prescribed motion.

    With e = h − x and M for the mass:

        held         f_k = K e_k + (B/T)(e_k − e_{k−1}),            v_k = v_{k−1} + (T/M) f_{k−1},
                     x_k = x_{k−1} + T v_k
        implicit     f_k as for held,                               v_k = v_{k−1} + (T/M) f_k,
                     x_k = x_{k−1} + T v_k
        compensated  implicit with max(B − K T, 0) for B
        midpoint     f_k = K (e_k + e_{k−1})/2 + (B/T)(e_k − e_{k−1}),
                     v_k = v_{k−1} + (T/M) f_k,   x_k = x_{k−1} + T (v_{k−1} + v_k)/2

    ``held`` generates energy and is stable only above a certain mass (K T²/4 without damping).
    Below it the motion grows until it overflows to inf or nan. The other schemes are stable for
    every mass. ``implicit`` and ``compensated`` are passive and of first order. ``midpoint`` is
    passive without numerical damping and of second order.

    Required device damping:

        implicit     b > K T/2 + B
        compensated  b > K T/2 + max(B − K T, 0)
        midpoint     b > B for B >= K T/2;  b > (K T)²/(4 B) below that

    For B < K T/2 the midpoint coupling is a backward difference with the negative damping B − K
    T/2, and its condition suffices for linear hands and scenes only. The handle rests before sample
    0.

    Args:
        coupling: K and B; the rotational pair is not used.
        mass: M in kg, finite and > 0, shape (...).
        handle: h_0 … h_N in m, finite, time first: shape (N + 1, ...), N >= 1.
        period: T in s, finite and > 0.
        scheme: One of ``COUPLED_SCHEMES``.
        position: x_0 in m, shape (...); h_0 by default.
        velocity: v_0 in m/s, shape (...).

    Raises:
        MechanicsError: An argument is not finite, out of range or mis-shaped.

    References:
        Brown & Colgate 1997, eqs. (4), (15); Kim, Lee et al. 2017, "Haptic rendering and
        interactive simulation using passive midpoint integration", Int. J. Robotics Research 36.
    """
    chosen("scheme", scheme, COUPLED_SCHEMES)
    mass, period = positive("mass", mass, "kg"), step(period)
    h = finite("handle position", handle, "m")
    if h.ndim == 0 or len(h) < 2:
        raise MechanicsError(f"handle has shape {h.shape}; it must be (N + 1, ...) with N >= 1")
    start = h[0] if position is None else finite("position", position, "m")
    velocity = finite("velocity", velocity, "m/s")
    k, b = (np.asarray(value) for value in spring_and_damper(coupling))
    shape = common_shape(mass=mass, handle=h[0], position=start, velocity=velocity, coupling=k + b)
    if scheme == "compensated":
        b = np.maximum(b - k * period, 0)
    f, x, v = (np.empty((len(h), *shape)) for _ in range(3))
    x[0], v[0] = start, velocity
    f[0] = k * (h[0] - x[0])
    # weight of the step's end in the spring's mean stretch
    end_weight = 0.5 if scheme == "midpoint" else 1.0
    # f = idle − loss · (x_k − x_{k−1})/T, with idle the force on a mass that stays where it is
    loss = b + end_weight * k * period
    with np.errstate(over="ignore", invalid="ignore"):
        for i in range(1, len(h)):
            moved = h[i] - h[i - 1]
            idle = k * (h[i - 1] + end_weight * moved - x[i - 1]) + b / period * moved
            if scheme == "held":
                v[i] = v[i - 1] + period / mass * f[i - 1]
                mean = v[i]
            elif scheme == "midpoint":
                mean = (2 * mass * v[i - 1] + period * idle) / (2 * mass + period * loss)
                v[i] = 2 * mean - v[i - 1]
            else:
                v[i] = (mass * v[i - 1] + period * idle) / (mass + period * loss)
                mean = v[i]
            x[i] = x[i - 1] + period * mean
            f[i] = idle - loss * mean
    return CoupledMotion(mass, f, x, v)


def exact_mass_response(
    coupling: Coupling, mass: ArrayLike, frequency: ArrayLike
) -> NDArray[np.complex128]:
    """Returns X/H of a mass behind an unsampled coupling, the reference of the four schemes.

        X/H = (K + jωB) / (K + jωB − M ω²),    ω = 2π · frequency

    Mass in kg and frequency in Hz must be finite and > 0, and broadcast; otherwise MechanicsError
    is raised. At the resonance of an undamped mass X/H is inf.
    """
    mass, frequency = positive("mass", mass, "kg"), positive("frequency", frequency, "Hz")
    common_shape(mass=mass, frequency=frequency)
    omega = 2 * np.pi * frequency
    stiffness, damping = spring_and_damper(coupling)
    impedance = stiffness + 1j * omega * damping
    rest = impedance - mass * omega**2
    with np.errstate(divide="ignore", invalid="ignore"):
        response = impedance / rest
    return np.asarray(np.where(rest == 0, np.inf, response), dtype=np.complex128)
