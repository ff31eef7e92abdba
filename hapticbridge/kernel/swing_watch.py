"""Watch for a device whose force comes late or with the wrong sign, which no energy account sees.

The account believes that a force acts at once. A force that acts a time s late does the work

    E_s = Σ (w_{k−1−s}·δp_k − b ‖δp_k‖²/T),    E_0 = Σ w_{k−1}·δp_k

w is the wrench sent (N, N m), δp the motion read (m, rad), both without what swings slower than 4
Hz; b the device's damping, T the period. A span of 100 ms counts if, for one s of 2, 5, 10 and 20
ms, E_s is at least 8 mJ and E_0 less than a quarter of it. After three such spans in a row the
greatest ratio r of the lever between device and handle is halved, hence the stiffness quartered.
If instead the device gains 0.1 m/s against at least 6 N, within some 30 ms, the force pushes where
it should resist, and r falls to 0.

Reasons for the numbers: 780 random hands at up to 1.5 Hz on 13 scenes stay below 3 mJ and reach
0.05 m/s, a hand that taps a wall at 8 Hz with 4 N stays below 5 mJ. Devices 3 to 20 ms late pass 8
mJ, a reversed axis 0.1 m/s, before the hand was given 0.2 J. The delays cover swings from 4 to 200
Hz, because a delay is seen best at a quarter of the swing. A hand that hits a wall at 8 Hz with 10
N and 12 mm is taken for a swing, since force and motion are the same then; it loses stiffness.
Only forces are watched for their sign, not torques, and a device of less than 6 N never is.
"""

from __future__ import annotations

import math

import numpy as np

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import RUNS_AWAY, SWINGING, Part, State
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.pose import Vector

DELAYS = (0.002, 0.005, 0.010, 0.020)
"""Delays in s for which the work is computed."""

RING = 128
"""Wrenches that are kept; above 6.3 kHz the longest delay is 127 ticks."""

SLOWEST = 4.0
"""Corner of the two filters in Hz. Hands move at will up to 1.5 Hz; an arm that holds a device 20
ms late swings at 4.5 Hz."""

SPAN, SPANS, BELIEVED = 0.1, 3, 0.25
"""Length of a span in s, spans in a row, and largest share of the work that the account may see. A
knock or a slip lies in two spans at most; E_0 is large where the scene itself moves the device."""

RESISTED, SMOOTHING, MEMORY = 6.0, 0.005, 0.03
"""Force in N against which a device runs away, time in s over which its speed is smoothed, and time
in s after which a gain of speed is forgotten. Below 6 N the tool's inertia hides the sign."""

WATCH_DTYPE = np.dtype(
    [
        ("span_ticks", "<i8"),
        ("delays", "<i8", len(DELAYS)),
        ("tick", "<i8"),
        ("flags", "<i8"),
        ("spans", "<i8", len(DELAYS)),
        ("swing_energy", "<f8"),
        ("runaway_speed", "<f8"),
        ("corner", "<f8"),
        ("max_share", "<f8"),
        ("believed", "<f8"),
        ("delayed", "<f8", len(DELAYS)),
        ("gained", "<f8"),
        ("speed", "<f8", 3),
        ("slow", "<f8", 24),
        ("ring", "<f8", 6 * RING),
    ]
)
"""Sub-record ``watch``, written by this module alone. ``span_ticks`` is 0 without a watch;
``delays`` in ticks; ``spans`` counts spans in a row; ``corner`` is the filters' gain per tick, and
``slow`` what they take away; ``believed`` and ``delayed`` are E_0 and E_s in J; ``gained`` and
``speed`` in m/s; ``max_share`` is the greatest ratio r allowed."""


def bind_watch(watch: Part, parameters: RunParameters) -> None:
    """Fills in the thresholds; without a finite one there is no watch."""
    limits, period = parameters.guarding, parameters.period
    watch["swing_energy"], watch["runaway_speed"] = limits.swing_energy, limits.runaway_speed
    watch["max_share"] = 1.0
    watch["delays"] = [min(max(round(delay / period), 1), RING - 1) for delay in DELAYS]
    watch["corner"] = 1.0 - math.exp(-2.0 * math.pi * SLOWEST * period)
    if math.isfinite(min(limits.swing_energy, limits.runaway_speed)):
        watch["span_ticks"] = max(round(SPAN / period), 1)


