"""What a tick does with a Falcon's packets: encoders to a pose to believe, force to motors."""

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
"""What is carried from tick to tick: the grip in the maker's frame in m, its thigh angles in rad,
and the motor units of the last command."""

PLACE = (0.0, 0.0, 0.125)
"""Middle of the workspace in the maker's frame, in m: half way between 0.075 and 0.175 from the
base. The device's frame begins there."""

UNITS_PER_TORQUE = -1e4
"""Motor units per N m at the thigh, of libnifalcon: its sign, and its scale, which nobody published
a calibration of."""

MOTOR_LIMIT = 4096.0
"""Motor units that a motor is sent at most. 9 N along the axis take 2259 on each, 9 N across it
5200 on one; libnifalcon's users clamp at about as much."""

FORCE_LIMIT = 8.0
"""In N: what CHAI3D lets applications ask of a Falcon; the maker's figure is above 8.9 N."""

SPEED_LIMIT = 3.0
"""In m/s: faster motion is not believed. No figure was found; a hand that crosses the 0.1 m of the
workspace in 33 ms is at its end."""

MOST_COUNTS = 3000
"""Counts either side of zero that a thigh can turn to: -74° to 144°. The workspace takes -66° to
114°; a whole turn further the same place would follow."""

FLAGS = int(Request.GREEN)
"""The light while the loop runs."""

BELIEVED, OUT_OF_REACH, JUMP = 0, 1, 2
"""What ``believe`` makes of a reply."""


@compiled
def believe(
    motions: NDArray[np.void],
    replies: NDArray[np.void],
    samples: NDArray[np.void],
    elapsed: float,
) -> int:
    """Turns a reply into a sample in the device's frame, if the grip can be there.

    Args:
        motions: Shape (1,), ``MOTION_DTYPE``; moved on only where the reply is believed.
        replies: Shape (1,), ``REPLY_DTYPE``.
        samples: Shape (1,), ``SAMPLE_DTYPE``, filled in place likewise.
        elapsed: Longest time in s that can lie between this pose and the one of the reply before;
            inf believes any place within reach.

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
    """Writes the packet that pushes the grip with a force, where it was last believed to be.

    Where a motor would be asked for more than its limit, all three are scaled down together: the
    force becomes smaller and keeps its direction.

    Args:
        motions: Shape (1,), ``MOTION_DTYPE``; its motor units are set.
        wrench: Shape (6,) in the device's frame; the force counts, in N. Not finite is no force.
        packet: Shape (16,), filled in place.
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
    """Returns the longest way in m that one encoder step can be, in the middle of the workspace."""
    position, angles, matrix = np.array(PLACE), np.empty(3), np.empty((3, 3))
    inverse(position, angles)
    jacobian(position, angles, matrix)
    ways = np.linalg.inv(matrix) * RADIANS_PER_COUNT
    return float(np.linalg.norm(ways, 2))
