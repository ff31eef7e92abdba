"""Geometry of the Falcon's three legs: thigh angles and grip position.

The maker's frame, in m: z from the base towards the user along the machine's axis, x to the right,
y up. With all three thighs at the encoders' zero the grip is at (0, 0, 0.1346). Leg i is rotated by
φ_i about z. In its own frame (u outwards, v sideways, w = z), measured from the hip's axis,

    u = x cos φ + y sin φ − r,    v = −x sin φ + y cos φ − s,    w = z

The thigh of length a swings by θ in the plane (u, w). The shin is a parallelogram of side b that
leans sideways by v + f, between two short links d and e along the leg's plane. It ends at the grip
plate, c inwards of the grip's own point. The leg closes if

    h(p, θ) = √((u + c − a cos θ)² + (w − a sin θ)²) − L(v) = 0,    L(v) = √(b² − (v + f)²) + d + e

h is a length. Its gradient along p has nearly unit length, so Newton's steps are well scaled.
Because of d + e the surface is not a sphere: the grip's position has no closed form, but θ has.

Every function reports by its result whether a solution exists, and none returns a non-finite
number.

References:
    Stamper 1997 (the mechanism); the lengths are those of libnifalcon's source (2019).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.falcon.protocol import Request, encode
from hapticbridge.kernel.jit import compiled

THIGH, SHIN = 0.060, 0.1025
"""Lengths a and b in m: thigh, and long side of the parallelogram."""

PLATE, LINKS = 0.01443, 2 * 0.01125
"""Lengths c and d + e in m: from the grip's point to the plate's joint, and the two links of the
shin."""

SIDEWAYS, HIP_OUT, HIP_SIDEWAYS = -0.025, 0.0400, -0.02309
"""Offsets f, r and s in m: the plate's joint sideways of the leg's plane, and the hip's axis
outwards and sideways."""

LEG_ANGLES = np.radians([105.0, -15.0, -135.0])
"""Angles φ in rad: a third of a turn apart, 15° off the maker's frame."""

RADIANS_PER_COUNT = 2 * math.pi / (4 * 320) * 0.01425 / 0.110
"""Thigh angle in rad per encoder count, 6.36e-4: 320 slots with four counts each per turn, on a
shaft of 14.25 mm that drives a sector of 110 mm."""

ZERO_ANGLE = math.radians(35.0)
"""Thigh angle in rad at which a homed encoder reads 0."""

MAX_RADIUS, NEAREST, FARTHEST = 0.075, 0.060, 0.190
"""Limits of a plausible grip position in m: distance from the axis, and smallest and largest
distance along it. The workspace is 0.1 m wide and reaches from 0.075 to 0.175 m. Positions beyond
the limits mean a wrong encoder; tighter limits would refuse a grip that leans at its stop."""

STEPS = 12
"""Largest number of Newton steps. From the middle of the workspace 6 reach its corners, 2 are
usual."""

MAX_STEP = 0.02
"""Longest Newton step in m: a fifth of the workspace. A longer first step could leave the region in
which the legs can lean."""

CLOSED = 1e-14
"""Largest closure error of the legs in m. Rounding leaves 3e-17, and the limit is far below an
encoder's step."""

FLATTEST = 0.03
"""Smallest |det| of the legs' directions, and smallest lever relative to the thigh, without unit.
In the middle of the workspace they are 0.8 and 0.98, at its rim 0.07 and 0.05. At 0 a leg is
stretched or folded, and two positions have equal angles."""

_COS, _SIN = np.cos(LEG_ANGLES), np.sin(LEG_ANGLES)


@compiled
def is_within_reach(position: NDArray[np.float64]) -> bool:
    """Returns whether a grip position in m, shape (3,), is plausible."""
    aside = math.sqrt(position[0] ** 2 + position[1] ** 2)
    return aside <= MAX_RADIUS and NEAREST <= position[2] <= FARTHEST


@compiled
def closure(
    position: NDArray[np.float64],
    angles: NDArray[np.float64],
    gaps: NDArray[np.float64],
    gradients: NDArray[np.float64],
    levers: NDArray[np.float64],
) -> bool:
    """Computes the closure error of each leg and its derivatives; returns whether they exist.

    Args:
        position: Shape (3,), in m.
        angles: Shape (3,), in rad.
        gaps: Output: h of each leg in m, shape (3,).
        gradients: Output: ∂h/∂p, a row per leg, without unit, shape (3, 3).
        levers: Output: ∂h/∂θ in m, shape (3,); negative with the knee outside.
    """
    for i in range(3):
        out = position[0] * _COS[i] + position[1] * _SIN[i] - HIP_OUT + PLATE
        lean = -position[0] * _SIN[i] + position[1] * _COS[i] - HIP_SIDEWAYS + SIDEWAYS
        height = position[2]
        across, along = THIGH * math.cos(angles[i]), THIGH * math.sin(angles[i])
        squared = SHIN * SHIN - lean * lean
        distance = math.sqrt((out - across) ** 2 + (height - along) ** 2)
        if not (squared > 0.0 and distance > 0.0):
            return False
        side = math.sqrt(squared)
        gaps[i] = distance - side - LINKS
        outwards, sideways = (out - across) / distance, lean / side
        gradients[i, 0] = outwards * _COS[i] - sideways * _SIN[i]
        gradients[i, 1] = outwards * _SIN[i] + sideways * _COS[i]
        gradients[i, 2] = (height - along) / distance
        levers[i] = (out * along - height * across) / distance
    return True


