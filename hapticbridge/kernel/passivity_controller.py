"""Passivity observer and passivity controller: energy at the device, and the damping against it.

The observer knows the energy of a tick exactly one tick later: the wrench w_{k−1} did the work
w_{k−1}·δp_k on the device, for any motion in between.
"""

from __future__ import annotations

import math

import numpy as np

from hapticbridge.kernel.codes import CONTROLLER_ACTIVE, Part, State
from hapticbridge.kernel.hand_energy import INSTANT
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.law import held_energy, pulled
from hapticbridge.kernel.parameters import DAMPER, ENVIRONMENT, GuardParameters
from hapticbridge.kernel.pose import Vector, norm, scaled

THRESHOLD = 1e-5
"""Energy debt in J above which the controller acts. Rounding and the first-order error of turning
tools stay below it. A limit cycle that a hand can feel (0.1 mm at 2400 N/m) reaches it in one
swing."""

TANK_START = 5e-3
"""Energy in J that the tank holds at first. It lends what a spring returns before the observer has
seen it: 5 N at 2400 N/m store 5 mJ. A larger value lets a larger impulse pass; a smaller one
softens contacts."""

SWINGS, WINDOW = 4, 8
"""Reversals of the motion, and the ticks within which they count as swinging from sample to sample.
A mass of 0.1 kg on 40 000 N/m reverses once in five ticks, a worst-case hand in every tick."""

BOUND = 1.6
"""Largest change of the force per device motion, as a multiple of b/T; no unit. At 2, a damper
alone held by the worst-case hand swings forever; at 1.6 a swing loses 40 % per tick. A smaller
value makes walls soft for longer."""

FULL_TURN = 30.0
"""Largest angular velocity in rad/s of a hand that turns a stylus."""

AT_FULL_SPEED = 1.25
"""Energy that a jump to full speed may bring within one tick, as a multiple of the energy limit; no
unit. At 1, a force of 10 N would be cut at 5 m/s and 1 kHz before any energy was given."""

OBSERVER_DTYPE = np.dtype(
    [
        ("controller", "<i8"),
        ("flags", "<i8"),
        ("assumed_damping", "<f8"),
        ("assumed_rotational_damping", "<f8"),
        ("max_damping", "<f8"),
        ("max_rotational_damping", "<f8"),
        ("energy_credit_limit", "<f8"),
        ("resolution", "<f8"),
        ("hidden_energy", "<f8"),
        ("earlier_force", "<f8", 3),
        ("observed_energy", "<f8"),
        ("net_device_energy", "<f8"),
        ("guarded_energy", "<f8"),
        ("max_guarded_energy", "<f8"),
        ("hand_energy", "<f8"),
        ("max_hand_energy", "<f8"),
        ("springs", "<f8"),
        ("max_unpaid_energy", "<f8"),
        ("first_unpaid", "<i8"),
        ("most_paid", "<f8"),
        ("created_energy", "<f8"),
        ("previous_created", "<f8"),
        ("previous_net_storage", "<f8"),
        ("released", "<f8"),
        ("pushed", "<f8"),
        ("input_work", "<f8"),
        ("peak_motor_work", "<f8"),
        ("peak_input_work", "<f8"),
        ("previous_motor_work", "<f8"),
        ("previous_external_work", "<f8"),
        ("previous_environment", "<f8"),
        ("work_at_reset", "<f8"),
        ("is_reset", "<i8"),
        ("injected_damping", "<f8"),
        ("injected_rotational_damping", "<f8"),
        ("axis_energy", "<f8", 6),
        ("device_velocity", "<f8", 6),
        ("reversals", "<i8", 6),
    ]
)
"""Sub-record ``observer``, written by this module alone; symbols in ``observe_energy``. Dampings in
N s/m and N m s/rad, energies in J, velocities in m/s and rad/s. ``resolution`` is Δ in m,
``hidden_energy`` H of ``observe_energy``, ``earlier_force`` the force on the device one tick before
the last in N. ``max_guarded_energy`` is the largest ``guarded_energy`` so far. ``hand_energy`` is Σ
(w·δp − b ‖δp‖²/t − W_u) with its largest value, ``springs`` the energy of the coupling's springs at
the start and after each reset, ``max_unpaid_energy`` the largest unpaid energy
(``hand_energy.HandEnergy``), ``most_paid`` the largest energy that scene and springs had released
by then, for a device with a loop of its own, ``first_unpaid`` the first tick in which the unpaid
energy was more than ``hand_energy.INSTANT``, −1 for none. ``released`` and ``pushed`` are R and m
of ``observe_release``; ``input_work`` is the external work without that of resets. ``peak_*`` are
the works of largest size, ``previous_*`` those and Σ E one tick before; ``work_at_reset`` is W_c at
the last reset, ``is_reset`` 1 in the tick after it. ``reversals`` holds one bit per tick."""


