"""State of a simulated device, and its compiled step from one sample to the next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.simulated.sampled_axis import (
    AXIS_DTYPE,
    Record,
    acceleration_at,
    moved,
    moved_with_friction,
)
from hapticbridge.device.trajectory.motion import lissajous, pose_at
from hapticbridge.jit import compiled
from hapticbridge.pose import (
    Quaternion,
    Vector,
    canonical,
    product,
    quaternion_exp,
    quaternion_log,
    quaternion_of,
    rotation_between,
    scaled,
    store_quaternion,
    vector_of,
)

MAX_DELAY = 100
"""Largest output delay in samples."""

FREE, IN_A_HAND, ON_A_LINE = 0, 1, 2
"""Holder of the device: none, a hand of inertia, damper and spring, or the lossless line of the
worst passive hand."""

STATE_DTYPE = np.dtype(
    [
        ("tick", "<i8"),
        ("cursor", "<i8"),
        ("period", "<f8"),
        ("holder", "<i8"),
        ("position", "<f8", 3),
        ("velocity", "<f8", 3),
        ("quaternion", "<f8", 4),
        ("angular_velocity", "<f8", 3),
        ("target_position", "<f8", 3),
        ("target_quaternion", "<f8", 4),
        ("resolution", "<f8"),
        ("rotational_resolution", "<f8"),
        ("delay", "<i8"),
        ("written", "<f8", 6),
        ("on_the_way", "<f8", (MAX_DELAY + 1, 6)),
        ("translation", AXIS_DTYPE),
        ("rotation", AXIS_DTYPE),
        ("translation_line", "<f8", 3),
        ("rotation_line", "<f8", 3),
        ("held_before", "<f8", 6),
    ]
)
"""State of the step. ``written`` is the newest wrench; ``on_the_way`` is a ring of ``delay`` + 1
wrenches between the write and the motors; ``holder`` is ``FREE``, ``IN_A_HAND`` or ``ON_A_LINE``.
The lines hold p, q, r of v_k = p v_{k−1} + q F_k + r F_{k−1}."""


@compiled
def _translate(s: Record, wrench: NDArray[np.float64], target: Vector) -> None:
    """Advances the position by one period, each axis separately."""
    axis = s.translation
    for i in range(3):
        drift = (target[i] - s.target_position[i]) / s.period
        stretch = s.position[i] - s.target_position[i]
        velocity = s.velocity[i]
        if axis.friction > 0.0:
            travel, s.velocity[i] = moved_with_friction(axis, wrench[i], stretch, velocity, drift)
        else:
            acceleration = acceleration_at(axis, wrench[i], stretch, velocity, drift)
            travel, gain = moved(axis, 0, velocity - drift, acceleration, drift)
            s.velocity[i] += gain
        s.position[i] += travel
        s.target_position[i] = target[i]


@compiled
def _turn_about(s: Record, i: int, torque: float, angle: float, drift: float) -> float:
    """Returns the rotation about one axis over one period, and updates its velocity."""
    velocity = s.angular_velocity[i]
    acceleration = acceleration_at(s.rotation, torque, angle, velocity, drift)
    turn, gain = moved(s.rotation, 0, velocity - drift, acceleration, drift)
    s.angular_velocity[i] += gain
    return turn


@compiled
def _rotate(s: Record, wrench: NDArray[np.float64], target: Quaternion) -> None:
    """Advances the orientation by one period, along the axes of the device's frame."""
    old, q = quaternion_of(s.target_quaternion), quaternion_of(s.quaternion)
    drift = scaled(1.0 / s.period, rotation_between(old, target))
    angle = rotation_between(old, q)
    turn = (
        _turn_about(s, 0, wrench[3], angle[0], drift[0]),
        _turn_about(s, 1, wrench[4], angle[1], drift[1]),
        _turn_about(s, 2, wrench[5], angle[2], drift[2]),
    )
    store_quaternion(s.quaternion, canonical(product(quaternion_exp(turn), q)))
    store_quaternion(s.target_quaternion, target)


@compiled
def _follow_lines(s: Record, wrench: NDArray[np.float64]) -> None:
    """Advances all axes by one period with device and worst hand together (``WorstHand``)."""
    line = s.translation_line
    for i in range(3):
        s.velocity[i] = line[0] * s.velocity[i] + line[1] * wrench[i] + line[2] * s.held_before[i]
        s.position[i] += s.period * s.velocity[i]
    line = s.rotation_line
    for i in range(3):
        before = s.held_before[3 + i]
        s.angular_velocity[i] = (
            line[0] * s.angular_velocity[i] + line[1] * wrench[3 + i] + line[2] * before
        )
    for i in range(6):
        s.held_before[i] = wrench[i]
    turn = quaternion_exp(scaled(s.period, vector_of(s.angular_velocity)))
    store_quaternion(s.quaternion, canonical(product(turn, quaternion_of(s.quaternion))))


@compiled
def next_sample(
    states: NDArray[np.void], motion: NDArray[np.float64], samples: NDArray[np.void]
) -> None:
    """Advances device and hand by one period (not before the first sample) and writes the pose."""
    s = states[0]
    if s.tick > 0:
        # the wrench written in tick k - 1 leaves the ring of delay + 1 places in tick k + delay
        line = s.delay + 1
        entry = s.on_the_way[(s.tick - 1) % line]
        for i in range(6):
            entry[i] = s.written[i]
        wrench = s.on_the_way[s.tick % line]
        if s.holder == ON_A_LINE:
            _follow_lines(s, wrench)
        else:
            position, quaternion = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
            if s.holder == IN_A_HAND:
                if motion.shape[0] > 0:
                    s.cursor, position, quaternion = pose_at(motion, s.tick * s.period, s.cursor)
                else:
                    position, quaternion = lissajous(s.tick * s.period)
            _translate(s, wrench, position)
            _rotate(s, wrench, quaternion)
    s.tick += 1
    sample = samples[0]
    sample.buttons = 0
    for i in range(3):
        sample.position[i] = _rounded(s.position[i], s.resolution)
    q = quaternion_of(s.quaternion)
    if s.rotational_resolution > 0.0:
        v = quaternion_log(q)
        step = s.rotational_resolution
        q = canonical(
            quaternion_exp((_rounded(v[0], step), _rounded(v[1], step), _rounded(v[2], step)))
        )
    store_quaternion(sample.quaternion, q)


@compiled
def _rounded(value: float, step: float) -> float:
    """Returns the nearest multiple of a step, or the value itself for a step of zero."""
    return step * np.round(value / step) if step > 0.0 else value
