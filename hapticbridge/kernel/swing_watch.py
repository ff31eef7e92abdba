"""Watch for a device whose force comes later than stated, or in a wrong direction in mid-run.

A hand has no will above some 10 Hz, so fast motion answers the force. With W and V the wrench sent
(N, N m) and the velocity read (m/s, rad/s) above 20 Hz, in blocks of t = 4 ms, A = V', and sums Σ
over 0.1 s, without unit

    p = Σ W·V/√(Σ W² Σ V²),   c = Σ W·A/√(Σ W² Σ A²),   x = ‖Σ W×A‖/√(Σ W² Σ A²)

A passive hand has p >= 0, and c > 0 where its inertia rules. A force late by τ gives p = −sin ωτ
and c = cos ωτ, a reversed axis c = −1, exchanged axes x = 1. c_s is c for the wrench sent s
earlier, for six s of 8 to 48 ms; a motor that holds is answered so. With b the damping of the
device, δp the motion in a block and w above 4 Hz, over 0.3 s, late work in J and least delay in s

    E_s = Σ (w_{k−s}·δp_k − b ‖δp_k‖²/t),    τ_0 = (b Σ V² − Σ W·V)/Σ W·A    where c >= 0.6

E_s is the largest for 4, 10, 20 and 40 ms, 0 where that of s = 0 without b is over E_s/4. Of a
device that states a delay τ_d, Σ W·V + τ_d Σ W·A stands for Σ W·V where c > 0.

Findings, for translation and rotation each; E is 8 mJ at 10 N or 0.5 N m, in proportion to the
limit. For 12 ms unless said otherwise; W and A must be known (``KNOWN_WRENCH``).
    wrong way: c <= −0.6 with p <= 0.2, or x >= 0.6 with c and p < 0.6, or x >= 0.55 with E_s >= E.
    The force is taken away.
    late: p <= −0.4 with E_s >= E/4, or p <= −0.3 with E_s >= E; τ_0 >= 1.3 ms, 2.4 ms without a
    stated delay, with E_s >= E for 40 ms; c <= 0 and p < 0.6 with c_s >= 0.4; after one of these
    each E_s >= E. The greatest ratio r of the lever between device and handle is halved.
    slammed: with w, v of every tick above 25 Hz, b Σ v² − Σ w·v over 0.3 s is 6.4 mW or more, and
    Σ w_d·v >= 0.9 b Σ v² for the force w_d of d = 1 or 2 ms beyond the stated delay, for 0.385 s
    (``SLAM``). r is halved.
    coarse: 3 steps of an encoder within 0.3 s, over which the coupling pulls with half the limit
    after equal samples for 4 ms. r is halved.

E_s >= 3 E, or a gain of 0.1 m/s (1.5 rad/s) within 30 ms against 60 % of the limit, is a suspicion:
r falls to a quarter for 0.15 s. This step is no hand's will, and its answer shows delay and sign.
The next one waits 0.5 s, then twice as long each time up to 8 s. It is no alarm.

Directions are tested before the force (``demand.probe``). A device with prescribed motion is not
watched. The page ``faults`` of the guide has the margins and the limits of the method.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.codes import (
    PROBED,
    RUNS_AWAY,
    STALE_SAMPLE,
    SWINGING,
    Part,
    State,
)
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.parameters import RunParameters, whole_ticks
from hapticbridge.kernel.pose import Vector, norm

BLOCK = 0.004
"""Length of a block in s, over which wrench and velocity are averaged. Longer blocks miss swings of
60 Hz; shorter ones cost time and see the steps of an encoder."""

LONGEST_BLOCK = 4
"""Most that a block is longer than ``BLOCK`` while it waits for a new sample, as a ratio. A block
ends with a new sample, so that its motion belongs to its time: samples that come in bunches would
else look like fast motion of no cause. The force fades before the block is longer."""

FAST = 20.0
"""Corner in Hz of the high-pass of fourth order. It leaves 3 % of a hand's shaking at 8 Hz; a lower
one leaves more, a higher one less of a swing's harmonics."""

SLOWEST = 4.0
"""Corner in Hz of the two filters for late work. Hands move at will up to 1.5 Hz; an arm that holds
a device 20 ms late swings at 4.5 Hz."""

