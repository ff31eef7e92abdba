"""Poses and rotations as NumPy arrays, by MuJoCo's functions."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
"""Identity quaternion (w, x, y, z)."""


def matrix_of(quaternion: ArrayLike) -> Array:
    """Returns the rotation matrix of a unit quaternion (w, x, y, z)."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, dtype=np.float64))
    return matrix.reshape(3, 3)


def quaternion_of(matrix: Array) -> Array:
    """Returns the unit quaternion (w, x, y, z) of a rotation matrix."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(matrix).ravel())
    return quaternion


def rotation_vector(start: ArrayLike, now: ArrayLike) -> Array:
    """Returns the rotation vector in rad from one orientation to another."""
    inverse, turn, vector = np.zeros(4), np.zeros(4), np.zeros(3)
    mujoco.mju_negQuat(inverse, np.asarray(start, dtype=np.float64))
    mujoco.mju_mulQuat(turn, np.asarray(now, dtype=np.float64), inverse)
    mujoco.mju_quat2Vel(vector, turn, 1.0)
    return vector


def pose_in(frame: Array, pose: Array) -> Array:
    """Returns a pose in the coordinates of a frame: position in m and quaternion, shape (7,).

    Both poses have shape (7,) and common coordinates.
    """
    position, turn, found = np.zeros(3), np.zeros(4), np.zeros(7)
    mujoco.mju_negPose(position, turn, frame[:3], frame[3:])
    mujoco.mju_mulPose(found[:3], found[3:], position, turn, pose[:3], pose[3:])
    return found
