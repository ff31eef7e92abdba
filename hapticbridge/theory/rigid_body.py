"""Point mass, coupled mass and turning rigid body, with integrators of known energy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.arguments import LARGEST, Arguments, Array
from hapticbridge.coupling import Coupling
from hapticbridge.errors import MechanicsError
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.pose import (
    Vector,
    add,
    cross,
    dot,
    norm,
    product,
    quaternion_exp,
    quaternion_of,
    scaled,
    store_quaternion,
    store_vector,
    subtract,
    vector_of,
)
from hapticbridge.theory.transfer import spring_and_damper

MAX_STEPS = 10**8
"""Largest length of a run in steps: a day at 1 kHz, which still fits into memory."""

CHECK = Arguments(MechanicsError)
"""Argument checks of the reference mechanics."""


# Point mass under a prescribed force, with four integrators and the energy they create

StepRule = Literal["explicit", "semi_implicit", "implicit", "midpoint"]
STEP_RULES = ("explicit", "semi_implicit", "implicit", "midpoint")


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

        The mass is passive if the sum of E_i up to every k is <= 0. By rule:

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
    rule: StepRule,
    *,
    velocity: ArrayLike = 0.0,
) -> ParticleMotion:
    """Moves a point mass from the origin through a force sequence.

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
        rule: One of ``STEP_RULES``.
        velocity: v_0 in m/s, shape (...).

    Raises:
        MechanicsError: An argument is not finite, out of range or mis-shaped.

    References:
        Brown & Colgate 1997, eqs. (15), (17).
    """
    CHECK.one_of("rule", rule, STEP_RULES)
    mass = CHECK.numbers("mass", mass, "kg", least=0, is_open=True)
    period = CHECK.number("period", period, "s", least=0, is_open=True)
    velocity = CHECK.numbers("velocity", velocity, "m/s")
    force = CHECK.numbers("force", force, "N")
    if force.ndim == 0 or len(force) < 2:
        raise MechanicsError(f"force has shape {force.shape}; it must be (N + 1, ...) with N >= 1")
    shape = CHECK.shape(mass=mass, force=force[0], velocity=velocity)
    acting = force[1:] if rule in {"implicit", "midpoint"} else force[:-1]
    gained = np.cumsum(period / mass * acting, axis=0)
    v = np.empty((len(force), *shape))
    v[0], v[1:] = velocity, velocity + gained
    mover = {"explicit": v[:-1], "midpoint": (v[:-1] + v[1:]) / 2}.get(rule, v[1:])
    x = np.zeros_like(v)
    x[1:] = period * np.cumsum(mover, axis=0)
    return ParticleMotion(mass, np.broadcast_to(force, v.shape), x, v)


# Point mass driven by a handle through the coupling, with four integrators

CoupledStepRule = Literal["held", "implicit", "compensated", "midpoint"]
COUPLED_STEP_RULES = ("held", "implicit", "compensated", "midpoint")


def drive_mass(
    coupling: Coupling,
    mass: ArrayLike,
    handle: ArrayLike,
    period: float,
    rule: CoupledStepRule,
) -> ParticleMotion:
    """Moves a free mass, at first at rest at h_0, by the coupling to a handle with given motion.

    In the result ``force`` acts on the mass; the device receives −f_k. f_0 acts only in the rule
    ``held``. ``energy_gain`` is 0 under ``midpoint``, and −½ m (v_k − v_{k−1})² under ``implicit``
    and ``compensated``.

    With e = h − x and M for the mass:

        held         f_k = K e_k + (B/T)(e_k − e_{k−1}),            v_k = v_{k−1} + (T/M) f_{k−1},
                     x_k = x_{k−1} + T v_k
        implicit     f_k as for held,                               v_k = v_{k−1} + (T/M) f_k,
                     x_k = x_{k−1} + T v_k
        compensated  implicit with max(B − K T, 0) for B
        midpoint     f_k = K (e_k + e_{k−1})/2 + (B/T)(e_k − e_{k−1}),
                     v_k = v_{k−1} + (T/M) f_k,   x_k = x_{k−1} + T (v_{k−1} + v_k)/2

    ``held`` creates energy and is stable only above a certain mass (K T²/4 without damping).
    Below it the motion grows until it overflows to inf or nan. The other rules are stable for
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
        rule: One of ``COUPLED_STEP_RULES``.

    Raises:
        MechanicsError: An argument is not finite, out of range or mis-shaped.

    References:
        Brown & Colgate 1997, eqs. (4), (15); Kim, Lee et al. 2017, "Haptic rendering and
        interactive simulation using passive midpoint integration", Int. J. Robotics Research 36.
    """
    CHECK.one_of("rule", rule, COUPLED_STEP_RULES)
    mass = CHECK.numbers("mass", mass, "kg", least=0, is_open=True)
    period = CHECK.number("period", period, "s", least=0, is_open=True)
    h = CHECK.numbers("handle position", handle, "m")
    if h.ndim == 0 or len(h) < 2:
        raise MechanicsError(f"handle has shape {h.shape}; it must be (N + 1, ...) with N >= 1")
    k, b = spring_and_damper(coupling)
    shape = CHECK.shape(mass=mass, handle=h[0], coupling=k + b)
    if rule == "compensated":
        b = np.maximum(b - k * period, 0)
    f, x, v = np.zeros((3, len(h), *shape))
    x[0] = h[0]
    # weight of the step's end in the spring's mean stretch
    end_weight = 0.5 if rule == "midpoint" else 1.0
    # f = idle − loss · (x_k − x_{k−1})/T, with idle the force on a mass that stays where it is
    loss = b + end_weight * k * period
    with np.errstate(over="ignore", invalid="ignore"):
        for i in range(1, len(h)):
            moved = h[i] - h[i - 1]
            idle = k * (h[i - 1] + end_weight * moved - x[i - 1]) + b / period * moved
            if rule == "held":
                v[i] = v[i - 1] + period / mass * f[i - 1]
                mean = v[i]
            elif rule == "midpoint":
                mean = (2 * mass * v[i - 1] + period * idle) / (2 * mass + period * loss)
                v[i] = 2 * mean - v[i - 1]
            else:
                v[i] = (mass * v[i - 1] + period * idle) / (mass + period * loss)
                mean = v[i]
            x[i] = x[i - 1] + period * mean
            f[i] = idle - loss * mean
    return ParticleMotion(mass, f, x, v)


def exact_mass_response(
    coupling: Coupling, mass: ArrayLike, frequency: ArrayLike
) -> NDArray[np.complex128]:
    """Returns X/H of a mass behind an unsampled coupling, the reference of the four rules.

        X/H = (K + jωB) / (K + jωB − M ω²),    ω = 2π · frequency

    Mass in kg and frequency in Hz must be finite and > 0, and broadcast; otherwise MechanicsError
    is raised. At the resonance of an undamped mass X/H is inf.
    """
    mass = CHECK.numbers("mass", mass, "kg", least=0, is_open=True)
    frequency = CHECK.numbers("frequency", frequency, "Hz", least=0, is_open=True)
    CHECK.shape(mass=mass, frequency=frequency)
    omega = 2 * np.pi * frequency
    stiffness, damping = spring_and_damper(coupling)
    impedance = stiffness + 1j * omega * damping
    rest = impedance - mass * omega**2
    with np.errstate(divide="ignore", invalid="ignore"):
        response = impedance / rest
    return np.asarray(np.where(rest == 0, np.inf, response), dtype=np.complex128)


TOLERANCE = 1e-12
"""Relative change of the angular velocity, without unit, at which Newton's iteration ends. The
iteration converges quadratically, so the remaining error is far below rounding. At 1e-16 it would
never end; above 1e-8 energy would drift."""

ITERATIONS = 50
"""Largest number of Newton iterations per step. At T |ω| < 0.5 rad 3 to 5 are enough; a step that
exceeds it counts as too long."""


@dataclass(frozen=True, slots=True, eq=False)
class Rotation:
    """Free rotation of a rigid body at the samples 0 … N.

    Attributes:
        inertia: Principal moments in kg m², shape (3,).
        angular_velocity: ω_k in the body's principal frame in rad/s, shape (N + 1, 3).
        orientation: q_k, body to world, (w, x, y, z), shape (N + 1, 4).
    """

    inertia: Array
    angular_velocity: Array
    orientation: Array

    @property
    def kinetic_energy(self) -> Array:
        """½ ωᵀ I ω in J, shape (N + 1,)."""
        return np.asarray(0.5 * self.angular_velocity**2 @ self.inertia)

    @property
    def angular_momentum(self) -> Array:
        """R I ω in the world frame in kg m²/s, shape (N + 1, 3)."""
        local = self.inertia * self.angular_velocity
        w, u = self.orientation[:, :1], self.orientation[:, 1:]
        t = 2 * np.cross(u, local)
        return np.asarray(local + w * t + np.cross(u, t))


def integrate_rotation(
    inertia: ArrayLike, angular_velocity: ArrayLike, period: float, steps: int, rule: StepRule
) -> Rotation:
    """Turns a free rigid body.

    With a(ω) = −I⁻¹(ω × Iω) and ω̄ = (ω_{k−1} + ω_k)/2:

        explicit        ω_k = ω_{k−1} + T a(ω_{k−1}),   q_k = q_{k−1} ⊗ exp(T ω_{k−1})
        semi_implicit   ω_k as for explicit,            q_k = q_{k−1} ⊗ exp(T ω_k)
        implicit        ω_k = ω_{k−1} + T a(ω_k),       q_k = q_{k−1} ⊗ exp(T ω_k)
        midpoint        ω_k = ω_{k−1} + T a(ω̄),         q_k = q_{k−1} ⊗ cay(T ω̄)

    cay is the Cayley map, rotation by 2 atan(|Tω̄|/2). ``explicit`` and ``semi_implicit`` gain ½ T²
    aᵀ I a in every step, and ``implicit`` loses it. ``midpoint`` conserves the energy, and the
    momentum in the world frame, up to rounding. Above T |ω| of about 1 rad per sample the implicit
    rules are inaccurate and Newton's method may fail, which raises an error.

    Args:
        inertia: Principal moments in kg m², finite, > 0, none larger than the sum of the other two,
            shape (3,).
        angular_velocity: ω_0 in the body's frame in rad/s, shape (3,).
        period: T in s, finite and > 0.
        steps: N >= 1.
        rule: One of ``STEP_RULES``.

    Raises:
        MechanicsError: An argument is not finite, out of range or mis-shaped, or a step is too long
            to be solved.

    References:
        Simo & Wong 1991, Int. J. Numerical Methods in Engineering 31 (midpoint); the other three
        are Brown & Colgate's rules (15), (17) applied to Euler's equations.
    """
    CHECK.one_of("rule", rule, STEP_RULES)
    inertia = CHECK.numbers("inertia", inertia, "kg m²", least=0, is_open=True)
    period = CHECK.number("period", period, "s", least=0, is_open=True)
    omega = CHECK.numbers("angular velocity", angular_velocity, "rad/s")
    steps = CHECK.whole("steps", steps, least=1, most=MAX_STEPS)
    for name, array in (("inertia", inertia), ("angular velocity", omega)):
        if array.shape != (3,):
            raise MechanicsError(f"{name} has shape {array.shape}; it must be (3,)")
    # 1e-12 admits a flat body, whose largest moment equals the sum of the others up to rounding
    if 2 * inertia.max() > inertia.sum() * (1 + 1e-12):
        raise MechanicsError(
            "a principal moment exceeds the sum of the other two, which no rigid body has; "
            "correct the moments of inertia"
        )
    rates, turns = np.empty((steps + 1, 3)), np.empty((steps + 1, 4))
    rates[0], turns[0] = omega, (1.0, 0.0, 0.0, 0.0)
    _integrate(inertia, period, STEP_RULES.index(rule), rates, turns)
    # beyond this limit the energy would overflow
    if not (np.abs(rates).max() <= LARGEST**3 and np.isfinite(turns).all()):
        raise MechanicsError(
            f"the {rule} step has no finite solution: it began with "
            f"{period * float(np.linalg.norm(omega)):g} rad per sample; shorten the period"
        )
    return Rotation(inertia, rates, turns)


@compiled
def _implicit_rate(inertia: Vector, before: Vector, period: float) -> Vector:
    """Solves I(ω − before) + T ω × Iω = 0 by Newton's method; nan if it fails."""
    i0, i1, i2 = inertia
    # (ω × Iω)_x = p ω_y ω_z, and so on around
    p, q, r = period * (i2 - i1), period * (i0 - i2), period * (i1 - i0)
    x, y, z = before
    for _ in range(ITERATIONS):
        fx = i0 * (x - before[0]) + p * y * z
        fy = i1 * (y - before[1]) + q * z * x
        fz = i2 * (z - before[2]) + r * x * y
        first, second, third = (i0, p * z, p * y), (q * z, i1, q * x), (r * y, r * x, i2)
        c0, c1, c2 = cross(second, third), cross(third, first), cross(first, second)
        sums = add(add(scaled(fx, c0), scaled(fy, c1)), scaled(fz, c2))
        step = scaled(1.0 / dot(first, c0), sums)
        x, y, z = x - step[0], y - step[1], z - step[2]
        if norm(step) <= TOLERANCE * norm((x, y, z)):
            return x, y, z
    return np.nan, np.nan, np.nan