LAGS = (0.004, 0.010, 0.020, 0.040)
"""Delays s in s, for swings from 4 to 60 Hz: a delay is seen best at a quarter of the swing."""

FAST_MEMORY, WORK_MEMORY, GAIN_MEMORY = 0.1, 0.3, 0.03
"""Times in s after which fast motion, late work and a gain of speed are forgotten."""

KNOWN_WRENCH, KNOWN_MOTION = 1e-4, 0.005
"""Least Σ W² as a share of the limit squared, in s, and least share of the fast acceleration in all
of it. Shaking at 8 Hz leaves a share of 0.0007 in fast motion, at 11 Hz 0.008."""

LATE, REVERSED, FORWARD, EXCHANGED, FOLLOWED, ANSWERED = -0.4, -0.6, 0.2, 0.6, 0.6, 0.4
"""Bounds of p, c, p, x, of c or p, and of c_s, without unit. A delay of 2 ms, which is clean, has
p = −0.4 at 33 Hz."""

LATE_AT_WORK, TURNED_AT_WORK = -0.3, 0.55
"""Bounds of p and x that are enough where E_s >= E; no unit."""

DELAY_BLOCKS = 10
"""Blocks in a row of τ_0 for a finding. Within 3 blocks an arm that shakes a device 2 ms late by 30
mm at 8 Hz shows up to 2.9 ms, within 10 blocks 2.3 ms."""

BLOCKS = 3
"""Blocks in a row for a finding."""

STEPS, STEP = 3.0, 0.5
"""Number of steps for a finding, and the least share of the limit that a step is worth; no unit. A
lower share takes steps of 0.2 mm at 2400 N/m and a limit of 2 N, which can be felt, for a fault."""

SLAM, GOES_ON, EXPLAINED, LASTS = 0.8, 0.8, 0.9, 0.385
"""Least missing power of a slam in E per s, least share of its average that is missing now, least
ratio of a later force's work to b Σ v², and time in s for which all hold. A lower ``SLAM`` takes
swings of an encoder with steps of 0.2 mm for slams. After one blow the missing power falls as
exp(−t/M), with M the memory of 0.3 s, and its average as (t/M) exp(−t/M): the share is kept for
M/0.8 = 0.375 s, and ``LASTS`` is longer, so that a thrown hand that rings is no slam. In a swing
that a force d late drives for ever, its work is (b + c) Σ v², with c the hand's damping; a hand of
0.06 N s/m has a ratio of 1.02. At 0.5 hands that ring, and devices as late as stated, are slams."""

SENT_LAGS, SWUNG = (0.0, 0.0, 0.001, 0.002), 25.0
"""Ages of forces in s, all but the first beyond a stated delay, and corner in Hz of their filter. A
block hides swings of 100 to 170 Hz. A lower corner leaves more of a hand's blows; with 3 ms, blows
on a stop of the device are taken for slams."""

ANSWERS, STRIDE = 6, 2
"""Number of lags of c_s, and blocks from one to the next: 8, 16 to 48 ms. A motor that holds for 60
ms is late by 30 ms on average; with three lags instead of six it is found a throw later."""

BELIEVED, LITTLE, MUCH = 0.25, 0.25, 3.0
"""Largest share of late work that the account may see, and multiples of E: enough for p <= −0.4,
and for a probe. With less than 3 E, the tasks of our scenes would be probed."""

RESISTED = 0.6
"""Share of the limit that a device must resist for a gain of speed to be suspicious."""

USUAL_FORCE, USUAL_TORQUE, USUAL_ARM = 10.0, 0.5, 15.0
"""Force in N and torque in N m to which the thresholds belong, and speed of turning in rad/s per
m/s of motion."""

PROBE, PROBE_SHARE, REST, LONGEST_REST = 0.15, 0.25, 0.5, 8.0
"""Duration in s of a probe, its share of the ratio, and the first and longest rest after it in s.
At a quarter of the ratio a swing has a sixteenth of the stiffness and ends."""

RING, SENT, SPREAD = 16, 64, 16
"""Blocks that are kept for late work, ticks of the force that are kept, and most ticks over which
the motion of a sample is spread."""