def bind_observer(observer: Part, guarding: GuardParameters) -> None:
    """Fills in the controller and its limits."""
    observer["controller"] = guarding.controller
    observer["assumed_damping"] = guarding.assumed_damping
    observer["assumed_rotational_damping"] = guarding.assumed_rotational_damping
    observer["max_damping"] = guarding.max_damping
    observer["max_rotational_damping"] = guarding.max_rotational_damping
    observer["energy_credit_limit"] = guarding.energy_credit_limit
    observer["resolution"] = guarding.resolution
    observer["first_unpaid"] = -1


@compiled
def credit_springs(s: State) -> None:
    """Adds the present energy of the coupling's springs to what may reach the hand."""
    stretch, twist = pulled(s)
    s.observer.springs += held_energy(s, stretch, twist)


def observe_reset(s: State) -> None:
    """Accounts for a reset of the scene: storage that it replaced pays for no energy to the device.

    Must run before the first tick after the reset.
    """
    observer = s["observer"]
    ratio = float(s["run"]["force_scale"] / s["run"]["scale"])
    observer["net_device_energy"] -= ratio * observer["released"]
    observer["work_at_reset"] = s["energy"]["coupling_work"]
    observer["released"] = observer["pushed"] = 0.0
    observer["is_reset"] = 1


@compiled
def observe_release(s: State) -> None:
    """Updates the energy R in J that the scene's storage has given to the hand since the start.

        R = max(min(−W_c − m, S_0 − S), 0),    m_k = max(m_{k−1} + δW_p + min(E_k, 0), 0)

    W_c is the coupling's work on the scene since the start or reset, S the scene's storage less the
    work of the other hands. m is what motors and inputs have done and the scene has not burned; W_p
    are their works, without that of a reset. E_k is the created energy of tick k, negative if it is
    burned. So what bodies lose beside the tool, as one that falls to the floor, hides no motor that
    pushes later. A body that loses energy while a motor pushes hides it, by no more than what the
    scene has lost: S is the storage of all bodies together.

    Must run at the end of each tick, when its energy is balanced.
    """
    observer, energy = s.observer, s.energy
    motors, inputs = energy.actuator_work, energy.external_work
    if observer.is_reset == 0:
        observer.input_work += inputs - observer.previous_external_work
        pushed = motors - observer.previous_motor_work + inputs - observer.previous_external_work
        burned = min(energy.environment_energy - observer.previous_environment, 0.0)
        observer.pushed = max(observer.pushed + pushed + burned, 0.0)
    observer.is_reset = 0
    observer.previous_motor_work, observer.previous_external_work = motors, inputs
    observer.previous_environment = energy.environment_energy
    if abs(motors) > abs(observer.peak_motor_work):
        observer.peak_motor_work = motors
    if abs(observer.input_work) > abs(observer.peak_input_work):
        observer.peak_input_work = observer.input_work
    lost = energy.start_energy + energy.others_work - (energy.kinetic + energy.potential)
    returned = observer.work_at_reset - energy.coupling_work - observer.pushed
    observer.released = max(min(returned, lost), 0.0)


@compiled
def guarded_energy(s: State) -> float:
    """Returns the energy in J that the guard limits: what the device got beyond the hand's work.

        G − H − q R,    q = force_scale / scale

    G is the sum of w·δp − b Σ_i max(|δp_i| − Δ, 0)²/t in J, H of ``observe_energy`` the most that
    steps of the encoder have added to it. What the scene's storage has given, R of
    ``observe_release``, is not energy from nowhere.
    """
    observer, ratio = s.observer, s.run.force_scale / s.run.scale
    return float(observer.net_device_energy - observer.hidden_energy - ratio * observer.released)


@compiled
def foreseen_excess(s: State) -> float:
    """Returns ``guarded_energy`` after the next tick, at the speed of the last one."""
    observer, w = s.observer, s.loop.wrench_on_device
    work = 0.0
    for i in range(6):
        u = observer.device_velocity[i]
        b = observer.assumed_damping if i < 3 else observer.assumed_rotational_damping
        work += (w[i] - b * u) * u
    return float(observer.guarded_energy + s.run.period * work)


