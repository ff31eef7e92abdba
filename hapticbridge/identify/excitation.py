"""Excitation force of one axis: tones whose amplitude follows the travel."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.pose import conjugate, product, quaternion_log

Record: TypeAlias = Any
"""Structured scalar inside compiled code, where fields are attributes. NumPy's type has none."""

LOWEST, HIGHEST, TONES = 0.7, 12.0, 9
"""Lowest and highest frequency in Hz and number of tones, evenly spaced in log frequency. Low tones
show damping and friction, high tones show mass. Above 12 Hz an axis of 1 kg moves less than an
encoder resolves; below 0.7 Hz a run of 12 s holds too few swings."""

SLOW_PERIOD = 0.003
"""Loop period in s above which all times of a run are stretched in proportion. A window of the fit
needs ``MIN_SAMPLES`` periods within half a swing, so slower loops need slower motion."""

_TILT, _SLOW_TILT = -0.3, -1.0
"""Exponents of a tone's amplitude over its frequency, without unit. With the first, all tones move
a damped axis by similar amounts. The second, for slow loops, favours low tones; otherwise swings
would be too short for ``MIN_SAMPLES``."""

START_SHARE = 0.03
"""Initial amplitude as a share of the force limit, without unit. It grows until the axis moves."""

GROWTH, SHRINKING = 0.7, 0.5
"""Time constants in s with which the amplitude grows while the axis moves too little, and shrinks
while it moves too much. Faster growth overshoots the travel, slower growth wastes the run."""

ENOUGH, TOO_MUCH = 0.4, 0.6
"""Shares of the travel, without unit, between which the amplitude is kept. The largest deflection
is then 1.4 times the travel, and twice it for a light device that breaks away from its friction
(maximum of 300 runs: 2.14). Larger shares overshoot more, smaller ones cross too few encoder
steps."""

_RESCUE = 0.05
"""Time constant in s with which the amplitude shrinks while the axis is beyond the travel, as after
a light axis breaks away from its friction."""

_MEMORY = 0.7
"""Time constant in s of the largest recent deflection: half of the slowest swing."""

CENTRING = (40.0, 0.1)
"""Stiffness in N/m and N m/rad of the spring that keeps every axis near its start. It is part of
the known force, so it does not disturb the fit. A stiffer spring leaves less travel to the
signal."""

CALMING = (1.0, 1e-3)
"""Damping in N s/m and N m s/rad, applied to the mean velocity over the last ``SPAN``. Without it a
heavy device of low damping would swing for a long time. More would mask the damping to be
measured."""

SPAN = 0.01
"""Time in s over which the velocity is averaged. Encoder steps of 0.1 mm then cause 0.01 N of
noise."""

WEIGHT_TIME = 2.0
"""Time in s in which the integral of the centring spring takes over a weight."""

OK, FAR, TURNED_FAR, FAST, TURNED_FAST, BAD_POSE = range(6)

STATE_DTYPE = np.dtype(
    [
        ("tick", "<i8"),
        ("axis", "<i8"),
        ("period", "<f8"),
        ("present", "<f8", 6),
        ("force", "<f8", 2),
        ("travel", "<f8", 2),
        ("farthest", "<f8", 2),
        ("fastest", "<f8", 2),
        ("position", "<f8", 3),
        ("quaternion", "<f8", 4),
        ("place", "<f8", 6),
        ("before", "<f8", 6),
        ("weight", "<f8", 6),
        ("amplitude", "<f8"),
        ("reach", "<f8"),
    ]
)
"""State of one run, per kind of axis where a field has two values (translation, rotation).

Period T in s; presence of the six axes (1 or 0); limits on force, travel, distance and speed; pose
at the start; displacement from it now and one tick earlier (m, then rotation vector in rad);
integral of the springs in N and N m; amplitude and recent reach of the signal."""


def stretch(period: float) -> float:
    """Returns the factor by which a period in s stretches all times of a run, 1 from 333 Hz."""
    return max(1.0, period / SLOW_PERIOD)


