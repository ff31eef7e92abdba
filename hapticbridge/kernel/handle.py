"""Where a device's pose puts the handle, and vectors between the axes of device and scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.pose import (
    Quaternion,
    Vector,
    add,
    canonical,
    conjugate,
    product,
    quaternion_of,
    scaled,
    subtract,
    vector_of,
)


@compiled
def scene_from_device(axes: NDArray[np.float64], v: Vector) -> Vector:
    """Returns A v, A row by row."""
    return (
        axes[0] * v[0] + axes[1] * v[1] + axes[2] * v[2],
        axes[3] * v[0] + axes[4] * v[1] + axes[5] * v[2],
        axes[6] * v[0] + axes[7] * v[1] + axes[8] * v[2],
    )


@compiled
def device_from_scene(axes: NDArray[np.float64], v: Vector) -> Vector:
    """Returns Aᵀ v, A row by row."""
    return (
        axes[0] * v[0] + axes[3] * v[1] + axes[6] * v[2],
        axes[1] * v[0] + axes[4] * v[1] + axes[7] * v[2],
        axes[2] * v[0] + axes[5] * v[1] + axes[8] * v[2],
    )


@compiled
def handle_pose(
    state: NDArray[np.void], position: Vector, quaternion: Quaternion
) -> tuple[Vector, Quaternion]:
    """Maps a device pose into the scene.

        h = h_0 + scale · A (p − p_0),    R_h = A (R R_0ᵀ) Aᵀ R_h0

    A is the rotation from the device's axes to the scene's, subscript 0 the pose at the start.
    """
    s = state[0]
    offset = subtract(position, vector_of(s.device_origin))
    moved = scaled(s.scale, scene_from_device(s.axes, offset))
    origin = s.handle_origin
    start = quaternion_of(s.device_origin[3:7])
    axes = quaternion_of(s.axes_quaternion)
    turn = product(product(axes, product(quaternion, conjugate(start))), conjugate(axes))
    return add(vector_of(origin), moved), canonical(product(turn, quaternion_of(origin[3:7])))