@compiled
def solve(
    rows: NDArray[np.float64], right: NDArray[np.float64], answer: NDArray[np.float64]
) -> float:
    """Solves rows · answer = right, shapes (3, 3), (3,), by Cramer's rule; returns the determinant.

    For a determinant of 0 the answer is unchanged.
    """
    a, b, c = rows[0], rows[1], rows[2]
    x0, x1, x2 = (b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0])
    determinant = a[0] * x0 + a[1] * x1 + a[2] * x2
    if determinant == 0.0:
        return 0.0
    y0, y1, y2 = (c[1] * a[2] - c[2] * a[1], c[2] * a[0] - c[0] * a[2], c[0] * a[1] - c[1] * a[0])
    z0, z1, z2 = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    answer[0] = (right[0] * x0 + right[1] * y0 + right[2] * z0) / determinant
    answer[1] = (right[0] * x1 + right[1] * y1 + right[2] * z1) / determinant
    answer[2] = (right[0] * x2 + right[1] * y2 + right[2] * z2) / determinant
    return float(determinant)


@compiled
def forward(angles: NDArray[np.float64], position: NDArray[np.float64]) -> bool:
    """Computes the grip position of the thigh angles; returns whether it exists.

    Newton's method on the three closures starts from the current position, in a loop the last one.
    The solution must be plausible, have every knee outside, and have no leg stretched or folded.

    Args:
        angles: Shape (3,), in rad.
        position: Start and output, shape (3,), in m; unchanged without a solution.
    """
    point, step = position.copy(), np.empty(3)
    gaps, gradients, levers = np.empty(3), np.empty((3, 3)), np.empty(3)
    for _ in range(STEPS):
        if not closure(point, angles, gaps, gradients, levers):
            return False
        determinant = solve(gradients, gaps, step)
        if not abs(determinant) >= FLATTEST:
            return False
        length = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        point -= step * min(1.0, MAX_STEP / max(length, MAX_STEP))
        if max(abs(gaps[0]), abs(gaps[1]), abs(gaps[2])) < CLOSED:
            for i in range(3):
                if not levers[i] <= -FLATTEST * THIGH:
                    return False
            if not is_within_reach(point):
                return False
            position[:] = point
            return True
    return False


# Statics of the Falcon's legs


@compiled
def thigh_torques(
    position: NDArray[np.float64],
    angles: NDArray[np.float64],
    force: NDArray[np.float64],
    torques: NDArray[np.float64],
) -> bool:
    """Computes the thigh torques of a force at the grip: τ = J⁻ᵀ F, J = ∂θ/∂p.

    By virtual work τ·δθ = F·δp for every motion.

    Args:
        position: Shape (3,), in m.
        angles: Shape (3,), in rad, those of the position.
        force: Shape (3,), in N, in the maker's frame.
        torques: Output, shape (3,), in N m; zero without a solution.

    Returns:
        Whether a solution exists.
    """
    torques[:] = 0.0
    gaps, gradients, levers = np.empty(3), np.empty((3, 3)), np.empty(3)
    if not closure(position, angles, gaps, gradients, levers):
        return False
    answer = np.empty(3)
    if not abs(solve(gradients.T.copy(), force, answer)) >= FLATTEST:
        return False
    for i in range(3):
        torques[i] = -levers[i] * answer[i]
    return True


# Poses and forces of a Falcon from its packets

MOTION_DTYPE = np.dtype([("position", "<f8", 3), ("angles", "<f8", 3), ("motors", "<i8", 3)])
"""State carried from tick to tick: position of the grip in the maker's frame in m, its thigh angles
in rad, and the motor units of the last command."""

PLACE = (0.0, 0.0, 0.125)
"""Middle of the workspace in the maker's frame, in m: half way between 0.075 and 0.175 from the
base. It is the origin of the device's frame."""

UNITS_PER_TORQUE = -1e4
"""Motor units per N m at the thigh, with sign, from libnifalcon. No calibration of the scale is
published."""

MOTOR_LIMIT = 4096.0
"""Largest command to a motor in motor units. 9 N along the axis take 2259 on each motor, 9 N across
it 5200 on one. Programs based on libnifalcon clamp at a similar value."""