@compiled
def largest_power(size: float, damping: float, full_speed: float) -> float:
    """Returns the largest (w − b u) u in W for 0 <= u <= ``full_speed``."""
    u = full_speed
    if size < 2.0 * damping * full_speed:
        u = size / (2.0 * damping)
    return (size - damping * u) * u


@compiled
def share_within_energy_limit(s: State, force: Vector, torque: Vector) -> float:
    """Returns the share of a wrench, 0 to 1, that a jump to full speed may take within a tick.

        G + T max_u (w − b u) u <= 1.25 G_max,    |u| <= the data sheet's speed; 30 rad/s

    G is ``guarded_energy`` and G_max the energy limit, in J. A passive coupling never meets it: the
    hand has paid for the force before.
    """
    guard, observer = s.guard, s.observer
    if not math.isfinite(guard.max_energy):
        return 1.0
    power = largest_power(norm(force), observer.assumed_damping, guard.full_speed)
    power += largest_power(norm(torque), observer.assumed_rotational_damping, FULL_TURN)
    allowed = AT_FULL_SPEED * guard.max_energy - observer.guarded_energy
    if not s.run.period * power > allowed:  # also for energies that are not numbers
        return 1.0
    return float(max(allowed, 0.0) / (s.run.period * power))


@compiled
def within_energy_limit(s: State, force: Vector, torque: Vector) -> tuple[Vector, Vector]:
    """Scales the wrench down to ``share_within_energy_limit``, and flags that it acted."""
    share = share_within_energy_limit(s, force, torque)
    if share == 1.0:
        return force, torque
    s.observer.flags = CONTROLLER_ACTIVE
    return scaled(share, force), scaled(share, torque)


@compiled
def unfelt_work(s: State, moved: Vector, turned: Vector) -> float:
    """Returns the work in J that the hand saves along axes that are sensed without a motor.

        W_u = −w_u·δp + q (K/2 + B'/T) ‖δp_u‖²

    w_u is the wrench that a motor would have been sent (N, N m), δp_u the motion along those axes
    (m, rad). The second part is what the damping of such a device would burn, with the damping that
    the coupling needs; q is the ratio of the stiffness at the device to that in the scene.
    """
    k, run, u = s.coupling, s.run, s.loop.unfelt
    if not k.lacks_motors:
        return 0.0
    whole = s.guard.lever * s.guard.lever * run.force_scale
    linear = whole * run.scale * (0.5 * k.stiffness + k.damping / run.period)
    angular = whole / run.scale * (0.5 * k.rotational_stiffness + k.rotational_damping / run.period)
    work = 0.0
    for i in range(3):
        work += (linear * k.lacks_motor[i] * moved[i] - u[i]) * moved[i]
        work += (angular * k.lacks_motor[3 + i] * turned[i] - u[3 + i]) * turned[i]
    return float(work)


