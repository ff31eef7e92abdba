"""Energy that the times of samples and forces may have given to the hand, sample by sample.

The condition b >= N assumes that samples come each T and that each force acts a constant time after
its sample: the stated delay of the device t_d in whole ticks, 0 for one that answers at once. In
a run, samples come late or not at all, and a force is sent some time after its sample. So each run
keeps the account by which the condition is proved, at the times that it had:

    A_k = max(A_{k−1} + E_k + u'_k·δp_k + q Δ(W_c + V − V_0), −C),    q = force_scale / scale

with the coupling's work on the scene W_c, the energy of its springs V, that at the start and after
resets V_0, all in J after the tick, and the wrench u that axes without a motor would be sent. E_k
is the most that the device gave to the hand since the last new sample. The hand moved by δp_k and
felt the wrenches w(t), each from t_d after it was sent until the next one came. For any motion,

    E_k = w'_k·δp_k + ∫ ‖w(t) − w'_k‖² dt/(4 b),    w' = w r_{k−1}/r_k

and for the motion δp_k within the time τ, however it was spread, with the mean w̄ of w,

    E_k = w̄·δp_k − b ‖δp_k‖²/τ + ∫ ‖w(t) − w̄‖² dt/(4 b)

which is never more. r is the lever: the handle moved by r_{k−1} times the device's motion. The
first is taken, so that A holds what another hand could have had at the same forces. For a sample
that comes late, or in some ticks only, it is the second: then the handle slips for the motion that
there was (``law.charge_lateness``). So it is before another program's scene, whose tool may jump:
the wrench after the jump is no force that the hand has felt. In ticks without a new sample the
device may have held the force of the last one, so that no other enters w.

C is 0 for a device in time. Behind a delay it is the energy credit of the passivity controller:
what wrenches on their way will cost, motion has paid for before.

No property of the law is assumed: force level, slip, lever, changed gains, contacts, several hands
and slower scenes are all in W_c and V. From any sample on, the hand gets at most A + C + q V, and
what the scene had or created. In a strict scene with b >= N and constant times, A stays near 0; see
``theory.bounds.minimum_damping``. What a scene within its slack created is added to A for a
device that answers late: only the condition of a device in time pays for it. Pulses of blows, and
the damping b_s on which they count, are left out: they have an account (``kernel.impact_pulse``).

References:
    Brown & Colgate 1997, eq. (6); the account is its proof in the time domain.
"""

from __future__ import annotations

import numpy as np

from hapticbridge.kernel.codes import Part, State
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.law import held_energy
from hapticbridge.kernel.pose import (
    Vector,
    quaternion_of,
    rotation_between,
    store_vector,
    subtract,
    vector_of,
)

LATE = 1.5
"""Time between two samples, in T, above which the later one is late; no unit. A smaller value takes
jitter for lateness; a larger one counts what a slip has paid."""

RING = 64
"""Number of wrenches on their way to the device that are kept; its delay is at most 50 samples."""

TIMING_DTYPE = np.dtype(
    [
        ("delays", "<f8"),  # sum of the times from sample to force in s
        ("lateness", "<f8"),  # of the last sample after its deadline, in s
        ("jitter", "<f8"),  # sum of all rises of the lateness in s
        ("device_delay_ns", "<i8"),  # t_d in ns
        ("is_timed", "<i8"),  # 1 if the time since the last sample is known
        ("is_new", "<i8"),  # 1 if this tick's sample is new
        ("lever", "<f8"),  # r_{k−1}/r_k of this tick
        ("moved", "<f8", 6),  # δp of this tick's sample in m and rad
        ("stored", "<f8"),  # q (W_c + V − V_0) in J after the tick of the last new sample
        ("newest", "<i8"),  # number of wrenches that were sent
        ("held", "<i8"),  # number of the one that the device holds
        ("wrenches", "<f8", (RING, 6)),
        ("arrivals", "<i8", RING),  # when they act, in ns
        ("since", "<i8"),  # time of the last new sample in ns
        ("now", "<i8"),  # end of the time that ``impulse`` and ``square`` cover, in ns
        ("impulse", "<f8", 6),  # ∫ w dt
        ("square", "<f8", 6),  # ∫ w² dt
        ("uncovered", "<f8"),  # A in J
        ("max_uncovered", "<f8"),  # largest A so far in J, and what the scene created
    ]
)
"""Sub-record ``timing``, written by this module alone."""