WATCH_DTYPE = np.dtype(
    [
        ("block_ticks", "<i8"),
        ("block", "<f8"),
        ("stated_delay", "<f8"),
        ("delay_margin", "<f8"),
        ("lags", "<i8", len(LAGS)),
        ("sections", "<f8", 6),
        ("corner", "<f8"),
        ("kept", "<f8", 3),
        ("limits", "<f8", 2),
        ("late_energy", "<f8", 2),
        ("gain", "<f8", 2),
        ("probe_blocks", "<i8"),
        ("longest_rest", "<i8"),
        ("flags", "<i8"),
        ("max_lever", "<f8"),
        ("cap", "<f8"),
        ("rest", "<i8"),
        ("probe_end", "<i8"),
        ("rest_end", "<i8"),
        ("returns_to", "<f8"),
        ("ticks", "<i8"),
        ("blocks", "<i8"),
        ("wrench", "<f8", 6),
        ("motion", "<f8", 6),
        ("speed", "<f8", 6),
        ("slow", "<f8", 24),
        ("ring", "<f8", 6 * RING),
        ("stages", "<f8", 48),
        ("fast_wrench", "<f8", 6),
        ("fast_speed", "<f8", 6),
        ("mean_wrench", "<f8", 3),
        ("change", "<f8", 3),
        ("known_damping", "<f8", 2),
        ("missing_power", "<f8", 2),
        ("sent_lags", "<i8", len(SENT_LAGS)),
        ("slam_blocks", "<i8"),
        ("swung_corner", "<f8"),
        ("swung_kept", "<f8"),
        ("swung_slow", "<f8", 24),
        ("sent", "<f8", 6 * SENT),
        ("sent_ticks", "<i8"),
        ("swung_square", "<f8", 2),
        ("sent_power", "<f8", 2 * len(SENT_LAGS)),
        ("wrench_square", "<f8", 2),
        ("speed_square", "<f8", 2),
        ("change_square", "<f8", 2),
        ("whole_square", "<f8", 2),
        ("power", "<f8", 2),
        ("along", "<f8", 2),
        ("late_along", "<f8", 2 * ANSWERS),
        ("past_means", "<f8", 6 * RING),
        ("past_squares", "<f8", 2 * RING),
        ("across", "<f8", 6),
        ("believed", "<f8", 2),
        ("delayed", "<f8", 2 * len(LAGS)),
        ("gained", "<f8", 2),
        ("still", "<i8", 2),
        ("steps", "<f8", 2),
        ("counts", "<i8", 12),
    ]
)
"""Sub-record ``watch``, written by this module alone. ``block_ticks`` is 0 without a watch; pairs
are translation and rotation. The fields up to ``longest_rest`` are thresholds and filters.

``cap`` is the greatest ratio after all findings, ``max_lever`` the one allowed now, ``returns_to``
the ratio before a probe; ``probe_end`` and ``rest_end`` are blocks. ``wrench`` and ``motion`` are
sums over the block, ``wrench_square`` to ``across`` sums over W, V and A, ``whole_square`` that of
all acceleration; ``believed`` and ``delayed`` are E_0 and E_s. ``sent`` is a ring of w by tick,
``swung_square`` Σ v², ``sent_power`` Σ w_d·v and ``missing_power`` the average of what a slam
lacks. ``late_along`` are sums over W_{k−s}·A, with rings of W and Σ W² in ``past_means`` and
``past_squares``. ``still`` counts equal samples, ``steps`` coarse steps, and ``counts`` blocks in a
row of late, reversed, exchanged, answered late, τ_0 and slams."""


