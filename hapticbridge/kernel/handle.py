"""Where a device's pose puts the handle, and how tuples and arrays become each other."""

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
    scaled,
    subtract,
)


@compiled
def vector_of(values: NDArray[np.float64]) -> Vector:
    """Returns the first three elements as a tuple."""
    return values[0], values[1], values[2]


@compiled
def quaternion_of(values: NDArray[np.float64]) -> Quaternion:
    """Returns the first four elements as a tuple."""
    return values[0], values[1], values[2], values[3]


@compiled
def store_vector(target: NDArray[np.float64], v: Vector) -> None:
    """Writes a tuple into the first three elements."""
    target[0], target[1], target[2] = v


@compiled
def store_quaternion(target: NDArray[np.float64], q: Quaternion) -> None:
    """Writes a tuple into the first four elements."""
    target[0], target[1], target[2], target[3] = q


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
    offset = subtract(position, (s.device_origin[0], s.device_origin[1], s.device_origin[2]))
    moved = scaled(s.scale, scene_from_device(s.axes, offset))
    origin = s.handle_origin
    start = (s.device_origin[3], s.device_origin[4], s.device_origin[5], s.device_origin[6])
    axes = quaternion_of(s.axes_quaternion)
    turn = product(product(axes, product(quaternion, conjugate(start))), conjugate(axes))
    turned = product(turn, (origin[3], origin[4], origin[5], origin[6]))
    return add((origin[0], origin[1], origin[2]), moved), canonical(turned)
