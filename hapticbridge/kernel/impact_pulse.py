"""Blows of the tool, and a decaying pulse of force on the device that they pay for.

A tap on a wall of 1 to 2 kN/m feels soft, because its force rises slowly. From the tick after a
blow on, the device gets beside the coupling's wrench the force in N

    p_j = A r exp(−j T/τ) cos(2π f j T) n,    j = 0, 1, 2, …

with the frequency f in Hz, the time constant τ in s, the lever r and the blow's direction n: its
normal, away from what struck a geom that is rigid with the grip, or the way in which the step
accelerated the grip, where a part struck that joints connect with it (the pawl of a ratchet). The
scene does not get it. A *blow* is a contact of the tool with a force and a normal velocity v_n
beyond ``BLOW_SPEED`` at the start of the step, v⁺ at its end in m/s. Its normal impulse P in N s
takes from the bodies

    W = −P (v_n + v⁺)/2

in J. The account B of the pulses gets q σ min(W, −E_k) in a tick, with q = force_scale / scale, the
share σ of ``impact_pulses`` and the energy E_k that the environment created. This is taken from the
tank of rigid contacts, and counts as created where energy is judged, so that none is spent twice.
Each pulse pays for its work p·δp on the device. Within a time t the hand moves the device by δp <=
v t, v being the guard's largest speed, and the device's damping beyond what the coupling needs, b_s
in N s/m, burns at least b_s ‖δp‖²/t. So a pulse gives, beyond that, at most

    R(p, t) = max_u (‖p‖ − b_s u) u t,    0 <= u <= v.

It is charged p·δp, but no more than R; motion without a sample is charged R. A device may hold the
force of one of the last d ticks, and change it between two samples. The largest p·δp of these
pulses counts then, and t Σ_i s_i²/(16 b_s) beside it, with the spread s_i of their components: of
any motion with the same δp, one that follows the change gets no more. A device that gives no sample
may hold the last pulse, which is charged until the next sample. A pulse is sent only as large as B
covers all charges to come, Σ_i max_{m <= d−i} R(p_{k−m}, T) <= B. What no charge needs falls with
exp(−t/τ), so that one hard blow makes no later tap hard. Hence for any hand, with b >= b_s + (what
the coupling needs),

    Σ p·δp − Σ b_s ‖δp‖²/t <= q σ Σ min(W, −E_k),

and the total out of both ports is at most what the hand put in, the scene's storage and the springs
at the start. A pulse follows no motion, so it does not enter the condition of the coupling: the
loop is as stable as without, and the hand gets a bounded energy. If a tick takes longer than T, or
a sample is missing, R may exceed what was kept; the coupling's springs owe the rest (``law.owe``).

d is the stated delay, and a tick more of a real device, whose force is computed while the tick
passes. Positions are those that were read: an encoder's steps Δ blur the bound by Δ/2 Σ ‖Δp‖.

A missing sample, the passivity controller, the watch, or a lever of 0 ends a pulse; what it has
not used is forgotten. Force and pulse together keep the force limit and the energy limit; the
pulse yields.

References:
    Okamura, Cutkosky & Dennerlein 2001, IEEE/ASME Trans. Mechatronics 6 (the decaying sinusoid);
    Kuchenbecker, Fiene & Niemeyer 2006, IEEE TVCG 12 (transients of contact).
"""

from __future__ import annotations

import math

import numpy as np

from hapticbridge.kernel.codes import (
    CONTROLLER_ACTIVE,
    PROBED,
    RAMPING,
    RUNS_AWAY,
    STALE_SAMPLE,
    SWINGING,
    Part,
    State,
)
from hapticbridge.kernel.handle import device_from_scene, grip_acceleration
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.law import felt, owe
from hapticbridge.kernel.ledger import opened_by_mocap
from hapticbridge.kernel.mujoco_c import floats, ints, pointer_at
from hapticbridge.kernel.parameters import SENT, RunParameters
from hapticbridge.kernel.passivity_controller import largest_power, share_within_energy_limit
from hapticbridge.kernel.pose import (
    Vector,
    add,
    dot,
    norm,
    scaled,
    store_vector,
    subtract,
    vector_of,
)
from hapticbridge.kernel.restitution import BLOW_SPEED
from hapticbridge.kernel.rigid_contact import MAX_ROWS, note_ends, restitution_of
from hapticbridge.kernel.tick_guard import within_limit