FORCE_LIMIT = 8.0
"""Largest force in N: the value that CHAI3D allows for a Falcon. The maker states above 8.9 N."""

SPEED_LIMIT = 3.0
"""Largest plausible speed in m/s. No figure is published; a hand at this speed crosses the
workspace of 0.1 m in 33 ms."""

MAX_COUNTS = 3000
"""Largest encoder count of a thigh on either side of zero: -74° to 144°. The workspace takes -66°
to 114°. One more turn would lead to the same position again."""

FLAGS = int(Request.GREEN)
"""Light during the loop, as ``Request`` bits."""

BELIEVED, OUT_OF_REACH, JUMP = 0, 1, 2
"""Results of ``believe``."""


@compiled
def believe(
    motions: NDArray[np.void], replies: NDArray[np.void], samples: NDArray[np.void], elapsed: float
) -> int:
    """Converts a reply into a sample in the device's frame, if it is plausible.

    Args:
        motions: Shape (1,), ``MOTION_DTYPE``; updated only by a plausible reply.
        replies: Shape (1,), ``REPLY_DTYPE``.
        samples: Output, shape (1,), ``SAMPLE_DTYPE``; updated only by a plausible reply.
        elapsed: Longest possible time in s since the pose of the previous reply; inf accepts any
            position within reach.

    Returns:
        ``BELIEVED``, ``OUT_OF_REACH`` or ``JUMP``.
    """
    motion, reply, sample = motions[0], replies[0], samples[0]
    angles, position = np.empty(3), motion.position.copy()
    for i in range(3):
        if abs(reply.encoders[i]) > MAX_COUNTS:
            return OUT_OF_REACH
        angles[i] = ZERO_ANGLE + reply.encoders[i] * RADIANS_PER_COUNT
    if not forward(angles, position):
        return OUT_OF_REACH
    moved = position - motion.position
    distance = math.sqrt(moved[0] ** 2 + moved[1] ** 2 + moved[2] ** 2)
    if not distance <= SPEED_LIMIT * elapsed:
        return JUMP
    for i in range(3):
        motion.position[i], motion.angles[i] = position[i], angles[i]
    sample.position[0] = position[0] - PLACE[0]
    sample.position[1] = PLACE[2] - position[2]
    sample.position[2] = position[1] - PLACE[1]
    sample.quaternion[0] = 1.0
    for i in range(1, 4):
        sample.quaternion[i] = 0.0
    sample.buttons = reply.buttons
    return BELIEVED


@compiled
def command(
    motions: NDArray[np.void], wrench: NDArray[np.float64], packet: NDArray[np.uint8]
) -> None:
    """Encodes the packet that applies a force at the last plausible grip position.

    If a motor would exceed its limit, all three are scaled down together, which keeps the direction
    of the force.

    Args:
        motions: Shape (1,), ``MOTION_DTYPE``; its motor units are set.
        wrench: Shape (6,) in the device's frame, in N and N m. Only the force is used; a non-finite
            force becomes zero.
        packet: Output, shape (16,).
    """
    motion = motions[0]
    force, torques = np.empty(3), np.empty(3)
    force[0], force[1], force[2] = wrench[0], wrench[2], -wrench[1]
    thigh_torques(motion.position, motion.angles, force, torques)
    most = 0.0
    for i in range(3):
        if not math.isfinite(torques[i]):
            torques[:] = 0.0
        most = max(most, abs(UNITS_PER_TORQUE * torques[i]))
    share = min(1.0, MOTOR_LIMIT / max(most, MOTOR_LIMIT))
    for i in range(3):
        motion.motors[i] = round(share * UNITS_PER_TORQUE * torques[i])
    encode(motion.motors, FLAGS, packet)


def resolution() -> float:
    """Returns the largest displacement in m of one encoder step, in the middle of the workspace.

    The middle is on the axis, so all thighs have the angle, with the knee outside,

        θ = atan2(w, u + c) − arccos((ρ² + a² − L²) / (2 a ρ)),    ρ² = (u + c)² + w²
    """
    position = np.array(PLACE)
    out, height = PLATE - HIP_OUT, position[2]
    length = math.sqrt(SHIN**2 - (SIDEWAYS - HIP_SIDEWAYS) ** 2) + LINKS
    distance = math.hypot(out, height)
    cosine = (distance**2 + THIGH**2 - length**2) / (2.0 * THIGH * distance)
    angles = np.full(3, math.atan2(height, out) - math.acos(cosine))
    gaps, gradients, levers = np.empty(3), np.empty((3, 3)), np.empty(3)
    closure(position, angles, gaps, gradients, levers)
    ways = np.linalg.inv(gradients) * levers * RADIANS_PER_COUNT  # ∂p/∂θ = −(∂h/∂p)⁻¹ ∂h/∂θ
    return float(np.linalg.norm(ways, 2))
