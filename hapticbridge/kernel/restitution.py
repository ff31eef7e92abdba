"""Restitution of rigid contacts and limits, paid for by the blow itself.

A row that closes in the step is a *blow* if its normal velocity v_n at the start, in m/s, is beyond
``BLOW_SPEED``. The step is then solved twice. In its *compression* the row is aimed at ŵ = 0, and
its normal impulse P_c in N s is noted. In its *restitution* the row is aimed at

    ŵ = ρ w,    0 <= ρ <= 1,    with a normal impulse of at most P_c + e Q_c

Q_c = P_c |v_n|/(|v_n| − h g_n) is the part of P_c that stops v_n, without what holds the free
acceleration g_n of the step, in m/s². The coefficient e is that of the row's own ``solref``. The
rebound w is e times the speed at the surface, taken to the place where the step ends
(``rebound_speed``); forces that press in the step count as in a flight, constraints do not. Of a
mocap body's move, δ/h is part of v_n and comes off ŵ again. The lift of sliding is subtracted as
ever. A step is repeated up to three times for an error of its rebounds beyond ``REBOUND_ERROR``,
and as often for the impulses; what is left then, stays. The sliding that a blow leaves is foreseen
by the friction of the last solution: a ball that skims the ground leaves it with its whole e.

That is Newton's rule where no friction couples normal and sliding, and elsewhere the smaller of
Newton's and Poisson's rebound. Newton's alone may create energy: 0.041 J with a rod of 1 kg that
falls at 1 m/s (e = 0.9), where Poisson's takes 0.144 J. Along Routh's path Poisson's takes energy
at any one point of a planar impact. Of several at once nothing of the kind is known, so each step
is judged. Its energy is, with C given by the rows and the remainder r,

    E_k = C − ½‖v⁺ − v‖²_M + r

A step with a blow is kept if C <= (share of the tank) + ``PAID`` ½‖v⁺ − v‖²_M. Then E_k is at most
what the tank holds, plus r − (1 − ``PAID``) ½‖v⁺ − v‖²_M. Otherwise it is repeated with a smaller
ρ, at last 0, which is the law without a blow. This needs no property of geometry or friction. What
friction losses of joints give counts in C: MuJoCo aims them at a share of v, and not of v⁺.
Without friction and other forces, C/(½‖v⁺ − v‖²_M) = 2e/(1 + e). Of a resting body, blows end.

One ρ holds for all blows of a step. A chain of bodies that touch passes a blow on as if they were
one body. Where a point slides back in the blow, the step's friction acts as at its end alone. A
lossless tool that is struck before it is seen near, from about 4 m/s on at 1 ms, pays nothing,
because its ½‖v⁺ − v‖²_M is no loss: its rebound is smaller.

References:
    Routh 1905 (the path of an impact); Anitescu & Potra 1997 (compression and restitution in a
    step); Stronge 1990, Proc. R. Soc. A 431 (Newton's rule and energy).
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from hapticbridge.kernel.codes import State
from hapticbridge.kernel.jit import compiled, source_of
from hapticbridge.kernel.mujoco_c import floats, ints, mj_mul_m

NOTABLE_BOUNCE = 0.2
"""Coefficient of restitution below which a rigid contact or limit does not bounce. MuJoCo's default
contact has 0.14, and is meant to rest."""

MAX_RESTITUTION = 0.98
"""Largest coefficient of restitution of a rigid contact or limit. It returns 2e/(1 + e) = 0.990 of
½‖v⁺ − v‖²_M; a larger one would not be paid for."""

PAID = 0.992
"""Share of the energy ½‖v⁺ − v‖²_M of a step that its blows may give back, without unit. The rest
covers the remainder of the integration."""

BLOW_SPEED = 0.05
"""Normal speed in m/s, of a hinge in rad/s, from which a contact that closes is a blow. A slower
one ends: it would rise by less than 0.13 mm and last 10 ms. A body at rest closes at h times its
acceleration, 0.01 m/s under its weight at 1 ms. A smaller value would let pressed bodies jitter."""

PRESSING = 1000.0
"""Acceleration in m/s² after a rebound for which the next contact is seen before it closes: 50 N on
50 g. What is pressed more sinks in by T² times the excess. A larger value costs time for contacts
without force, and keeps a lossless tool implicit farther from them."""


@compiled
def restitution(first: float, second: float) -> float:
    """Returns MuJoCo's coefficient of restitution of a contact, from 0 to 1.

    A spring and damper that only push let go where their force is zero, before the spring is at
    rest: e = exp(−ζ φ/s) with s = √(1 − ζ²), φ = atan2(2ζs, 2ζ² − 1); for ζ > 1 with s = √(ζ² − 1),
    φ = artanh(2ζs/(2ζ² − 1)). Critical damping, MuJoCo's default, has e = exp(−2) = 0.14. Without
    damping, e is 1. MuJoCo takes its default for two numbers of different signs.

    Args:
        first: Time constant in s of MuJoCo's ``solref``, or −k.
        second: Damping ratio ζ, or −b with ζ = b/(2√k).
    """
    ratio = 1.0
    if first > 0.0 and second > 0.0:
        ratio = second
    elif first < 0.0 and second <= 0.0:
        ratio = -second / (2.0 * math.sqrt(-first))
    root = math.sqrt(abs(1.0 - ratio**2))
    if root < 1e-6:
        return math.exp(-2.0)
    twice, rest = 2.0 * ratio * root, 2.0 * ratio**2 - 1.0
    angle = math.atan2(twice, rest) if ratio < 1.0 else math.atanh(twice / rest)
    return math.exp(-ratio / root * angle)


@compiled
def rigid_restitution(first: float, second: float) -> float:
    """Returns the coefficient with which a rigid contact or limit of this ``solref`` bounces.

    It is ``restitution``, at most ``MAX_RESTITUTION``, and 0 below ``NOTABLE_BOUNCE``.
    """
    e = restitution(first, second)
    return min(e, MAX_RESTITUTION) if e >= NOTABLE_BOUNCE else 0.0


@compiled
def square_at_surface(speed: float, gap: float, pressing: float, h: float) -> float:
    """Returns (|v| + ah/2)² + 2ag, the square of the speed at the surface in m²/s².

    A body that is pressed with the acceleration a keeps it through the samples of a flight, and a
    surface that it leaves or reaches between them is as good as one that it meets at a sample.

    Args:
        speed: |v_n| in m/s, at the start of the step of a blow or at its end.
        gap: Gap g in m at the start of the step.
        pressing: a in m/s², >= 0.
        h: Time step in s.
    """
    return (speed + 0.5 * h * pressing) ** 2 + 2.0 * pressing * gap


@compiled
def rebound_speed(e: float, speed: float, gap: float, pressing: float, h: float) -> float:
    """Returns the speed w in m/s at the end of a step whose blow leaves the surface with e.

    The step ends at the gap g + h w, so the rebound rises as high as one from the surface if

        (w + ah/2)² + 2ag = e² [(|v_n| + ah/2)² + 2ag]

    ``speed`` is |v_n| at its start; the others are as in ``square_at_surface``.
    """
    square = e**2 * square_at_surface(speed, gap, pressing, h) - 2.0 * pressing * gap
    return max(math.sqrt(max(square, 0.0)) - 0.5 * h * pressing, 0.0)


def has_bounce(model: mujoco.MjModel) -> bool:
    """Returns True if a contact or limit of the model may bounce.

    MuJoCo mixes ``solref`` of two geoms to no less damping than one of them has.
    """
    override = model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE
    limits = model.jnt_solref[model.jnt_limited != 0], model.tendon_solref_lim
    contacts = model.geom_solref, model.pair_solref, model.flex_solref
    everything = np.concatenate([*limits, *((model.opt.o_solref[None],) if override else contacts)])
    bounce = source_of(rigid_restitution)
    return any(bounce(*solref) > 0.0 for solref in np.unique(everything, axis=0).tolist())


@compiled
def kinetic_loss(s: State) -> float:
    """Returns ½‖v⁺ − v‖²_M in J of the step that just ended, without a tool that is lossless."""
    mj, lossless = s.mj, s.lossless
    start, end = floats(s.level.state_before + 8 * mj.nq, mj.nv), floats(mj.qvel, mj.nv)
    change = floats(s.contact.velocity_change, mj.nv)
    for i in range(mj.nv):
        change[i] = end[i] - start[i]
        if lossless.is_midpoint and ints(lossless.dof_in_tree, mj.nv)[i] != 0:
            change[i] = 0.0
    mj_mul_m(mj.model, mj.data, s.contact.momentum_change, s.contact.velocity_change)
    momentum, total = floats(s.contact.momentum_change, mj.nv), 0.0
    for i in range(mj.nv):
        total += 0.5 * change[i] * momentum[i]
    return total
