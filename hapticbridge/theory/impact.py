"""Planar impact of a rigid body on the ground with Coulomb friction, after Routh."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.arguments import Array, shown
from hapticbridge.errors import MechanicsError
from hapticbridge.theory.rigid_body import CHECK

# Normal velocity of an impact over its normal impulse


@dataclass(frozen=True, slots=True)
class NormalPath:
    """Piecewise linear v_n(P_n): slope ``first`` up to ``corner``, then slope ``second`` > 0.

    If ``first`` <= 0 (a jam), the corner is finite: μ|G| >= D and A D > G² give μA > |G|.

    Attributes:
        start: v_n at P_n = 0 in m/s, < 0.
        first: dv_n/dP_n up to the corner in 1/kg, any sign.
        second: dv_n/dP_n beyond the corner in 1/kg, > 0.
        corner: P_n at which the slip ends in N s, >= 0; inf if it never ends.
    """

    start: Array
    first: Array
    second: Array
    corner: Array

    def impulse_at(self, target: Array) -> Array:
        """Returns P_n at which v_n reaches a target >= 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            early = np.where(self.first > 0, (target - self.start) / self.first, np.inf)
        corner = np.where(np.isfinite(self.corner), self.corner, 0.0)
        at_corner = self.start + self.first * corner
        late = corner + (target - at_corner) / self.second
        return np.where(early <= self.corner, early, late)

    def impulse_after_work(self, compression: Array, e: Array) -> Array:
        """Returns P_n at which restitution has returned e² of the work done in compression."""
        corner = np.where(np.isfinite(self.corner), self.corner, 0.0)
        at_corner = self.start + self.first * corner
        turns_early = compression <= self.corner  # compression ends in the first segment
        # ∫ v_n dP_n up to P_c: one triangle, or a trapezium and a triangle
        taken = np.where(
            turns_early,
            0.5 * self.start * compression,
            0.5 * (self.start + at_corner) * corner + 0.5 * at_corner * (compression - corner),
        )
        returned = -(e**2) * taken
        slope = np.where(turns_early, self.first, self.second)
        # for a slope <= 0 the other branch below is used
        with np.errstate(divide="ignore", invalid="ignore"):
            plain = compression + np.sqrt(2 * returned / slope)
        # Restitution that begins before the corner may continue beyond it by q, a root of
        # ½ second q² + v q = rest. This form of the root does not cancel for a small rest.
        speed = np.maximum(at_corner, 0.0)
        rest = np.maximum(returned - 0.5 * speed * (corner - compression), 0.0)
        root = speed + np.sqrt(speed**2 + 2 * self.second * rest)
        beyond = corner + 2 * rest / np.where(root > 0, root, 1.0)
        return np.where(turns_early & (plain > self.corner), beyond, plain)


Law = Literal["newton", "poisson", "stronge"]
LAWS = ("newton", "poisson", "stronge")


class Mode(IntEnum):
    """Tangential behaviour of the contact point during an impact.

    ``SLIDING`` includes a contact that starts without tangential velocity and then slides one way.
    A contact that sticks does not slip; a round body then rolls.

    References:
        Routh 1905; Wang & Mason 1992, J. Applied Mechanics 59, table 1.
    """

    SLIDING = 0
    STICKS_IN_COMPRESSION = 1
    STICKS_IN_RESTITUTION = 2
    REVERSES_IN_COMPRESSION = 3
    REVERSES_IN_RESTITUTION = 4