@compiled
def observe_energy(s: State, moved: Vector, turned: Vector, interval: float) -> None:
    """Updates the passivity observer with the previous tick's energy flow.

        A_k = max(A_{k−1} + w_{k−1}·δp_k − b Σ_i max(|δp_i| − Δ, 0)²/t + q (ΔS − W) − W_u, −A_max)

    A > 0 means that device and scene together have delivered more energy than they received.

    Symbols: A ``observed_energy``; w wrench on the device (N, N m); δp its motion since the
    previous tick (m, rad); b assumed device damping (N s/m, N m s/rad); t time since the last new
    sample (s); q = force_scale / scale; ΔS change of the stored energy (J); W work of the scene's
    motors and of user forces (J); W_u ``unfelt_work`` (J). A_max (J) caps the credit, so that long
    dissipation cannot hide a short active phase.

    **Steps of the encoder.** A position is read to ±Δ/2 (m; Δ = 0 if exact or unknown). The damping
    then burns no less than b Σ_i max(|δp_i| − Δ, 0)²/t. The work of the force is known to ±H:

        H = (Δ/2) Σ_i (Σ_k |w_{k−1,i} − w_{k−2,i}| + |w_{k−1,i}|)

    by summation by parts of Σ w·ε with the errors |ε_i| <= Δ/2.

    Also updated, each in J:
        ``created_energy``: Σ E_k of the environment minus its slack, and at least −A_max.
        ``guarded_energy``: result of the function of that name. If a motor in the scene
        pushes the hand, that energy counts as excess, and so does unfelt work.
        ``max_hand_energy``: largest Σ (w·δp − b ‖δp‖²/t − W_u), of the positions that were read.
        ``max_unpaid_energy``: largest Σ (w·δp − b ‖δp‖²/t − W_u) − q max(V_0 − W_c − P, 0), with
            the springs' energy V_0, the coupling's work W_c and P = max(Σ E, 0); for a device with
            a loop of its own the largest of the latter part so far. Work of pulses is paid for as
            far as blows did (``kernel.impact_pulse``).

    Valid for a wrench that is held constant between ticks, or lies between those of a device's own
    loop at two samples, the least work of which counts. A certified device keeps A <= 0.

    Args:
        s: The bound state, as the previous tick left it.
        moved: Translation δp in m, in the device's frame.
        turned: Rotation vector δp in rad.
        interval: t in s.

    References:
        Hannaford & Ryu 2002, eq. (4); Brown & Colgate 1997, eq. (6).
    """
    observer, energy = s.observer, s.energy
    limit, ratio = observer.energy_credit_limit, s.run.force_scale / s.run.scale
    stored = energy.kinetic + energy.potential - energy.start_energy
    given = energy.environment_energy + s.impact.taken
    over = given - (energy.slack + energy.others_slack)
    created = observer.created_energy + (over - observer.previous_created)
    observer.created_energy = max(created, -limit)
    observer.previous_created = over
    net = stored - energy.actuator_work - energy.external_work - energy.others_work
    gained = ratio * (net - observer.previous_net_storage)
    observer.previous_net_storage = net
    # before the first tick and in a pause, the time that the device took to move is unknown
    rate = 1.0 / interval if s.loop.tick > s.guard.start_tick else 0.0
    delivered = unburnt = held = 0.0
    w, a = s.loop.wrench_on_device, observer.axis_energy
    b, b_r = observer.assumed_damping, observer.assumed_rotational_damping
    for i in range(3):
        linear = (w[i] - b * rate * moved[i]) * moved[i]
        angular = (w[3 + i] - b_r * rate * turned[i]) * turned[i]
        least = max(abs(moved[i]) - observer.resolution, 0.0)
        shown = b * rate * (moved[i] * moved[i] - least * least)
        a[i] = max(a[i] + (linear + shown), -limit)
        a[3 + i] = max(a[3 + i] + angular, -limit)
        delivered += linear + angular
        unburnt += shown
        earlier = observer.earlier_force[i]
        held += abs(w[i] - earlier) + abs(w[i]) - abs(earlier)
        observer.earlier_force[i] = w[i]
        delivered -= s.loop.spread[i] * abs(moved[i]) + s.loop.spread[3 + i] * abs(turned[i])
    observer.hidden_energy += 0.5 * observer.resolution * held
    unfelt = unfelt_work(s, moved, turned)
    observed = observer.observed_energy + (delivered + unburnt) + (gained - unfelt)
    observer.observed_energy = max(observed, -limit)
    observer.net_device_energy += delivered + unburnt
    observer.hand_energy += delivered - unfelt
    observer.max_hand_energy = max(observer.max_hand_energy, observer.hand_energy)
    released = observer.springs - max(given, 0.0) - energy.coupling_work
    paid = ratio * max(released, 0.0)
    if s.run.is_apart:  # its tank holds what the scene released, until the hand has got it
        observer.most_paid = paid = max(observer.most_paid, paid)
    unpaid = observer.hand_energy - paid - min(s.impact.work, ratio * s.impact.taken)
    observer.max_unpaid_energy = max(observer.max_unpaid_energy, unpaid)
    if observer.first_unpaid < 0 and observer.max_unpaid_energy > INSTANT:
        observer.first_unpaid = s.loop.tick
    observer.guarded_energy = guarded_energy(s)
    observer.max_guarded_energy = max(observer.max_guarded_energy, observer.guarded_energy)
    for i in range(6):
        u = rate * (moved[i] if i < 3 else turned[i - 3])
        has_reversed = 1 if u * observer.device_velocity[i] < 0.0 else 0
        bits = (observer.reversals[i] << 1) | has_reversed
        observer.reversals[i] = bits & (2**WINDOW - 1)
        observer.device_velocity[i] = u


@compiled
def _swings(observer: Part, i: int) -> bool:
    """Returns True if an axis moves to and fro from sample to sample."""
    bits, count = observer.reversals[i], 0
    for _ in range(WINDOW):
        count += bits & 1
        bits >>= 1
    return bool(count >= SWINGS)