def bind_watch(watch: Part, parameters: RunParameters) -> None:
    """Fills in the thresholds; without a finite one there is no watch."""
    limits, period = parameters.guarding, parameters.period
    watch["max_lever"] = watch["cap"] = 1.0
    if not math.isfinite(min(limits.swing_energy, limits.runaway_speed)):
        return
    watch["block_ticks"] = ticks = max(round(BLOCK / period), 1)
    watch["block"] = block = ticks * period
    watch["stated_delay"], watch["delay_margin"] = limits.stated_delay, limits.delay_margin
    watch["lags"] = [min(max(round(lag / block), 1), RING - 1) for lag in LAGS]
    watch["sections"] = _butterworth(min(FAST * block, 0.2))
    watch["corner"] = 1.0 - math.exp(-2.0 * math.pi * SLOWEST * block)
    memories = FAST_MEMORY, WORK_MEMORY, GAIN_MEMORY
    watch["kept"] = [math.exp(-block / memory) for memory in memories]
    stated = whole_ticks(limits.stated_delay, period)
    lags = [max(round(lag / period), lag > 0.0) + stated for lag in SENT_LAGS]
    watch["sent_lags"] = [0] + [min(lag, SENT - SPREAD) for lag in lags[1:]]
    watch["slam_blocks"] = max(round(LASTS / block), 1)
    watch["swung_corner"] = 1.0 - math.exp(-2.0 * math.pi * SWUNG * period)
    watch["swung_kept"] = math.exp(-period / WORK_MEMORY)
    watch["limits"] = parameters.force_limit, parameters.torque_limit
    level = parameters.force_limit / USUAL_FORCE, parameters.torque_limit / USUAL_TORQUE
    watch["late_energy"] = [limits.swing_energy * part for part in level]
    speed = limits.runaway_speed
    watch["gain"] = speed * level[0], USUAL_ARM * speed * level[1]
    watch["probe_blocks"], watch["rest"], watch["longest_rest"] = (
        max(round(time / block), 1) for time in (PROBE, REST, LONGEST_REST)
    )
    watch["known_damping"] = (
        parameters.device_damping or 0.0,
        parameters.device_rotational_damping or 0.0,
    )


def _butterworth(corner: float) -> list[float]:
    """Returns a high-pass of fourth order: gain and two coefficients of each of its two sections.

    ``corner`` is in cycles per block.
    """
    w, found = math.tan(math.pi * corner), []
    for angle in (math.pi / 8.0, 3.0 * math.pi / 8.0):
        damped = 2.0 * math.cos(angle) * w
        whole = 1.0 + damped + w * w
        found += [1.0 / whole, 2.0 * (w * w - 1.0) / whole, (1.0 - damped + w * w) / whole]
    return found


@compiled
def watch_device(s: State, moved: Vector, turned: Vector, interval: float) -> None:
    """Takes the motion in which the last wrench was held, and lowers ``max_lever`` if it must.

    Args:
        s: The bound state, before the new wrench.
        moved: Motion of the device in m since the last sample.
        turned: Its rotation vector in rad.
        interval: Time in s since the last sample that was new.
    """
    watch = s.watch
    if watch.block_ticks == 0:
        return
    if s.loop.tick > s.guard.start_tick:
        wrench, motion, w = watch.wrench, watch.motion, s.loop.wrench_on_device
        # after a long wait only the mean speed is known
        longest = max(watch.block_ticks, watch.ticks + 1) * s.run.period
        part = 1.0 if interval <= longest else longest / interval
        for i in range(3):
            wrench[i] += w[i]
            wrench[3 + i] += w[3 + i]
            motion[i] += part * moved[i]
            motion[3 + i] += part * turned[i]
        _add_tick(s, moved, turned, interval)
    scale, force_scale = s.run.scale, s.run.force_scale
    _count_step(s, 0, moved, interval, force_scale * scale * s.coupling.stiffness)
    _count_step(s, 1, turned, interval, force_scale / scale * s.coupling.rotational_stiffness)
    watch.ticks += 1
    is_stale = s.loop.external_flags & STALE_SAMPLE != 0
    if watch.ticks >= watch.block_ticks * (LONGEST_BLOCK if is_stale else 1):
        _close_block(s)
        watch.ticks = 0


@compiled
def _add_tick(s: State, moved: Vector, turned: Vector, interval: float) -> None:
    """Adds the work of sent forces; the motion of a new sample is even since the last one."""
    watch, sent, corner = s.watch, s.watch.sent, s.watch.swung_corner
    at = watch.sent_ticks % SENT
    watch.sent_ticks += 1
    for i in range(6):
        force = s.loop.wrench_on_device[i]
        sent[6 * at + i] = _without_slow(watch.swung_slow, corner, i, force)
    if s.loop.external_flags & STALE_SAMPLE:
        return
    period, count = s.run.period, len(SENT_LAGS)
    ticks = min(max(round(interval / period), 1), SPREAD)
    for tick in range(at - ticks + 1, at + 1):
        for kind in range(2):
            motion = turned if kind else moved
            watch.swung_square[kind] *= watch.swung_kept
            for d in range(count):
                watch.sent_power[count * kind + d] *= watch.swung_kept
            for i in range(3):
                axis = 3 * kind + i
                speed = _without_slow(watch.swung_slow, corner, 6 + axis, motion[i] / interval)
                watch.swung_square[kind] += period * speed * speed
                for d in range(count):
                    force = sent[6 * ((tick - watch.sent_lags[d]) % SENT) + axis]
                    watch.sent_power[count * kind + d] += period * force * speed


