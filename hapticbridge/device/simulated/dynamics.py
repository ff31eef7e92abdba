"""State of a simulated device, and its compiled step from one sample to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import check_fields, option
from hapticbridge.device.trajectory import lissajous, pose_at
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.pose import (
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

# Hand that holds the device


@dataclass(frozen=True, slots=True, kw_only=True)
class Hand:
    """A hand: inertia fixed to the handle, with spring and damper to a moving target.

    The defaults are one measured arm at a handle. The rotational values are estimates of similar
    character (half a swing per second, well damped).

    Attributes:
        mass: Mass in kg, >= 0, fixed to the handle.
        damping: Damping in N s/m, >= 0, relative to the target's velocity.
        stiffness: Stiffness in N/m, >= 0.
        rotational_inertia: Rotational inertia in kg m², >= 0.
        rotational_damping: Rotational damping in N m s/rad, >= 0.
        rotational_stiffness: Rotational stiffness in N m/rad, >= 0.

    Raises:
        DeviceError: A value is not finite or negative.
    """

    mass: float = option(0.55, unit="kg", least=0.0)
    damping: float = option(6.5, unit="N s/m", least=0.0)
    stiffness: float = option(135.0, unit="N/m", least=0.0)
    rotational_inertia: float = option(1e-3, unit="kg m²", least=0.0)
    rotational_damping: float = option(0.02, unit="N m s/rad", least=0.0)
    rotational_stiffness: float = option(1.0, unit="N m/rad", least=0.0)

    def __post_init__(self) -> None:
        check_fields(self, DeviceError, "hand ")


DEFAULT_HAND = Hand()

NO_HAND = Hand(
    mass=0.0,
    damping=0.0,
    stiffness=0.0,
    rotational_inertia=0.0,
    rotational_damping=0.0,
    rotational_stiffness=0.0,
)


# Exact motion of one axis of a device in a hand

Record: TypeAlias = Any
"""Structured scalar inside compiled code, where fields are attributes. NumPy's type has none."""

LEVELS = 41
"""Number of dyadic parts of the period in which friction locates events, from T to T/2^40: 1e-15 s
at 1 kHz."""
_COARSEST_LEVEL = 6
"""Finest first part with friction, T/2^6. A faster axis would need more phases than
``_MAX_PHASES``."""

_MAX_PHASES = 64
"""Largest number of slipping and sticking phases within a period, which bounds the loop."""

AXIS_DTYPE = np.dtype(
    [
        ("inertia", "<f8"),
        ("damping", "<f8"),
        ("hand_damping", "<f8"),
        ("stiffness", "<f8"),
        ("friction", "<f8"),
        ("first_level", "<i8"),
        ("steps", "<f8", (LEVELS, 5)),
    ]
)
"""Law of motion of an axis: M, b, b_h, k_h and f_c in SI units. Per level i of time h = T/2^i it
holds the numbers h, d_0, d_1, −(k_h/M) d_1 and c_1 (beyond i = 0 only with friction).
``first_level`` is the longest time in which the acceleration changes its sign at most once."""


def sampled_axis(
    period: float,
    *,
    inertia: float,
    damping: float,
    hand_damping: float,
    stiffness: float,
    friction: float,
) -> NDArray[np.void]:
    """Returns the law of motion of an axis for a period, as one ``AXIS_DTYPE`` scalar array.

        M v' = F − s f_c − b v − b_h (v − ṗ) − k_h (x − p),        x' = v,    s = sign(v)

    M is the inertia of device and hand, b the device's damping, b_h and k_h the hand's damping and
    stiffness. The target p has the constant velocity ṗ; f_c is Coulomb friction. The relative
    velocity r = v − ṗ obeys the homogeneous M r'' + (b + b_h) r' + k_h r = 0 with r'(0) = a, the
    initial acceleration. So for any time h

        x(h) = x + h ṗ + d_0 r + d_1 a,        v(h) = v − (k_h/M) d_1 r + c_1 a

    d_0, d_1 and c_1 are elements of one matrix exponential, computed once per run. The form as
    increments avoids cancellation near rest.

    Args:
        period: T in s, > 0.
        inertia: M in kg (or kg m²), > 0.
        damping: b in N s/m (or N m s/rad), >= 0.
        hand_damping: b_h in N s/m (or N m s/rad), >= 0.
        stiffness: k_h in N/m (or N m/rad), >= 0.
        friction: f_c in N (or N m), >= 0.

    Raises:
        DeviceError: With friction, the axis swings more than 16 times within one period.
    """
    axis = np.zeros((), AXIS_DTYPE)
    axis["inertia"] = inertia
    axis["damping"] = damping
    axis["hand_damping"] = hand_damping
    axis["stiffness"] = stiffness
    axis["friction"] = friction
    # without friction only whole periods are needed
    levels = LEVELS if friction > 0.0 else 1
    times = period / 2.0 ** np.arange(levels)
    # state (∫r/h, r, h r') in units of h, so that all elements are of order one at every level
    generator = np.zeros((levels, 3, 3))
    generator[:, 0, 1] = generator[:, 1, 2] = 1.0
    generator[:, 2, 1] = -stiffness / inertia * times**2
    generator[:, 2, 2] = -(damping + hand_damping) / inertia * times
    from scipy.linalg import expm  # noqa: PLC0415 - 0.1 s, and only this device needs it

    transition = expm(generator)
    steps = axis["steps"][:levels]
    steps[:, 0] = times
    steps[:, 1] = times * transition[:, 0, 1]
    steps[:, 2] = times**2 * transition[:, 0, 2]
    steps[:, 3] = -stiffness / inertia * steps[:, 2]
    steps[:, 4] = times * transition[:, 1, 2]
    decay = (damping + hand_damping) / (2.0 * inertia)
    swing = math.sqrt(max(stiffness / inertia - decay * decay, 0.0))
    # r' vanishes at most once within half a swing, π/swing; half of that leaves a margin
    quarters = swing * period / (0.5 * math.pi)
    first_level = max(0, math.ceil(math.log2(quarters))) if quarters > 0.0 else 0
    if friction > 0.0 and first_level > _COARSEST_LEVEL:
        raise DeviceError(
            f"device and hand swing at {swing:.3g} rad/s, too fast for friction at a period of "
            f"{period:g} s; at most {0.5 * math.pi * 2**_COARSEST_LEVEL / period:.3g} rad/s"
        )
    axis["first_level"] = first_level
    return axis