@compiled
def _damped(s: State, i: int, f: float, max_damping: float, debt: float) -> tuple[float, float]:
    """Returns component i of the wrench, damped by the debt on its axis, and the damping."""
    u = s.observer.device_velocity[i]
    owed = min(debt, s.observer.axis_energy[i])
    if not owed > 0.0:
        return f, 0.0
    damping = min(owed / (s.run.period * u * u), max_damping) if u != 0.0 else 0.0
    f -= damping * u
    if not _swings(s.observer, i):
        return f, damping
    # the force may follow the motion from tick to tick only as far as the device's damper bears
    change, last = BOUND * max_damping * abs(u), s.loop.wrench_on_device[i]
    return min(max(f, last - change), last + change), damping


@compiled
def _tank_limited(s: State, force: Vector, torque: Vector) -> tuple[Vector, Vector]:
    """Scales the wrench so that its work in the next tick is at most the tank's level."""
    u = s.observer.device_velocity
    work = force[0] * u[0] + force[1] * u[1] + force[2] * u[2]
    work += torque[0] * u[3] + torque[1] * u[4] + torque[2] * u[5]
    work *= s.run.period
    level = max(TANK_START - s.observer.observed_energy, 0.0)
    if work > level:
        share = level / work
        force, torque = scaled(share, force), scaled(share, torque)
        s.observer.flags = CONTROLLER_ACTIVE
    return force, torque


@compiled
def control(s: State, force: Vector, torque: Vector) -> tuple[Vector, Vector]:
    """Returns the wrench on the device after the passivity controller.

    While energy is owed, the controller damps each axis that received more than it returned:

        f ← f − α v,    α = min(debt/(T v²), b, m/T),    then    |f_k − f_{k−1}| <= 1.6 (b/T) |δp_k|

    f in N, v in m/s, debt in J, T period in s, b the device's damping in N s/m, m its mass in kg.
    Without the clip, α grows without bound as v goes to zero and is itself active. The second
    bound, from energy-bounding control, applies if the hand makes the loop swing from sample to
    sample. There v is one sample late and damping adds to the swing; the bound lowers the effective
    stiffness until the device's damper bears it.

    Controller ``DAMPER`` takes ``observed_energy`` as the debt, ``ENVIRONMENT`` the previous tick's
    ``created_energy``. Up to the slack a device that bears its coupling stays passive; beyond it
    each axis is damped until it has dissipated or returned its energy. A damper on the tool would
    be nearer to the cause, but contacts then create more.

    Behind the damper, a tank scales the wrench to the work that its level allows in the next tick,
    at the velocity of the last one. It covers the debt that the clipped α cannot. It does not act
    in a swing, because the last velocity does not predict the next one.

    References:
        Hannaford & Ryu 2002 (damper); Kim & Ryu 2010 (bound); Franken et al. 2011 (tank).
    """
    observer = s.observer
    observer.flags = 0
    observer.injected_damping = observer.injected_rotational_damping = 0.0
    is_environment = observer.controller == ENVIRONMENT
    if observer.controller == DAMPER or (is_environment and s.run.has_law):
        debt = observer.observed_energy - THRESHOLD
        if is_environment:
            debt = observer.created_energy - THRESHOLD
        if debt > 0.0:
            b, b_r = observer.max_damping, observer.max_rotational_damping
            x, on_x = _damped(s, 0, force[0], b, debt)
            y, on_y = _damped(s, 1, force[1], b, debt)
            z, on_z = _damped(s, 2, force[2], b, debt)
            rx, on_rx = _damped(s, 3, torque[0], b_r, debt)
            ry, on_ry = _damped(s, 4, torque[1], b_r, debt)
            rz, on_rz = _damped(s, 5, torque[2], b_r, debt)
            observer.injected_damping = max(on_x, on_y, on_z)
            observer.injected_rotational_damping = max(on_rx, on_ry, on_rz)
            is_damped = (
                observer.injected_damping > 0.0 or observer.injected_rotational_damping > 0.0
            )
            if is_damped or (x, y, z) != force or (rx, ry, rz) != torque:
                observer.flags = CONTROLLER_ACTIVE
            force, torque = (x, y, z), (rx, ry, rz)
            is_swinging = is_environment  # the tank counts the other debt
            for i in range(6):
                is_swinging = is_swinging or _swings(observer, i)
            if not is_swinging:
                force, torque = _tank_limited(s, force, torque)
    return force, torque
