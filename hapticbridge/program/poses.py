"""Poses of a program, as NumPy alone computes with them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.errors import HapticBridgeError

Array = NDArray[np.float64]

ROUNDED = 1e-3
"""Largest error of a rotation matrix, as of one in single precision that was multiplied often."""


def numbers_of(name: str, values: ArrayLike) -> Array:
    """Returns values as an array of any shape.

    Raises:
        HapticBridgeError: One is no number, not finite, or beyond 1e9; the message has the name.
    """
    try:
        numbers = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise HapticBridgeError(f"{name} is {values!r}; it must be numbers") from None
    if not np.all(np.abs(numbers) < 1e9):
        raise HapticBridgeError(f"{name} is {values!r}; it must be finite, and below 1e9 in size")
    return numbers


def pose_of(pose: ArrayLike, orientation: Array) -> Array:
    """Returns a pose as (x, y, z, qw, qx, qy, qz), with a quaternion of norm 1.

    Args:
        pose: The same, a position alone, which gets the orientation, or a 4 × 4 matrix.
        orientation: Quaternion for a position alone.

    Raises:
        HapticBridgeError: It is none of these.
    """
    numbers = numbers_of("pose", pose)
    if numbers.shape == (4, 4):
        if not np.allclose(numbers[3], (0.0, 0.0, 0.0, 1.0), atol=ROUNDED):
            raise HapticBridgeError(
                f"the last row of the pose's matrix is {numbers[3].tolist()}; it must be 0 0 0 1, "
                "with the position in the last column"
            )
        turn = numbers[:3, :3]
        if not np.allclose(turn @ turn.T, np.eye(3), atol=ROUNDED) or np.linalg.det(turn) < 0.0:
            raise HapticBridgeError(
                f"the pose's matrix {turn.tolist()} is no rotation: its rows must be of length 1, "
                "at right angles, and right-handed"
            )
        result = np.append(numbers[:3, 3], quaternion_of(numbers[:3, :3]))
    elif numbers.shape == (3,):
        result = np.append(numbers, orientation)
    elif numbers.shape == (7,):
        result = numbers.copy()
    else:
        raise HapticBridgeError(
            f"pose has shape {numbers.shape}; it must be (x, y, z, qw, qx, qy, qz), (x, y, z), or "
            "a 4 × 4 matrix"
        )
    norm = float(np.linalg.norm(result[3:]))
    if not 0.9 < norm < 1.1:
        raise HapticBridgeError(
            f"the pose's quaternion {result[3:].tolist()} has norm {norm:.3g}; it must be 1, in "
            "the order (w, x, y, z)"
        )
    result[3:] /= norm
    return result


def matrix_of(q: Array) -> Array:
    """Returns the rotation matrix of a quaternion (w, x, y, z) of norm 1, (3, 3)."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(matrix: Array) -> Array:
    """Returns the quaternion of a rotation matrix, by its largest component."""
    m = matrix
    squares = np.array(
        [
            1 + m[0, 0] + m[1, 1] + m[2, 2],
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    rows = np.array(
        [
            [squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], squares[1], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], squares[2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], squares[3]],
        ]
    )
    q = rows[int(np.argmax(squares))]
    return np.asarray(q / np.linalg.norm(q) * (1.0 if q[0] >= 0 else -1.0))


def quaternion_about(vector: Array) -> Array:
    """Returns the quaternion of a rotation vector in rad."""
    half = 0.5 * float(np.linalg.norm(vector))
    return np.append(np.cos(half), 0.5 * np.sinc(half / np.pi) * vector)


def turn_between(first: Array, second: Array) -> Array:
    """Returns the rotation vector in rad from one quaternion to another, in the world frame."""
    v, u = second[1:], first[1:]
    vector = first[0] * v - second[0] * u - np.cross(v, u)
    real, size = float(first @ second), float(np.linalg.norm(vector))
    sign = -1.0 if real < 0.0 else 1.0
    angle_ratio = 2.0 if size < 1e-9 else 2.0 * np.arctan2(size, sign * real) / size
    return np.asarray(sign * angle_ratio * vector)


def offset_between(first: Array, second: Array) -> Array:
    """Returns what leads from one pose (x, y, z, qw, qx, qy, qz) to another.

    Translation in m and rotation vector in rad, (6,), in the world frame.
    """
    return np.append(second[:3] - first[:3], turn_between(first[3:], second[3:]))