def signal(axis_index: int, ticks: int, period: float) -> NDArray[np.float64]:
    """Returns a sum of tones in [−1, 1], shape (ticks,), for a period in s and an axis from 0 to 5.

    The phases are random and depend on the axis only.
    """
    generator = np.random.default_rng(axis_index)
    frequencies = np.geomspace(LOWEST, HIGHEST, TONES) / stretch(period)
    tilt = _TILT if period <= SLOW_PERIOD else _SLOW_TILT
    phases = generator.uniform(0.0, 2.0 * np.pi, TONES)
    time = period * np.arange(ticks)
    tones = np.sin(2.0 * np.pi * frequencies[:, None] * time + phases[:, None])
    summed = (frequencies**tilt) @ tones
    return np.asarray(summed / np.abs(summed).max())


@compiled
def next_wrench(
    states: NDArray[np.void],
    samples: NDArray[np.void],
    past: NDArray[np.float64],
    tone: float,
    ticks_passed: int,
    wrench: NDArray[np.float64],
) -> int:
    """Computes the wrench of a tick from its sample; returns ``OK`` or the code of a fault.

        F = a s(t) − k q − B q̇ − (k/τ) ∫ q

    Args:
        states: ``STATE_DTYPE``, shape (1,).
        samples: The device's sample, ``SAMPLE_DTYPE``, shape (1,).
        past: Ring of displacements over the last ``SPAN``, shape (n, 6).
        tone: s of this tick.
        ticks_passed: Periods since the last new sample.
        wrench: Output, shape (6,).
    """
    s = states[0]
    code = _displace(s, samples[0], ticks_passed * s.period)
    if code != OK:
        return code
    deflection = abs(s.place[s.axis])
    time = min(s.period, SLOW_PERIOD)  # slow loops stretch all times
    s.reach = max(deflection, s.reach * math.exp(-time / _MEMORY))
    kind = 0 if s.axis < 3 else 1
    if deflection > s.travel[kind]:
        s.amplitude *= math.exp(-s.period / _RESCUE)
    elif s.reach > TOO_MUCH * s.travel[kind]:
        s.amplitude *= math.exp(-time / SHRINKING)
    elif s.reach < ENOUGH * s.travel[kind]:
        s.amplitude = min(s.amplitude * math.exp(time / GROWTH), s.force[kind])
    oldest = past[s.tick % len(past)]
    for i in range(6):
        spring = CENTRING[0] if i < 3 else CENTRING[1]
        damper = CALMING[0] if i < 3 else CALMING[1]
        speed = (s.place[i] - oldest[i]) / (len(past) * s.period)
        oldest[i] = s.place[i]
        s.weight[i] -= spring * s.place[i] * s.period / WEIGHT_TIME
        wrench[i] = s.present[i] * (s.weight[i] - spring * s.place[i] - damper * speed)
    wrench[s.axis] += s.amplitude * tone
    for j in range(2):
        size = math.sqrt(wrench[3 * j] ** 2 + wrench[3 * j + 1] ** 2 + wrench[3 * j + 2] ** 2)
        if size > s.force[j]:
            for i in range(3 * j, 3 * j + 3):
                wrench[i] *= s.force[j] / size
    s.tick += 1
    return OK


@compiled
def _displace(s: Record, sample: Record, time: float) -> int:
    """Computes the displacement from the first sample; returns ``OK`` or the code of a fault."""
    q = sample.quaternion
    square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    total = square + sample.position[0] + sample.position[1] + sample.position[2]
    if not math.isfinite(total) or not 0.25 < square < 4.0:
        return BAD_POSE
    if s.tick == 0:
        s.position[:] = sample.position
        s.quaternion[:] = sample.quaternion
    turn = quaternion_log(
        product(
            (q[0], q[1], q[2], q[3]),
            conjugate((s.quaternion[0], s.quaternion[1], s.quaternion[2], s.quaternion[3])),
        )
    )
    for i in range(3):
        s.before[i] = s.place[i]
        s.before[3 + i] = s.place[3 + i]
        s.place[i] = sample.position[i] - s.position[i]
        s.place[3 + i] = turn[i]
    for j in range(2):
        square = moved = 0.0
        for i in range(3 * j, 3 * j + 3):
            square += s.place[i] ** 2
            moved += (s.place[i] - s.before[i]) ** 2
        if not square <= s.farthest[j] ** 2:
            return TURNED_FAR if j else FAR
        if not moved <= (s.fastest[j] * time) ** 2:
            return TURNED_FAST if j else FAST
    return OK