FORGOTTEN = 1e-12
"""Energy in J of the account that is dropped. It is less than rounding."""

FADED = 0.01
"""Share of its first force below which a pulse ends; no unit."""

ENDS = STALE_SAMPLE | CONTROLLER_ACTIVE | SWINGING | RUNS_AWAY | PROBED
"""Flags of a tick that end a pulse. A lever of 0, as of a held clutch, counts as ``RAMPING``."""

IMPACT_DTYPE = np.dtype(
    [
        ("late_ticks", "<i8"),
        ("age", "<i8"),
        ("ended_by", "<i8"),
        ("share", "<f8"),
        ("angle", "<f8"),
        ("rate", "<f8"),
        ("spare", "<f8"),
        ("speed", "<f8"),
        ("account", "<f8"),
        ("taken", "<f8"),
        ("held", "<f8"),
        ("work", "<f8"),
        ("amplitude", "<f8"),
        ("blow_energy", "<f8"),
        ("largest_blow", "<f8"),
        ("blow_speed", "<f8"),
        ("blow_restitution", "<f8"),
        ("blow_rebound", "<f8"),
        ("direction", "<f8", 3),
        ("normal", "<f8", 3),
        ("newest", "<f8", 3),
        ("sent", "<f8", (SENT, 3)),
    ]
)
"""Sub-record ``impact``, written by this module alone. ``share`` is σ, ``angle`` 2π f T in rad,
``rate`` T/τ, ``spare`` b_s in N s/m, ``speed`` v in m/s and ``late_ticks`` d. ``age`` is j, −1
without a pulse; ``ended_by`` has the flags that ended one early. ``account`` is B in J, ``taken``
what the scene gave for it, of which it got q times as much, ``work`` Σ p·δp; ``held`` the largest
pulse in N that the device may hold, ``amplitude`` A in N, ``direction`` n in the device's frame,
``newest`` the pulse of this tick and ``sent`` those of the last ticks in N. ``blow_energy`` is the
W of all blows of the tick, ``normal`` the sum of their n times W in the scene's frame; of the
largest blow W, the speed −v_n in m/s, the coefficient of restitution that its contact asks for, and
v⁺/(−v_n)."""


def bind_pulse(impact: Part, parameters: RunParameters) -> None:
    """Fills in the sub-record; without ``impact_pulses`` it notes blows alone."""
    period = parameters.period
    impact["share"] = parameters.impact_pulses
    impact["angle"] = 2.0 * math.pi * parameters.pulse_frequency * period
    impact["rate"] = period / parameters.pulse_decay
    impact["spare"] = parameters.pulse_damping
    impact["speed"] = parameters.pulse_speed
    impact["late_ticks"] = parameters.pulse_ticks
    impact["age"] = -1


def forget_pulses(impact: Part) -> None:
    """Ends the pulse and forgets those sent, after a pause in which no force was sent."""
    impact["sent"] = impact["newest"] = 0.0
    impact["held"], impact["age"] = 0.0, -1


def end_pulse(impact: Part) -> None:
    """Ends the pulse, after a reset; the device holds the last one until the next wrench."""
    impact["age"] = -1


def forgo_spare_damping(impact: Part) -> None:
    """Counts no spare damping from now on, because the coupling changes and may need it."""
    impact["spare"] = 0.0


# Blows


