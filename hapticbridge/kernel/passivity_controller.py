"""The energy account of both ports, and the controller that keeps it balanced.

What is held is known exactly one tick later: the wrench w_{k-1} did the work w_{k-1}·δp_k on the
device, whatever happened in between.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import CONTROLLER_ACTIVE, FORCE_OFF
from hapticbridge.kernel.parameters import DAMPER, ENVIRONMENT
from hapticbridge.pose import Vector, scaled

THRESHOLD = 1e-5
"""In J. The controller acts on a debt above it. Rounding and the first-order error of turning tools
stay below; a limit cycle that a hand could feel (0.1 mm at 2400 N/m) holds it in one swing."""

TANK_START = 5e-3
"""In J: what the tank holds at first. It must lend what a spring gives back before the account has
seen it: 5 N at 2400 N/m hold 5 mJ. More lets a larger kick pass, less softens contacts."""

SWINGS, WINDOW = 4, 8
"""So many reversals of the motion within so many ticks tell that an axis swings from sample to
sample. A mass of 0.1 kg on 40 000 N/m reverses once in five ticks, a worst hand in each."""

BOUND = 1.6
"""Of b/T, without unit: 2 is the stiffness at which a damper alone, held by the worst hand, swings
for ever; at 1.6 a swing loses 40 % from tick to tick. Less makes walls soft for longer."""


@compiled
def unpaid(state: NDArray[np.void]) -> float:
    """Returns in J what the device was given beyond what the hand put in, by the last count.

        given + r min(S − S_0, 0),   r = force_scale/scale

    ``given`` is w·δp − b δp²/t summed; S_0 is what the scene stored when the run began: what it has
    given up of that has paid.
    """
    s = state[0]
    lost = min(s.kinetic + s.potential - s.start_energy, 0.0)
    return float(s.given + (s.force_scale / s.scale) * lost)


@compiled
def observe_energy(state: NDArray[np.void], moved: Vector, turned: Vector, interval: float) -> None:
    """Adds what the last tick gave to the device, burnt there and took up in the scene.

        A_k = max(A_{k-1} + w_{k-1}·δp_k − b δp_k²/t + r c (S_{k-1} − S_{k-2} − W), −surplus)

    S is what the scene stores, W the work of its own motors and of user forces, r = force_scale /
    scale, and c the share of the wrench that the guard let through. What a certified device gets
    keeps A <= 0 (BC97 (6)); what the environment creates enters through S, what the hold leaks
    through w·δp − b δp²/t, so one account covers both ports. A surplus is capped: an hour of
    dissipation does not pay for a minute of activity.

    ``excess`` is what the environment's port owes alone, Σ E_k − Σ ½‖δx_k‖²_{K+B/T}, with its own
    surplus capped in the same way.

    ``kicked`` is what the device was given beyond what the hand put in (``unpaid``). Motors of the
    scene pay for nothing there.

    ``unfelt`` is what the scene took up of a handle that moved it while the force was off by
    command, and still has: no hand has put that in (``kernel.tuning.forget_dissipation``).

    Args:
        state: The bound state, as the tick before left it.
        moved: δp in m, in the device's frame.
        turned: Its rotation vector.
        interval: t in s, since the device's last new sample.
    """
    s = state[0]
    stored = s.kinetic + s.potential - s.start_energy
    over = s.environment_energy - s.slack
    s.excess = max(s.excess + (over - s.excess_before), -s.surplus)
    s.excess_before = over
    own = stored - s.actuator_work - s.external_work
    gained = (s.force_scale / s.scale) * s.passed * (own - s.own_before)
    kept = max(s.kinetic + s.potential - s.start_energy, 0.0)
    taken = own - s.own_before if s.commanded & FORCE_OFF else 0.0
    s.unfelt = min(max(s.unfelt + taken, 0.0), kept)
    s.own_before = own
    # before the first tick and in a pause nobody knows how long the device took to move
    rate = 1.0 / interval if s.tick > s.ramp_start else 0.0
    given = 0.0
    w, a = s.wrench_on_device, s.axis_account
    for i in range(3):
        linear = (w[i] - s.credit * rate * moved[i]) * moved[i]
        angular = (w[3 + i] - s.rotational_credit * rate * turned[i]) * turned[i]
        a[i] = max(a[i] + linear, -s.surplus)
        a[3 + i] = max(a[3 + i] + angular, -s.surplus)
        given += linear + angular
    s.account = max(s.account + given + gained, -s.surplus)
    s.given += given
    s.kicked = unpaid(state)
    for i in range(6):
        u = rate * (moved[i] if i < 3 else turned[i - 3])
        has_reversed = 1 if u * s.device_velocity[i] < 0.0 else 0
        s.reversals[i] = ((s.reversals[i] << 1) | has_reversed) & (2**WINDOW - 1)
        s.device_velocity[i] = u


@compiled
def _swings(state: NDArray[np.void], i: int) -> bool:
    """Tells whether an axis moves to and fro from sample to sample."""
    bits, count = state[0].reversals[i], 0
    for _ in range(WINDOW):
        count += bits & 1
        bits >>= 1
    return bool(count >= SWINGS)


@compiled
def _held_back(
    state: NDArray[np.void], first: int, axis: int, f: float, most: float, debt: float
) -> tuple[float, float]:
    """Returns one component of the wrench with what is owed on its axis, and the damping added."""
    s = state[0]
    i = first + axis
    u = s.device_velocity[i]
    owed = min(debt, s.axis_account[i])
    if not owed > 0.0:
        return f, 0.0
    damping = min(owed / (s.period * u * u), most) if u != 0.0 else 0.0
    f -= damping * u
    if not _swings(state, i):
        return f, damping
    # from tick to tick the force may follow the motion no faster than the device's damper bears
    change = BOUND * most * abs(u)
    return min(max(f, s.slewed[i] - change), s.slewed[i] + change), damping


@compiled
def _from_tank(state: NDArray[np.void], force: Vector, torque: Vector) -> tuple[Vector, Vector]:
    """Scales the wrench to what the tank can pay for over the next tick."""
    s = state[0]
    u = s.device_velocity
    work = force[0] * u[0] + force[1] * u[1] + force[2] * u[2]
    work += torque[0] * u[3] + torque[1] * u[4] + torque[2] * u[5]
    work *= s.period
    level = max(TANK_START - s.account, 0.0)
    if work > level:
        share = level / work
        force, torque = scaled(share, force), scaled(share, torque)
        s.flags |= CONTROLLER_ACTIVE
    return force, torque


@compiled
def control(state: NDArray[np.void], force: Vector, torque: Vector) -> tuple[Vector, Vector]:
    """Returns the wrench with what the controller does to it.

    Damper, on each axis that was itself given more than it returned while the account is in debt:

        f ← f − α v,   α = min(debt/(T v²), b, m/T),   then   |f_k − f_{k−1}| <= 1.6 (b/T) |δp_k|

    Unclipped, α grows beyond all bounds as v goes to zero and is active itself. It mends a device
    with mass. Where the hand makes the loop swing from sample to sample, v is a sample late and
    damping only adds to it: there the second bound, that of energy-bounding control, lowers the
    stiffness that is felt until the damper bears it.

    For the environment's port alone the debt is what it created beyond the slack that the coupling
    leaves it, ``excess`` as the tick before left it: up to there a device that bears its coupling
    stays passive whatever the environment does. Beyond, the damper acts as above, until each axis
    has burnt or given back what it was given. A damper on the tool would sit nearer to the cause,
    and makes contacts create more (as scaling the tool's velocity does).

    Behind the damper a tank scales the wrench so that the work it does over the next tick, at the
    speed of the last one, is no more than what the tank holds. It pays what α cannot because it is
    clipped, and does not act in such a swing, where the speed of the last tick says nothing of the
    next.

    References:
        Hannaford & Ryu 2002 (damper); Kim & Ryu 2010 (bound); Franken et al. 2011 (tank).
    """
    s = state[0]
    s.injected_damping = s.injected_rotational_damping = 0.0
    if s.controller == DAMPER or (s.controller == ENVIRONMENT and s.has_law):
        debt = s.account - THRESHOLD
        if s.controller == ENVIRONMENT:
            debt = s.excess - THRESHOLD
        if debt > 0.0:
            b, b_r = s.most_damping, s.most_rotational_damping
            x, on_x = _held_back(state, 0, 0, force[0], b, debt)
            y, on_y = _held_back(state, 0, 1, force[1], b, debt)
            z, on_z = _held_back(state, 0, 2, force[2], b, debt)
            rx, on_rx = _held_back(state, 3, 0, torque[0], b_r, debt)
            ry, on_ry = _held_back(state, 3, 1, torque[1], b_r, debt)
            rz, on_rz = _held_back(state, 3, 2, torque[2], b_r, debt)
            s.injected_damping = max(on_x, on_y, on_z)
            s.injected_rotational_damping = max(on_rx, on_ry, on_rz)
            is_damped = s.injected_damping > 0.0 or s.injected_rotational_damping > 0.0
            if is_damped or (x, y, z) != force or (rx, ry, rz) != torque:
                s.flags |= CONTROLLER_ACTIVE
            force, torque = (x, y, z), (rx, ry, rz)
            is_swinging = s.controller == ENVIRONMENT  # the tank counts the other debt
            for i in range(6):
                is_swinging = is_swinging or _swings(state, i)
            if not is_swinging:
                force, torque = _from_tank(state, force, torque)
    return force, torque