@dataclass(frozen=True, slots=True, eq=False)
class ImpactBody:
    """Rigid body hit at one point, in the contact frame: t tangential, n normal.

    An impulse P at the contact point changes that point's velocity by

        Δv_t = A P_t − G P_n,   Δv_n = D P_n − G P_t
        A = 1/m + r_n²/I,   D = 1/m + r_t²/I,   G = r_t r_n/I

    Attributes:
        mass: m in kg, finite and > 0, shape (...).
        inertia: I about the centre of mass in kg m², finite and > 0, shape (...).
        arm: r = (r_t, r_n) from the centre of mass to the contact point in m, shape (..., 2).

    Raises:
        MechanicsError: A value is not finite, out of range or mis-shaped.
    """

    mass: ArrayLike
    inertia: ArrayLike
    arm: ArrayLike

    def __post_init__(self) -> None:
        arm = CHECK.numbers("arm", self.arm, "m")
        if arm.shape[-1:] != (2,):
            raise MechanicsError(f"arm has shape {arm.shape}; it must be (..., 2): r_t, r_n in m")
        mass = CHECK.numbers("mass", self.mass, "kg", least=0, is_open=True)
        inertia = CHECK.numbers("inertia", self.inertia, "kg m²", least=0, is_open=True)
        CHECK.shape(mass=mass, inertia=inertia, arm=arm[..., 0])
        object.__setattr__(self, "mass", mass)
        object.__setattr__(self, "inertia", inertia)
        object.__setattr__(self, "arm", arm)

    def compliance(self) -> tuple[Array, Array, Array]:
        """Returns A, D and G in 1/kg, each of shape (...)."""
        mass, inertia, arm = (np.asarray(a) for a in (self.mass, self.inertia, self.arm))
        tangential, normal = arm[..., 0], arm[..., 1]
        return (
            1 / mass + normal**2 / inertia,
            1 / mass + tangential**2 / inertia,
            tangential * normal / inertia,
        )

    def velocity_change(self, impulse: ArrayLike) -> Array:
        """Returns the change of the body's velocity due to an impulse at the contact.

        Args:
            impulse: (P_t, P_n) on this body in N s, shape (..., 2).

        Returns:
            Change of (V_t, V_n, ω) of the centre of mass in m/s and rad/s, shape (..., 3).

        Raises:
            MechanicsError: The impulse is not finite or mis-shaped.
        """
        impulse = CHECK.numbers("impulse", impulse, "N s")
        if impulse.shape[-1:] != (2,):
            raise MechanicsError(
                f"impulse has shape {impulse.shape}; it must be (..., 2): P_t, P_n"
            )
        mass, inertia, arm = (np.asarray(a) for a in (self.mass, self.inertia, self.arm))
        CHECK.shape(body=self.compliance()[0], impulse=impulse[..., 0])
        moment = arm[..., 0] * impulse[..., 1] - arm[..., 1] * impulse[..., 0]
        changes = (impulse[..., 0] / mass, impulse[..., 1] / mass, moment / inertia)
        return np.stack(np.broadcast_arrays(*changes), axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Impact:
    """Outcome of an impact, in the contact frame.

    Attributes:
        impulse: (P_t, P_n) on the body in N s, shape (..., 2).
        velocity: Relative velocity (v_t, v_n) at the contact after the impact in m/s, shape (...,
            2).
        compression: P_n at the end of compression in N s, shape (...).
        energy_change: Kinetic energy of all bodies after minus before in J, ½ P·(v⁻ + v⁺).
        mode: ``Mode`` of each impact, shape (...).
    """

    impulse: Array
    velocity: Array
    compression: Array
    energy_change: Array
    mode: NDArray[np.int8]


def resolve_impact(
    body: ImpactBody,
    velocity: ArrayLike,
    friction: ArrayLike,
    restitution: ArrayLike,
    law: Law = "stronge",
) -> Impact:
    """Returns the impact of a body on the ground, at one point.

    As the normal impulse P_n grows, with s = sgn(v_t⁻), Routh's path is

        slide           dP_t = −μ s dP_n       until v_t = 0 at P_s = |v_t⁻|/(μA + sG), if > 0
        then stick      dP_t = (G/A) dP_n      if μA >= |G|
        or slide back   dP_t = μ sgn(G) dP_n   if μA < |G|

    Compression ends at v_n = 0 (P_n = P_c). The law of restitution ends the impact:

        newton     v_n⁺ = −e v_n⁻
        poisson    P_n = (1 + e) P_c
        stronge    work of P_n after P_c = −e² · work until P_c

    In a jam (D + μsG <= 0) sliding drives the body into the ground. The path then continues through
    P_s, where the jam always ends. Poisson and Stronge never gain energy. Newton gains energy in
    about 1 % of random impacts and is included for comparison.

    Valid for one contact point, no change of pose during the impact, and dry friction with one
    coefficient.

    Args:
        body: The body; n points into it.
        velocity: Velocity (v_t, v_n) of the contact point in m/s, shape (..., 2), approaching:
            v_n < 0.
        friction: μ, finite and >= 0, shape (...).
        restitution: e in [0, 1], shape (...).
        law: One of ``LAWS``.

    Raises:
        MechanicsError: An argument is not finite, out of range or mis-shaped, or the arguments
            differ so much that the impulse overflows.

    References:
        Routh 1905, Dynamics of a System of Rigid Bodies I, art. 182 ff.; Stronge 1990, Proc. R.
        Soc. A 431; Brown & Colgate 1997, section 4.
    """
    CHECK.one_of("law", law, LAWS)
    velocity = CHECK.numbers("velocity", velocity, "m/s")
    if velocity.shape[-1:] != (2,):
        raise MechanicsError(f"velocity has shape {velocity.shape}; it must be (..., 2): v_t, v_n")
    v_t, v_n = velocity[..., 0], velocity[..., 1]
    if np.any(v_n >= 0):
        raise MechanicsError(
            f"normal velocity is {v_n.max():g} m/s; it must be < 0: bodies that do not approach "
            "do not collide"
        )
    mu = CHECK.numbers("friction", friction, "(no unit)", least=0)
    e = CHECK.numbers("restitution", restitution, "(no unit)", least=0, most=1)
    if not isinstance(body, ImpactBody):
        raise MechanicsError(f"body is {shown(body)}; it must be an ImpactBody")
    a, d, g = body.compliance()
    CHECK.shape(body=a, velocity=v_t, friction=mu, restitution=e)

    # overflow is refused below, and results of a division by zero are not used
    with np.errstate(all="ignore"):
        side = np.sign(v_t)
        braking = mu * a + side * g
        # P_s: 0 without tangential velocity (no first segment), inf if sliding accelerates
        slide_end = np.where(braking > 0, np.abs(v_t) / braking, np.inf)
        slide_end = np.where(side == 0, 0.0, slide_end)
        sticks = mu * a >= np.abs(g)
        later_slope = np.where(sticks, g / a, mu * np.sign(g))
        first = d + mu * side * g  # dv_n/dP_n while sliding
        # dv_n/dP_n afterwards: D − G²/A = (A D − G²)/A, plus a term for sliding back. Both terms
        # are >= 0, so nothing cancels.
        second = _determinant(body) / a
        second = second + np.where(sticks, 0.0, np.abs(g) * (np.abs(g) / a - mu))
        path = NormalPath(v_n, first, second, slide_end)

        compression = path.impulse_at(np.zeros_like(v_n))
        if law == "newton":
            normal = path.impulse_at(-e * v_n)
        elif law == "poisson":
            normal = (1 + e) * compression
        else:
            normal = path.impulse_after_work(compression, e)
        sliding = np.minimum(normal, slide_end)
        tangential = later_slope * (normal - sliding) - mu * side * sliding
        impulse = np.stack(np.broadcast_arrays(tangential, normal), axis=-1)
        after = np.stack(
            np.broadcast_arrays(
                v_t + a * tangential - g * normal, v_n + d * normal - g * tangential
            ),
            axis=-1,
        )
        energy = 0.5 * np.sum(impulse * (velocity + after), axis=-1)
    if not (np.isfinite(impulse).all() and np.isfinite(after).all() and np.isfinite(energy).all()):
        raise MechanicsError("masses, arms and velocities lie too far apart for double precision")
    mode = np.where(sticks, Mode.STICKS_IN_COMPRESSION, Mode.REVERSES_IN_COMPRESSION)
    mode = np.where(slide_end > compression, mode + 1, mode)
    mode = np.where((slide_end >= normal) | ((side == 0) & ~sticks), Mode.SLIDING, mode)
    return Impact(impulse, after, compression, energy, mode.astype(np.int8))


def _determinant(body: ImpactBody) -> Array:
    """Returns A D − G² in 1/kg² without cancellation; it is > 0 for every body."""
    mass, inertia, arm = (np.asarray(a) for a in (body.mass, body.inertia, body.arm))
    return np.asarray((1 / mass + (arm**2).sum(axis=-1) / inertia) / mass)