@compiled
def _integrate(inertia: Array, period: float, rule: int, rates: Array, turns: Array) -> None:
    """Fills rates (N + 1, 3) and turns (N + 1, 4) from their first rows."""
    moments, omega, q = vector_of(inertia), vector_of(rates[0]), quaternion_of(turns[0])
    for k in range(1, rates.shape[0]):
        old = omega
        if rule <= 1:
            g = cross(old, (moments[0] * old[0], moments[1] * old[1], moments[2] * old[2]))
            rate = (g[0] / moments[0], g[1] / moments[1], g[2] / moments[2])
            omega = subtract(old, scaled(period, rate))
            turn = quaternion_exp(scaled(period, old if rule == 0 else omega))
        elif rule == 2:
            omega = _implicit_rate(moments, old, period)
            turn = quaternion_exp(scaled(period, omega))
        else:
            # the midpoint rule is an implicit half step, extrapolated to the end
            m = _implicit_rate(moments, old, period / 2)
            omega = subtract(scaled(2.0, m), old)
            turn = (1.0, period / 2 * m[0], period / 2 * m[1], period / 2 * m[2])
        w, x, y, z = product(q, turn)
        length = np.sqrt(w * w + x * x + y * y + z * z)  # rounding must not let it drift
        q = w / length, x / length, y / length, z / length
        store_vector(rates[k], omega)
        store_quaternion(turns[k], q)