@compiled
def note_blows(s: State) -> None:
    """Adds the tool's blows of the MuJoCo step that just ended; needs its rows."""
    mj, h, impact = s.mj, s.run.timestep, s.impact
    count = ints(mj.nefc, 1)[0]
    if count > MAX_ROWS or mj.geom_is_tool == 0:
        return
    note_ends(s)
    ends, force = floats(s.contact.end_velocity, count), floats(pointer_at(mj.efc_force), count)
    velocities = floats(pointer_at(mj.efc_vel), count)
    is_tool, is_part = ints(mj.geom_is_tool, mj.ngeom), ints(mj.geom_is_part, mj.ngeom)
    contacts = pointer_at(mj.contact)
    for c in range(ints(mj.ncon, 1)[0]):
        one = contacts + c * mj.contact_size
        row, geoms = ints(one + mj.contact_row, 1)[0], ints(one + mj.contact_geoms, 2)
        if row < 0 or force[row] <= 0.0 or min(geoms[0], geoms[1]) < 0:
            continue
        moved = opened_by_mocap(s, one) / h if s.energy.mocap_has_moved else 0.0
        speed, end = velocities[row] + moved, ends[row] + moved
        energy = -0.5 * h * force[row] * (speed + end)
        is_own = is_part[geoms[0]] != 0 or is_part[geoms[1]] != 0
        if speed > -BLOW_SPEED or not is_own or energy <= 0.0:
            continue
        impact.blow_energy += energy
        side = is_tool[geoms[1]] - is_tool[geoms[0]]  # the normal points to the second geom
        way = scaled(side, vector_of(floats(one + mj.contact_frame, 3)))
        if side == 0:
            change = grip_acceleration(mj)
            size = norm(change)
            way = scaled(1.0 / size, change) if size > 0.0 else change
        store_vector(impact.normal, add(vector_of(impact.normal), scaled(energy, way)))
        if energy > impact.largest_blow:
            impact.largest_blow, impact.blow_speed = energy, -speed
            impact.blow_restitution, impact.blow_rebound = restitution_of(s, row, -speed, end)


@compiled
def forget_blows(impact: Part) -> None:
    """Forgets the blows of the tick before."""
    impact.blow_energy = impact.largest_blow = 0.0
    impact.blow_speed = impact.blow_restitution = impact.blow_rebound = 0.0
    impact.normal[0] = impact.normal[1] = impact.normal[2] = 0.0


@compiled
def earn(s: State) -> float:
    """Pays a share of the tick's blows into the account, and starts their pulse.

    Needs the balance of the tick, before the tank of rigid contacts is filled.

    Returns:
        Energy in J of the scene that the tank does not get.
    """
    impact = s.impact
    if impact.blow_energy <= 0.0 or impact.share == 0.0:
        return 0.0
    burned = max(s.contact.last_energy - s.energy.environment_energy, 0.0)
    energy = impact.share * min(impact.blow_energy, burned)
    normal = vector_of(impact.normal)
    size = norm(normal)
    if energy <= 0.0 or size == 0.0:
        return 0.0
    impact.account += s.run.force_scale / s.run.scale * energy
    impact.taken += energy
    impact.age = 0
    store_vector(impact.direction, device_from_scene(s.run.axes, scaled(1.0 / size, normal)))
    return float(energy)


# The account


@compiled
def _most(impact: Part, size: float) -> float:
    """Returns R(p, 1 s) of a pulse in J, for its size in N."""
    if size == 0.0:
        return 0.0
    return largest_power(size, impact.spare, impact.speed)


@compiled
def _sent(impact: Part, tick: int) -> Vector:
    return vector_of(impact.sent[tick % SENT])