@compiled
def watch_device(s: State, moved: Vector, turned: Vector) -> None:
    """Takes the motion in which the last wrench was held, and lowers ``max_share`` if it must.

    Args:
        s: The bound state, before the new wrench.
        moved: Motion of the device in m since the last sample.
        turned: Its rotation vector in rad.
    """
    watch = s.watch
    if watch.span_ticks == 0:
        return
    if s.loop.tick > s.guard.start_tick:
        _watch_sign(s, moved)
        _add_work(s, moved, turned)
    watch.tick += 1
    if watch.tick % watch.span_ticks == 0:
        _close_span(watch)


@compiled
def _fast(watch: Part, at: int, value: float) -> float:
    """Returns a value less what swings slowly: two filters of first order in a row."""
    slow, corner = watch.slow, watch.corner
    slow[at] += corner * (value - slow[at])
    value -= slow[at]
    slow[at + 12] += corner * (value - slow[at + 12])
    return float(value - slow[at + 12])


@compiled
def _add_work(s: State, moved: Vector, turned: Vector) -> None:
    """Adds a tick's work, as believed and for each delay."""
    watch, w, ring = s.watch, s.loop.wrench_on_device, s.watch.ring
    newest = 6 * (watch.tick % RING)
    rate, b, b_r = 1.0 / s.run.period, s.observer.assumed_damping, 0.0
    b_r = s.observer.assumed_rotational_damping
    burnt = 0.0
    first = _fast(watch, 6, moved[0])
    second = _fast(watch, 7, moved[1])
    third = _fast(watch, 8, moved[2])
    fourth = _fast(watch, 9, turned[0])
    fifth = _fast(watch, 10, turned[1])
    sixth = _fast(watch, 11, turned[2])
    for i in range(6):
        ring[newest + i] = _fast(watch, i, w[i])
    burnt = rate * b * (first * first + second * second + third * third)
    burnt += rate * b_r * (fourth * fourth + fifth * fifth + sixth * sixth)
    for d in range(len(DELAYS) + 1):
        late = 0 if d == 0 else watch.delays[d - 1]
        at = 6 * ((watch.tick - late) % RING)
        work = ring[at] * first + ring[at + 1] * second + ring[at + 2] * third
        work += ring[at + 3] * fourth + ring[at + 4] * fifth + ring[at + 5] * sixth
        if d == 0:
            watch.believed += work
        else:
            watch.delayed[d - 1] += work - burnt


@compiled
def _close_span(watch: Part) -> None:
    """Counts the span for each delay, and halves the greatest ratio after enough of them."""
    swings = False
    for d in range(len(DELAYS)):
        work = watch.delayed[d]
        counts = work >= watch.swing_energy and watch.believed <= BELIEVED * work
        watch.spans[d] = watch.spans[d] + 1 if counts else 0
        swings = swings or watch.spans[d] >= SPANS
        watch.delayed[d] = 0.0
    watch.believed = 0.0
    if swings:
        watch.max_share *= 0.5
        watch.flags |= SWINGING
        for d in range(len(DELAYS)):
            watch.spans[d] = 0


@compiled
def _watch_sign(s: State, moved: Vector) -> None:
    """Takes the force away if the device gains speed against it."""
    watch, w = s.watch, s.loop.wrench_on_device
    part = min(s.run.period / SMOOTHING, 1.0)
    force = math.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    against = change = 0.0
    for i in range(3):
        faster = part * (moved[i] / s.run.period - watch.speed[i])
        watch.speed[i] += faster
        against -= w[i] * watch.speed[i]
        change -= w[i] * faster
    if force < RESISTED or against <= 0.0:
        watch.gained = 0.0
        return
    kept = max(1.0 - s.run.period / MEMORY, 0.0)
    watch.gained = max(kept * watch.gained + change / force, 0.0)
    if watch.gained >= watch.runaway_speed:
        watch.max_share = 0.0
        watch.flags |= RUNS_AWAY
