"""Rotation matrices of makers' libraries as quaternions."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from hapticbridge.errors import DeviceError
from hapticbridge.pose import Quaternion, canonical

ROTATION_ERROR = 1e-3
"""Largest deviation of R Rᵀ from the identity, without unit. A larger one is not due to
rounding."""


def quaternion_of(frame: Sequence[float], name: str) -> Quaternion:
    """Returns the unit quaternion (w, x, y, z) of a rotation matrix.

    Args:
        frame: Nine numbers, row by row.
        name: Name of the device in messages.

    Raises:
        DeviceError: The matrix is not a rotation, or a number in it is not finite.
    """
    flat = np.array(frame)
    matrix = flat.reshape(3, 3)
    is_finite = bool(np.isfinite(matrix).all())
    if not is_finite or not (
        np.abs(matrix @ matrix.T - np.eye(3)).max() < ROTATION_ERROR and np.linalg.det(matrix) > 0
    ):
        raise DeviceError(
            f"{name} reports an orientation that is not a rotation; check its cable and restart it"
        )
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, flat)
    w, x, y, z = (quaternion / np.linalg.norm(quaternion)).tolist()
    return canonical((w, x, y, z))