@compiled
def note_motion(s: State, moved: Vector, turned: Vector, lever: float, is_timed: bool) -> None:
    """Notes the motion of a tick's sample.

    Args:
        s: The bound state.
        moved: Translation δp in m since the last tick, in the device's frame.
        turned: Its rotation vector in rad.
        lever: r_{k−1}, of the wrench that was held until now.
        is_timed: True if the time is known that the motion took, and a law answers it.
    """
    t = s.timing
    t.lever = lever / s.guard.lever if s.guard.lever > 0.0 else 0.0
    t.is_timed, t.is_new = is_timed, s.guard.consecutive_stale == 0
    store_vector(t.moved[:3], moved)
    store_vector(t.moved[3:], turned)


def bind_timing(timing: Part, delay: float) -> None:
    """Fills in t_d, in s."""
    timing["device_delay_ns"] = round(1e9 * delay)


@compiled
def _advance(timing: Part, end: int) -> None:
    """Adds the wrenches that the device held until a time in ns."""
    while timing.now < end:
        until, is_last = end, True
        if timing.held < timing.newest and timing.arrivals[(timing.held + 1) % RING] < end:
            until, is_last = max(timing.arrivals[(timing.held + 1) % RING], timing.now), False
        time, w = 1e-9 * (until - timing.now), timing.wrenches[timing.held % RING]
        for i in range(6):
            timing.impulse[i] += time * w[i]
            timing.square[i] += time * w[i] * w[i]
        timing.now = until
        if not is_last:
            timing.held += 1


@compiled
def _of_coupling(s: State, i: int) -> float:
    """Returns component i of the wrench on the device without the pulse, which has an account."""
    whole = s.loop.wrench_on_device[i]
    return float(whole - s.impact.newest[i]) if i < 3 else float(whole)


@compiled
def _energy(s: State, time: float, is_late: bool) -> float:
    """Returns E_k + u'_k·δp_k for a time τ in s."""
    t, u, work = s.timing, s.loop.unfelt, 0.0
    for i in range(6):
        b = s.observer.assumed_rotational_damping
        if i < 3:
            b = s.observer.assumed_damping - s.impact.spare
        mean, d = t.impulse[i] / time, t.moved[i]
        middle = mean if is_late else t.lever * _of_coupling(s, i)
        work += (middle + t.lever * u[i]) * d
        if is_late:
            work -= b * d * d / time
        spread = t.square[i] - t.impulse[i] * mean + time * (mean - middle) ** 2
        if b > 0.0:
            work += max(spread, 0.0) / (4.0 * b)
    return float(work)


@compiled
def _stored(s: State) -> float:
    """Returns q (W_c + V − V_0) in J."""
    pose = s.pose
    stretch = subtract(vector_of(pose.handle_position), vector_of(pose.tool_position))
    twist = rotation_between(
        quaternion_of(pose.tool_quaternion), quaternion_of(pose.handle_quaternion)
    )
    held = held_energy(s, stretch, twist) - s.observer.springs
    return float(s.run.force_scale / s.run.scale * (s.energy.coupling_work + held))


@compiled
def keep_account(s: State, deadline_ns: int, read_ns: int, write_ns: int) -> None:
    """Notes the times of a tick after its wrench was sent, and keeps the account.

    Args:
        s: The bound state, with the tick's energies.
        deadline_ns: When its sample was due.
        read_ns: When its sample was read.
        write_ns: When its wrench was sent.
    """
    t, lateness = s.timing, 1e-9 * (read_ns - deadline_ns)
    t.delays += 1e-9 * (write_ns - read_ns)
    t.jitter += max(lateness - t.lateness, 0.0)
    t.lateness = lateness
    if not s.run.has_law or s.run.is_apart:
        return
    credit = created = 0.0
    if t.device_delay_ns > 0:
        credit = s.observer.energy_credit_limit
        given = s.energy.environment_energy + s.impact.taken
        created = s.run.force_scale / s.run.scale * max(given, 0.0)
    if not t.is_timed:  # the device held no force
        t.held = t.newest
        for i in range(6):
            t.wrenches[t.held % RING][i] = 0.0
    elif t.is_new:
        _advance(t, read_ns)
    if t.is_new or not t.is_timed:
        stored, time = _stored(s), 1e-9 * (read_ns - t.since)
        if t.is_timed and time > 0.0:
            is_late = time > LATE * s.run.period or s.shown.is_posted > 0
            energy = _energy(s, time, is_late)
            t.uncovered = max(t.uncovered + energy + stored - t.stored, -credit)
        t.stored, t.since, t.now = stored, read_ns, read_ns
        t.newest += 1
        t.arrivals[t.newest % RING] = write_ns + t.device_delay_ns
        for i in range(6):
            t.impulse[i] = t.square[i] = 0.0
            t.wrenches[t.newest % RING][i] = _of_coupling(s, i)
    t.max_uncovered = max(t.max_uncovered, t.uncovered + created)
