"""Steps, turns and sums over whole arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def quaternion_product(a: Array, b: Array) -> Array:
    """Returns a ⊗ b over arrays (…, 4), scalar first."""
    scalar = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def conjugate(q: Array) -> Array:
    """Returns the inverse of unit quaternions (…, 4)."""
    return np.asarray(q * np.array([1.0, -1.0, -1.0, -1.0]))


def turn_between(a: Array, b: Array) -> Array:
    """Returns the rotation vectors (…, 3) in the world frame from a to b, in rad."""
    q = quaternion_product(b, conjugate(a))
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.where(sine > 0, angle / sine, 2.0)
    return np.asarray(factor * q[..., 1:])


def steps(values: Array, before: Array) -> Array:
    """Returns v_k − v_{k−1} over rows, with v_{−1} = before."""
    return np.diff(values, axis=0, prepend=before[None])


def turns(values: Array, before: Array) -> Array:
    """Returns the rotation vector from each orientation's predecessor to it."""
    return turn_between(np.concatenate([before[None], values[:-1]]), values)


def summed(values: Array, before: float) -> Array:
    """Returns cumulative sums that start from an earlier sum.

    Values are added one by one, so that sums over blocks equal those over the whole to the bit.
    """
    return np.cumsum(np.concatenate([[before], values]))[1:]


def rotate(q: Array, v: Array) -> Array:
    """Returns R(q) v over rows, q (n, 4) and v (n, 3)."""
    pure = np.concatenate([np.zeros((len(v), 1)), v], axis=1)
    return quaternion_product(quaternion_product(q, pure), conjugate(q))[:, 1:]
