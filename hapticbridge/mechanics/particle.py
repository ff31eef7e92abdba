"""Point mass under a prescribed force, with four integrators and their generated energy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from hapticbridge.arguments import Array
from hapticbridge.errors import MechanicsError
from hapticbridge.mechanics.arguments import chosen, common_shape, finite, positive, step

Scheme = Literal["explicit", "semi_implicit", "implicit", "midpoint"]
SCHEMES = ("explicit", "semi_implicit", "implicit", "midpoint")


@dataclass(frozen=True, slots=True, eq=False)
class ParticleMotion:
    """Motion of a point mass at the samples 0 … N.

    Attributes:
        mass: m in kg, shape (...).
        force: f_k in N, shape (N + 1, ...).
        position: x_k in m, shape (N + 1, ...).
        velocity: v_k in m/s, shape (N + 1, ...).
    """

    mass: Array
    force: Array
    position: Array
    velocity: Array

    @property
    def kinetic_energy(self) -> Array:
        """½ m v_k² in J, shape (N + 1, ...)."""
        return 0.5 * self.mass * self.velocity**2

    @property
    def energy_gain(self) -> Array:
        """Energy gained beyond the work of the force at the samples 1 … N, in J, shape (N, ...).

            E_k = S_k − S_{k−1} − f_k (x_k − x_{k−1}),    S = ½ m v²

        The mass is passive if the sum of E_i up to every k is <= 0. By scheme:

            explicit        ½ m (v_k + v_{k−1})² − m v_{k−1} (v_{k−1} + v_{k+1})             (18)
            semi_implicit   ½ m (v_{k+1} − v_k)² with S_{k+1} − S_k in place of S_k − S_{k−1}
            implicit        −½ m (v_k − v_{k−1})² = −T² f_k² / (2 m) <= 0                    (16)
            midpoint        0

        ``semi_implicit`` counts the kinetic energy after the sample's force has acted. This storage
        differs from S by one step, so the sums differ by bounded terms only. If the motion
        overflows to inf or nan, the gain does too.

        References:
            Brown & Colgate 1997, eqs. (11), (13), (16), (18).
        """
        with np.errstate(over="ignore", invalid="ignore"):
            work = self.force[1:] * np.diff(self.position, axis=0)
            return np.diff(self.kinetic_energy, axis=0) - work


def integrate_particle(
    mass: ArrayLike,
    force: ArrayLike,
    period: float,
    scheme: Scheme,
    *,
    position: ArrayLike = 0.0,
    velocity: ArrayLike = 0.0,
) -> ParticleMotion:
    """Moves a point mass through a force sequence.

        explicit        v_k = v_{k−1} + (T/m) f_{k−1},   x_k = x_{k−1} + T v_{k−1}           (17)
        semi_implicit   v_k = v_{k−1} + (T/m) f_{k−1},   x_k = x_{k−1} + T v_k
        implicit        v_k = v_{k−1} + (T/m) f_k,       x_k = x_{k−1} + T v_k               (15)
        midpoint        v_k = v_{k−1} + (T/m) f_k,       x_k = x_{k−1} + T (v_{k−1} + v_k)/2

    f_k is the force that is known together with x_k; under ``midpoint`` it is the force of the step
    that ends at k. The sums are formed in closed form and hold for any T > 0.

    Args:
        mass: m in kg, finite and > 0, shape (...).
        force: f_0 … f_N in N, finite, time first: shape (N + 1, ...), N >= 1.
        period: T in s, finite and > 0.
        scheme: One of ``SCHEMES``.
        position: x_0 in m, shape (...).
        velocity: v_0 in m/s, shape (...).

    Raises:
        MechanicsError: An argument is not finite, out of range or mis-shaped.

    References:
        Brown & Colgate 1997, eqs. (15), (17).
    """
    chosen("scheme", scheme, SCHEMES)
    mass, period = positive("mass", mass, "kg"), step(period)
    position, velocity = finite("position", position, "m"), finite("velocity", velocity, "m/s")
    force = finite("force", force, "N")
    if force.ndim == 0 or len(force) < 2:
        raise MechanicsError(f"force has shape {force.shape}; it must be (N + 1, ...) with N >= 1")
    shape = common_shape(mass=mass, force=force[0], position=position, velocity=velocity)
    acting = force[1:] if scheme in {"implicit", "midpoint"} else force[:-1]
    gained = np.cumsum(period / mass * acting, axis=0)
    v = np.empty((len(force), *shape))
    v[0], v[1:] = velocity, velocity + gained
    mover = {"explicit": v[:-1], "midpoint": (v[:-1] + v[1:]) / 2}.get(scheme, v[1:])
    x = np.empty_like(v)
    x[0], x[1:] = position, position + period * np.cumsum(mover, axis=0)
    return ParticleMotion(mass, np.broadcast_to(force, v.shape), x, v)
