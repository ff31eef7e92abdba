"""Rigid body turning about its centre of mass, with four integrators."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hapticbridge.arguments import LARGEST, Array
from hapticbridge.errors import MechanicsError
from hapticbridge.jit import compiled
from hapticbridge.mechanics.arguments import chosen, common_shape, finite, positive, step, whole
from hapticbridge.mechanics.particle import SCHEMES, Scheme
from hapticbridge.pose import Quaternion, Vector, cross, norm, product, quaternion_exp, scaled

TOLERANCE = 1e-12
"""Relative change of the angular velocity, without unit, at which Newton's iteration ends. The
iteration converges quadratically, so the remaining error is far below rounding. At 1e-16 it would
never end; above 1e-8 energy would drift."""

ITERATIONS = 50
"""Largest number of Newton iterations per step. At T |ω| < 0.5 rad 3 to 5 are enough; a step that
exceeds it counts as too long."""


@dataclass(frozen=True, slots=True, eq=False)
class Rotation:
    """Rotation of a rigid body at the samples 0 … N.

    Attributes:
        inertia: Principal moments in kg m², shape (..., 3).
        angular_velocity: ω_k in the body's principal frame in rad/s, shape (N + 1, ..., 3).
        orientation: q_k, body to world, (w, x, y, z), shape (N + 1, ..., 4).
    """

    inertia: Array
    angular_velocity: Array
    orientation: Array

    @property
    def kinetic_energy(self) -> Array:
        """½ ωᵀ I ω in J, shape (N + 1, ...)."""
        return np.asarray(0.5 * np.sum(self.inertia * self.angular_velocity**2, axis=-1))

    @property
    def angular_momentum(self) -> Array:
        """R I ω in the world frame in kg m²/s, shape (N + 1, ..., 3)."""
        local = self.inertia * self.angular_velocity
        w, u = self.orientation[..., :1], self.orientation[..., 1:]
        t = 2 * np.cross(u, local)
        return np.asarray(local + w * t + np.cross(u, t))


def integrate_rotation(
    inertia: ArrayLike,
    angular_velocity: ArrayLike,
    period: float,
    steps: int,
    scheme: Scheme,
    *,
    torque: ArrayLike | None = None,
) -> Rotation:
    """Turns a rigid body, free or under a torque in its own frame.

    With a(ω, τ) = I⁻¹(τ − ω × Iω) and ω̄ = (ω_{k−1} + ω_k)/2:

        explicit        ω_k = ω_{k−1} + T a(ω_{k−1}, τ_{k−1}),   q_k = q_{k−1} ⊗ exp(T ω_{k−1})
        semi_implicit   ω_k as for explicit,                     q_k = q_{k−1} ⊗ exp(T ω_k)
        implicit        ω_k = ω_{k−1} + T a(ω_k, τ_k),           q_k = q_{k−1} ⊗ exp(T ω_k)
        midpoint        ω_k = ω_{k−1} + T a(ω̄, τ_k),             q_k = q_{k−1} ⊗ cay(T ω̄)

    cay is the Cayley map, rotation by 2 atan(|Tω̄|/2). Without torque ``explicit`` and
    ``semi_implicit`` gain ½ T² aᵀ I a in every step, and ``implicit`` loses it. ``midpoint``
    conserves the energy, and the momentum in the world frame, up to rounding. Under torque
    ``midpoint`` gains precisely T τ_k · ω̄. Above T |ω| of about 1 rad per sample the implicit
    schemes are inaccurate and Newton's method may fail, which raises an error.

    Args:
        inertia: Principal moments in kg m², finite, > 0, none larger than the sum of the other two,
            shape (..., 3).
        angular_velocity: ω_0 in the body's frame in rad/s, shape (..., 3).
        period: T in s, finite and > 0.
        steps: N >= 1.
        scheme: One of ``SCHEMES``.
        torque: τ_0 … τ_N in the body's frame in N m, shape (N + 1, ..., 3); none by default.

    Raises:
        MechanicsError: An argument is not finite, out of range or mis-shaped, or a step is too long
            to be solved.

    References:
        Simo & Wong 1991, Int. J. Numerical Methods in Engineering 31 (midpoint); the other three
        are Brown & Colgate's schemes (15), (17) applied to Euler's equations.
    """
    chosen("scheme", scheme, SCHEMES)
    inertia, period = positive("inertia", inertia, "kg m²"), step(period)
    omega = finite("angular velocity", angular_velocity, "rad/s")
    steps = whole("steps", steps, least=1)
    tau = np.zeros((steps + 1, 3)) if torque is None else finite("torque", torque, "N m")
    if len(np.atleast_1d(tau)) != steps + 1:
        raise MechanicsError(f"torque has shape {tau.shape}; it must be ({steps + 1}, ..., 3)")
    for name, array in (("inertia", inertia), ("angular velocity", omega), ("torque", tau[0])):
        if array.shape[-1:] != (3,):
            raise MechanicsError(f"{name} has shape {array.shape}; it must be (..., 3)")
    # 1e-12 admits a flat body, whose largest moment equals the sum of the others up to rounding
    if np.any(2 * inertia.max(axis=-1) > inertia.sum(axis=-1) * (1 + 1e-12)):
        raise MechanicsError(
            "a principal moment exceeds the sum of the other two, which no rigid body has; "
            "correct the moments of inertia"
        )
    shape = common_shape(inertia=inertia, angular_velocity=omega, torque=tau[0])
    tau = tau.reshape(len(tau), *(1,) * (len(shape) + 1 - tau.ndim), *tau.shape[1:])
    rates = np.empty((steps + 1, *shape))
    turns = np.empty((steps + 1, *shape[:-1], 4))
    rates[0], turns[0] = omega, (1.0, 0.0, 0.0, 0.0)
    _integrate(
        np.ascontiguousarray(np.broadcast_to(inertia, shape)).reshape(-1, 3),
        np.ascontiguousarray(np.broadcast_to(tau, rates.shape)).reshape(steps + 1, -1, 3),
        period,
        SCHEMES.index(scheme),
        rates.reshape(steps + 1, -1, 3),
        turns.reshape(steps + 1, -1, 4),
    )
    # beyond this limit the energy would overflow
    if not (np.abs(rates).max() <= LARGEST**3 and np.isfinite(turns).all()):
        turn = period * float(np.max(np.linalg.norm(omega, axis=-1)))
        raise MechanicsError(
            f"the {scheme} step has no finite solution: it began with {turn:g} rad per sample; "
            "shorten the period"
        )
    return Rotation(inertia, rates, turns)


@compiled
def _gyroscopic(inertia: Vector, omega: Vector) -> Vector:
    momentum = (inertia[0] * omega[0], inertia[1] * omega[1], inertia[2] * omega[2])
    return cross(omega, momentum)


@compiled
def _implicit_rate(inertia: Vector, before: Vector, torque: Vector, period: float) -> Vector:
    """Solves I(ω − before) + T (ω × Iω − τ) = 0 by Newton's method; nan if it fails."""
    i0, i1, i2 = inertia
    # (ω × Iω)_x = p ω_y ω_z, and so on around
    p, q, r = period * (i2 - i1), period * (i0 - i2), period * (i1 - i0)
    x, y, z = before
    for _ in range(ITERATIONS):
        fx = i0 * (x - before[0]) + p * y * z - period * torque[0]
        fy = i1 * (y - before[1]) + q * z * x - period * torque[1]
        fz = i2 * (z - before[2]) + r * x * y - period * torque[2]
        first, second, third = (i0, p * z, p * y), (q * z, i1, q * x), (r * y, r * x, i2)
        c0, c1, c2 = cross(second, third), cross(third, first), cross(first, second)
        determinant = first[0] * c0[0] + first[1] * c0[1] + first[2] * c0[2]
        dx = (c0[0] * fx + c1[0] * fy + c2[0] * fz) / determinant
        dy = (c0[1] * fx + c1[1] * fy + c2[1] * fz) / determinant
        dz = (c0[2] * fx + c1[2] * fy + c2[2] * fz) / determinant
        x, y, z = x - dx, y - dy, z - dz
        if norm((dx, dy, dz)) <= TOLERANCE * norm((x, y, z)):
            return x, y, z
    return np.nan, np.nan, np.nan


