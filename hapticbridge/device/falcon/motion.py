"""Poses and forces of a Falcon from its packets."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.falcon.kinematics import (
    RADIANS_PER_COUNT,
    ZERO_ANGLE,
    forward,
    inverse,
)
from hapticbridge.device.falcon.packets import Request, encode
from hapticbridge.device.falcon.statics import jacobian, thigh_torques
from hapticbridge.jit import compiled

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

MOST_COUNTS = 3000
"""Largest encoder count of a thigh on either side of zero: -74° to 144°. The workspace takes -66°
to 114°. One more turn would lead to the same position again."""

FLAGS = int(Request.GREEN)
"""Light during the loop, as ``Request`` bits."""

BELIEVED, OUT_OF_REACH, JUMP = 0, 1, 2
"""Results of ``believe``."""


@compiled
def believe(
    motions: NDArray[np.void],
    replies: NDArray[np.void],
    samples: NDArray[np.void],
    elapsed: float,
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
        if abs(reply.encoders[i]) > MOST_COUNTS:
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
    """Returns the largest displacement in m of one encoder step, in the middle of the workspace."""
    position, angles, matrix = np.array(PLACE), np.empty(3), np.empty((3, 3))
    inverse(position, angles)
    jacobian(position, angles, matrix)
    ways = np.linalg.inv(matrix) * RADIANS_PER_COUNT
    return float(np.linalg.norm(ways, 2))