@compiled
def charge_pulses(s: State, moved: Vector, elapsed: float) -> None:
    """Charges the account with the pulses that the device held until this sample.

    Args:
        s: The bound state, before the sample counts.
        moved: Motion of the device in m since the last tick.
        elapsed: Time in s since then, at least T.
    """
    impact, tick = s.impact, s.loop.tick
    if impact.blow_energy > 0.0:
        forget_blows(impact)
    if impact.account == 0.0 and impact.held == 0.0:
        return
    is_known = not s.loop.external_flags & STALE_SAMPLE and s.guard.time_since_sample == 0.0
    is_new = s.guard.time_since_sample == 0.0 or s.guard.lever == 0.0  # or has faded
    charge, largest = -np.inf, 0.0 if is_new else impact.held
    low = high = _sent(impact, tick - 1)
    for j in range(impact.late_ticks + 1):
        x, y, z = sent = _sent(impact, tick - 1 - j)
        charge, largest = max(charge, dot(sent, moved)), max(largest, norm(sent))
        low = (min(low[0], x), min(low[1], y), min(low[2], z))
        high = (max(high[0], x), max(high[1], y), max(high[2], z))
    impact.held = largest
    if not is_known:
        charge = np.inf
    elif high != low:
        spread = subtract(high, low)
        b = 16.0 * impact.spare
        charge += elapsed * dot(spread, spread) / b if b > 0.0 else np.inf
    charge = min(charge, elapsed * _most(impact, largest))
    impact.work += dot(_sent(impact, tick - 1), moved)
    impact.account -= charge
    if impact.account < 0.0:
        owe(s, -impact.account * s.run.scale / s.run.force_scale)
        impact.account = 0.0
    free = impact.account - _to_come(s)
    if free > 0.0:
        impact.account -= free * -math.expm1(-impact.rate) if free > FORGOTTEN else free


@compiled
def _to_come(s: State) -> float:
    """Returns the most that the pulses on their way will be charged in J, without that of now.

    In the tick of number i from now on that is R of the largest pulse that may still act then.
    """
    impact, largest, total = s.impact, 0.0, 0.0
    for m in range(1, impact.late_ticks + 1):
        largest = max(largest, s.run.period * _most(impact, norm(_sent(impact, s.loop.tick - m))))
        total += largest
    return float(total)


@compiled
def _affordable(s: State) -> float:
    """Returns the R(p, T) in J that the account covers beside the charges to come.

    A pulse raises the smallest of these charges first.
    """
    impact, left, largest = s.impact, s.impact.account - _to_come(s), 0.0
    for m in range(1, impact.late_ticks + 1):
        largest = max(largest, s.run.period * _most(impact, norm(_sent(impact, s.loop.tick - m))))
        if left <= m * largest:
            return float(left / m)
        left += largest
    return float(left / (impact.late_ticks + 1))


@compiled
def largest_pulse(power: float, spare: float, speed: float) -> float:
    """Returns the largest pulse p in N with R(p, 1 s) up to a power in W, for b_s and v."""
    force = 2.0 * math.sqrt(spare * power)
    if spare > 0.0 and force <= 2.0 * spare * speed:
        return force
    return float(power / speed + spare * speed)


@compiled
def add_pulse(s: State, force: Vector, torque: Vector) -> Vector:
    """Returns the force on the device in N with the pulse of this tick, and notes the pulse."""
    impact, tick = s.impact, s.loop.tick
    if impact.share == 0.0:
        return force
    sent = (0.0, 0.0, 0.0)
    ends = (s.loop.external_flags | s.observer.flags | s.watch.flags) & ENDS
    if s.guard.lever == 0.0:
        ends |= RAMPING
    if ends and impact.age >= 0:
        impact.ended_by |= ends
        impact.age = -1
    if impact.age >= 0:
        power = max(_affordable(s), 0.0) / s.run.period
        most = largest_pulse(power, impact.spare, impact.speed)
        if impact.age == 0:
            impact.amplitude = most
        envelope = math.exp(-impact.rate * impact.age)
        size = impact.amplitude * envelope * math.cos(impact.angle * impact.age) * s.guard.lever
        wanted, _ = felt(s, scaled(min(max(size, -most), most), vector_of(impact.direction)), sent)
        whole = within_limit(force, add(force, wanted), s.run.force_limit)
        if share_within_energy_limit(s, whole, torque) == 1.0:
            sent = subtract(whole, force)
            force = whole
        impact.age = impact.age + 1 if envelope > FADED else -1
    store_vector(impact.newest, sent)
    store_vector(impact.sent[tick % SENT], sent)
    return force