@compiled
def _count_step(s: State, kind: int, motion: Vector, interval: float, stiffness: float) -> None:
    """Counts a coarse step; ``stiffness`` is the coupling's at the device in N/m or N m/rad."""
    watch, still = s.watch, s.watch.still
    if s.loop.external_flags & STALE_SAMPLE:
        return
    if motion == (0.0, 0.0, 0.0):
        still[kind] += 1
        return
    was_still = still[kind] >= max(watch.block_ticks, 2) and interval < 2.0 * s.run.period
    still[kind] = 0
    if was_still and s.guard.lever * stiffness * norm(motion) >= STEP * watch.limits[kind]:
        watch.steps[kind] += 1.0


@compiled
def _close_block(s: State) -> None:
    """Judges a block of ticks, and sets the greatest ratio."""
    watch = s.watch
    verdict = 0
    for kind in range(2):
        _add_block(s, kind)
        _add_late_answers(watch, kind)
        verdict |= _verdict(s, kind)
    for i in range(6):
        watch.wrench[i] = watch.motion[i] = 0.0
    watch.blocks += 1
    if verdict & (RUNS_AWAY | SWINGING) != 0:
        watch.flags |= verdict & (RUNS_AWAY | SWINGING)
        watch.cap = 0.0 if verdict & RUNS_AWAY != 0 else 0.5 * watch.cap
        watch.probe_end, watch.returns_to = 0, 0.0
        for i in range(2 * len(LAGS)):
            watch.delayed[i] = 0.0
        for i in range(len(watch.counts)):
            watch.counts[i] = 0
        for i in range(2 * ANSWERS):
            watch.late_along[i] = 0.0
        watch.believed[0] = watch.believed[1] = watch.steps[0] = watch.steps[1] = 0.0
    elif verdict != 0 and watch.blocks >= watch.rest_end:
        watch.probe_end = watch.blocks + watch.probe_blocks
        watch.rest_end = watch.probe_end + watch.rest
        watch.rest = min(2 * watch.rest, watch.longest_rest)
        watch.returns_to = s.guard.lever
    is_probing = watch.blocks < watch.probe_end
    watch.max_lever = PROBE_SHARE * watch.cap if is_probing else watch.cap
    watch.flags &= ~PROBED
    if is_probing or s.guard.lever < watch.returns_to:
        watch.flags |= PROBED
    else:
        watch.returns_to = 0.0


@compiled
def _without_slow(slow: NDArray[np.float64], corner: float, at: int, value: float) -> float:
    """Returns a value less what swings slowly: two filters of first order in a row."""
    slow[at] += corner * (value - slow[at])
    value -= slow[at]
    slow[at + 12] += corner * (value - slow[at + 12])
    return float(value - slow[at + 12])


@compiled
def _fast(watch: Part, at: int, value: float) -> float:
    """Returns the fast part of a value: two sections of second order in a row."""
    stages, sections = watch.stages, watch.sections
    for k in range(2):
        z = 4 * at + 2 * k
        gain = sections[3 * k]
        out = gain * value + stages[z]
        stages[z] = stages[z + 1] - 2.0 * gain * value - sections[3 * k + 1] * out
        stages[z + 1] = gain * value - sections[3 * k + 2] * out
        value = out
    return float(value)


@compiled
def _damping(s: State, kind: int) -> float:
    """Returns the damping b in N s/m or N m s/rad that is assumed; with less, τ_0 is less."""
    observer = s.observer
    return float(observer.assumed_rotational_damping if kind else observer.assumed_damping)