@compiled
def _turned(q: Quaternion, turn: Quaternion) -> Quaternion:
    """Returns q ⊗ turn, normalised so that rounding does not let the length drift."""
    w, x, y, z = product(q, turn)
    length = np.sqrt(w * w + x * x + y * y + z * z)
    return w / length, x / length, y / length, z / length


@compiled
def _integrate(
    inertia: Array, torque: Array, period: float, scheme: int, rates: Array, turns: Array
) -> None:
    """Fills rates (N + 1, n, 3) and turns (N + 1, n, 4) from their first rows."""
    for j in range(inertia.shape[0]):
        moments = (inertia[j, 0], inertia[j, 1], inertia[j, 2])
        omega = (rates[0, j, 0], rates[0, j, 1], rates[0, j, 2])
        q = (turns[0, j, 0], turns[0, j, 1], turns[0, j, 2], turns[0, j, 3])
        for k in range(1, rates.shape[0]):
            i = k - 1 if scheme <= 1 else k
            tau = (torque[i, j, 0], torque[i, j, 1], torque[i, j, 2])
            old = omega
            if scheme <= 1:
                g = _gyroscopic(moments, old)
                omega = (
                    old[0] + period * (tau[0] - g[0]) / moments[0],
                    old[1] + period * (tau[1] - g[1]) / moments[1],
                    old[2] + period * (tau[2] - g[2]) / moments[2],
                )
                turn = quaternion_exp(scaled(period, old if scheme == 0 else omega))
            elif scheme == 2:
                omega = _implicit_rate(moments, old, tau, period)
                turn = quaternion_exp(scaled(period, omega))
            else:
                # the midpoint rule is an implicit half step, extrapolated to the end
                m = _implicit_rate(moments, old, tau, period / 2)
                omega = (2 * m[0] - old[0], 2 * m[1] - old[1], 2 * m[2] - old[2])
                turn = (1.0, period / 2 * m[0], period / 2 * m[1], period / 2 * m[2])
            q = _turned(q, turn)
            rates[k, j, 0], rates[k, j, 1], rates[k, j, 2] = omega
            turns[k, j, 0], turns[k, j, 1], turns[k, j, 2], turns[k, j, 3] = q