@compiled
def moved(
    axis: Record, level: int, relative_velocity: float, acceleration: float, drift: float
) -> tuple[float, float]:
    """Returns the increments of position and velocity over the time T/2^level, without friction.

    The arguments are v − ṗ and v' at the start, and the target's velocity ṗ (``drift``).
    """
    step = axis.steps[level]
    return (
        step[0] * drift + step[1] * relative_velocity + step[2] * acceleration,
        step[3] * relative_velocity + step[4] * acceleration,
    )


@compiled
def acceleration_at(
    axis: Record, force: float, stretch: float, velocity: float, drift: float
) -> float:
    """Returns v' for a force F (friction included), x − p, v and ṗ."""
    dampers = axis.damping * velocity + axis.hand_damping * (velocity - drift)
    acceleration: float = (force - dampers - axis.stiffness * stretch) / axis.inertia
    return acceleration


@compiled
def _slide(
    axis: Record,
    units_left: int,
    force: float,
    motion: tuple[float, float],
    drift: float,
    direction: float,
) -> tuple[int, float, float, float]:
    """Slides in one direction until the velocity vanishes or the time ends.

    ``motion`` is the stretch x − p and the velocity.

    A step is accepted if the velocity keeps its sign at its end and cannot have vanished in
    between. It can have if the acceleration changes from against the motion to along it. Otherwise
    half the time is tried, which brackets the event down to T/2^40.

    Returns:
        Remaining time in units of T/2^40, distance travelled, new stretch x − p, new velocity.
    """
    travel, (stretch, velocity) = 0.0, motion
    friction = direction * axis.friction
    level = axis.first_level
    is_bracketed = is_past_dip = False
    while units_left > 0:
        units = 1 << (LEVELS - 1 - level)
        if units > units_left:
            level += 1
            continue
        start = acceleration_at(axis, force - friction, stretch, velocity, drift)
        if velocity == 0.0:
            # at the moment of breaking away, rounding must not reverse the acceleration
            start = direction * max(direction * start, 0.0)
        dx, dv = moved(axis, level, velocity - drift, start, drift)
        next_stretch = stretch + (dx - units * axis.steps[LEVELS - 1, 0] * drift)
        next_velocity = velocity + dv
        end = acceleration_at(axis, force - friction, next_stretch, next_velocity, drift)
        is_stopped = not next_velocity * direction > 0.0
        is_dip = not is_past_dip and direction * start < 0.0 and direction * end > 0.0
        if is_stopped and level == LEVELS - 1:
            return units_left, travel, stretch, 0.0
        if (is_stopped or is_dip) and level < LEVELS - 1:
            is_bracketed = True
            level += 1
            continue
        units_left -= units
        travel += dx
        stretch = next_stretch
        velocity = next_velocity
        is_past_dip = False
        if is_bracketed:
            if level < LEVELS - 1:
                level += 1
            else:
                # The event was a dip that did not reach zero, and has passed. Within half a swing
                # there is no other; rounding errors must not start another search.
                is_past_dip = True
                is_bracketed = False
                level = axis.first_level
    return units_left, travel, stretch, velocity


@compiled
def moved_with_friction(
    axis: Record, force: float, stretch: float, velocity: float, drift: float
) -> tuple[float, float]:
    """Returns the increment of position and the new velocity after one period, with friction.

    At rest the axis sticks while |F + b_h ṗ − k_h (x − p)| <= f_c. The moment of breaking away is
    found in closed form, the moment of coming to rest by bisection. The arguments are F in N, x − p
    in m and v in m/s at the start, and ṗ in m/s (``drift``).
    """
    travel = 0.0
    unit = axis.steps[LEVELS - 1, 0]
    limit = axis.friction
    units_left = 1 << (LEVELS - 1)
    if not math.isfinite(force + stretch + velocity + drift):
        return math.nan, math.nan
    for _ in range(_MAX_PHASES):
        if units_left == 0:
            return travel, velocity
        direction = math.copysign(1.0, velocity)
        if velocity == 0.0:
            pull = axis.inertia * acceleration_at(axis, force, stretch, 0.0, drift)
            direction = math.copysign(1.0, pull)
            if abs(pull) <= limit:
                rate = axis.stiffness * drift
                direction = math.copysign(1.0, rate)
                wait = (direction * limit - pull) / rate / unit if rate != 0.0 else math.inf
                units = units_left if wait >= units_left else math.ceil(wait)
                stretch -= units * unit * drift
                units_left -= units
        units_left, dx, stretch, velocity = _slide(
            axis, units_left, force, (stretch, velocity), drift, direction
        )
        travel += dx
    return travel, 0.0


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