@compiled
def _add_block(s: State, kind: int) -> None:
    """Adds a block of translation or rotation to all sums."""
    watch, block, ring = s.watch, s.watch.block, s.watch.ring
    kept, kept_work = watch.kept[0], watch.kept[1]
    b = _damping(s, kind)
    first, whole = 3 * kind, watch.block_ticks / watch.ticks
    square = against = change = burnt = 0.0
    for d in range(len(LAGS)):
        watch.delayed[len(LAGS) * kind + d] *= kept_work
    watch.believed[kind] *= kept_work
    watch.steps[kind] *= kept_work
    wrench_square = speed_square = change_square = whole_square = power = along = 0.0
    for i in range(3):
        at = first + i
        wrench, moved = watch.wrench[at] / watch.ticks, whole * watch.motion[at]
        speed = moved / block
        faster = speed - watch.speed[at]
        watch.speed[at] = speed
        square += wrench * wrench
        against -= wrench * speed
        change -= wrench * faster
        whole_square += faster * faster
        # the work of a late wrench
        slow_wrench = _without_slow(watch.slow, watch.corner, at, wrench)
        motion = _without_slow(watch.slow, watch.corner, 6 + at, moved)
        ring[6 * (watch.blocks % RING) + at] = slow_wrench
        burnt += b * motion * motion / block
        watch.believed[kind] += slow_wrench * motion
        for d in range(len(LAGS)):
            past = 6 * ((watch.blocks - watch.lags[d]) % RING) + at
            watch.delayed[len(LAGS) * kind + d] += ring[past] * motion
        # the fast answer; a change of speed belongs to the mean of two blocks' wrenches
        fast_wrench, fast_speed = _fast(watch, at, wrench), _fast(watch, 6 + at, speed)
        watch.mean_wrench[i] = mean = 0.5 * (fast_wrench + watch.fast_wrench[at])
        watch.change[i] = answer = (fast_speed - watch.fast_speed[at]) / block
        watch.fast_wrench[at], watch.fast_speed[at] = fast_wrench, fast_speed
        wrench_square += fast_wrench * fast_wrench
        speed_square += fast_speed * fast_speed
        change_square += answer * answer
        power += fast_wrench * fast_speed
        along += mean * answer
    for d in range(len(LAGS)):
        watch.delayed[len(LAGS) * kind + d] -= burnt
    watch.wrench_square[kind] = kept * watch.wrench_square[kind] + block * wrench_square
    watch.speed_square[kind] = kept * watch.speed_square[kind] + block * speed_square
    watch.change_square[kind] = kept * watch.change_square[kind] + block * change_square
    watch.whole_square[kind] = kept * watch.whole_square[kind] + whole_square / block
    watch.power[kind] = kept * watch.power[kind] + block * power
    watch.along[kind] = kept * watch.along[kind] + block * along
    for i in range(3):
        j, k, at = (i + 1) % 3, (i + 2) % 3, first + i
        turn = watch.mean_wrench[j] * watch.change[k] - watch.mean_wrench[k] * watch.change[j]
        watch.across[at] = kept * watch.across[at] + block * turn
    size = math.sqrt(square)
    if size < RESISTED * watch.limits[kind] * s.guard.lever or size == 0.0 or against <= 0.0:
        watch.gained[kind] = 0.0
    else:
        watch.gained[kind] = max(watch.kept[2] * watch.gained[kind] + change / size, 0.0)


@compiled
def _add_late_answers(watch: Part, kind: int) -> None:
    """Adds the answers to earlier wrenches to the sums, after ``_add_block``."""
    now, means = watch.blocks % RING, watch.past_means
    watch.past_squares[2 * now + kind] = watch.wrench_square[kind]
    for i in range(3):
        means[6 * now + 3 * kind + i] = watch.mean_wrench[i]
    for d in range(ANSWERS):
        past = 6 * ((watch.blocks - STRIDE * (d + 1)) % RING) + 3 * kind
        along = 0.0
        for i in range(3):
            along += means[past + i] * watch.change[i]
        at = ANSWERS * kind + d
        watch.late_along[at] = watch.kept[0] * watch.late_along[at] + watch.block * along


@compiled
def _late_answer(watch: Part, kind: int, least: float) -> float:
    """Returns the largest c_s of all lags, or 0 without a known wrench at them."""
    largest, change = 0.0, watch.change_square[kind]
    for d in range(ANSWERS):
        past = 2 * ((watch.blocks - STRIDE * (d + 1)) % RING) + kind
        wrench = watch.past_squares[past]
        if wrench > max(least, 0.0) and change > 0.0:
            c = watch.late_along[ANSWERS * kind + d] / math.sqrt(wrench * change)
            largest = max(largest, c)
    return float(largest)


@compiled
def _is_slammed(watch: Part, kind: int) -> bool:
    """Adds a block to the missing power; returns True if a late force has long explained it."""
    work, at = watch.sent_power, len(SENT_LAGS) * kind
    burnt = watch.known_damping[kind] * watch.swung_square[kind]
    power = (burnt - max(work[at], work[at + 1])) / WORK_MEMORY
    mean = watch.kept[1] * (watch.missing_power[kind] - power) + power
    watch.missing_power[kind] = mean
    is_explained = max(work[at + 2], work[at + 3]) >= EXPLAINED * burnt
    goes_on = power >= GOES_ON * mean  # not one blow that is being forgotten
    if mean >= SLAM * watch.late_energy[kind] * watch.cap and is_explained and goes_on:
        watch.counts[6 * kind + 5] += 1
    else:
        watch.counts[6 * kind + 5] = 0
    return bool(watch.counts[6 * kind + 5] >= watch.slam_blocks and watch.cap > 0.0)


@compiled
def _verdict(s: State, kind: int) -> int:
    """Returns ``RUNS_AWAY`` or ``SWINGING`` for a finding, ``PROBED`` for a suspicion, else 0."""
    watch, counts, at = s.watch, s.watch.counts, 6 * kind
    late = 0.0
    for d in range(len(LAGS)):
        late = max(late, watch.delayed[len(LAGS) * kind + d])
    if watch.believed[kind] > BELIEVED * late:
        late = 0.0
    enough = watch.late_energy[kind] * watch.cap
    wrench, change = watch.wrench_square[kind], watch.change_square[kind]
    least = KNOWN_WRENCH * (watch.limits[kind] * s.guard.lever) ** 2
    is_known = wrench > max(least, 0.0) and change > KNOWN_MOTION * watch.whole_square[kind]
    taken = watch.power[kind] + watch.stated_delay * max(watch.along[kind], 0.0)
    power, along, across, delay = 1.0, 1.0, 1.0, 0.0
    if is_known and watch.speed_square[kind] > 0.0:
        scale = math.sqrt(wrench * change)
        along = watch.along[kind] / scale
        power = taken / math.sqrt(wrench * watch.speed_square[kind])
        if along >= FOLLOWED:
            burnt = _damping(s, kind) * watch.speed_square[kind]
            delay = (burnt - taken) / watch.along[kind]
        x, y, z = watch.across[3 * kind], watch.across[3 * kind + 1], watch.across[3 * kind + 2]
        across = math.sqrt(x * x + y * y + z * z) / scale
    is_working = late >= enough
    is_late = power <= LATE and late >= LITTLE * enough
    is_late = is_late or (power <= LATE_AT_WORK and is_working)
    counts[at] = counts[at] + 1 if is_late else 0
    has_delay = delay >= watch.delay_margin and is_working
    counts[at + 4] = counts[at + 4] + 1 if has_delay else 0
    is_reversed = along <= REVERSED and power <= FORWARD
    counts[at + 1] = counts[at + 1] + 1 if is_reversed else 0
    is_exchanged = across >= EXCHANGED and max(along, power) < FOLLOWED
    is_exchanged = is_exchanged or (across >= TURNED_AT_WORK and is_working and is_known)
    counts[at + 2] = counts[at + 2] + 1 if is_exchanged else 0
    is_answered = along <= 0.0 and power < FOLLOWED
    is_answered = is_answered and _late_answer(watch, kind, least) >= ANSWERED
    counts[at + 3] = counts[at + 3] + 1 if is_answered else 0
    is_slammed = _is_slammed(watch, kind)
    if counts[at + 1] >= BLOCKS or counts[at + 2] >= BLOCKS:
        return RUNS_AWAY
    has_swung = watch.flags & SWINGING != 0
    is_coarse = watch.steps[kind] >= STEPS
    is_found = max(counts[at], counts[at + 3]) >= BLOCKS or counts[at + 4] >= DELAY_BLOCKS
    is_found = is_found or is_slammed
    if is_coarse or is_found or (has_swung and is_working):
        return SWINGING
    is_suspicious = late >= MUCH * enough or watch.gained[kind] >= watch.gain[kind]
    return PROBED if is_suspicious else 0
