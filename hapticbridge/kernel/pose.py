"""Rotations and poses as compiled functions on tuples of scalars.

Quaternions are (w, x, y, z); rotation vectors are axis times angle, in rad. The functions run
inside a tick and must not allocate, so they take tuples instead of arrays. MuJoCo's ``mju_``
functions are the independent check.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.jit import compiled

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]

ZERO_VECTOR: Vector = (0.0, 0.0, 0.0)
IDENTITY_POSE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""Identity pose: position in m and quaternion (w, x, y, z)."""


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
def add(a: Vector, b: Vector) -> Vector:
    """Returns a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled
def subtract(a: Vector, b: Vector) -> Vector:
    """Returns a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def scaled(factor: float, a: Vector) -> Vector:
    """Returns factor · a."""
    return factor * a[0], factor * a[1], factor * a[2]


@compiled
def dot(a: Vector, b: Vector) -> float:
    """Returns a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """Returns a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def norm(a: Vector) -> float:
    """Returns the Euclidean length of a."""
    return math.sqrt(dot(a, a))


@compiled
def conjugate(q: Quaternion) -> Quaternion:
    """Returns the inverse of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


@compiled
def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Returns a ⊗ b, the rotation that applies b first and then a."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@compiled
def canonical(q: Quaternion) -> Quaternion:
    """Returns the unit quaternion with w >= 0 of a rotation (q and −q are one rotation).

    The function is idempotent to the bit: a quaternion of unit length to 1e-12 is not scaled again.
    Otherwise a recorded quaternion would change in its last digit when read back.
    """
    square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    factor = 1.0 / math.sqrt(square) if abs(square - 1.0) > 1e-12 else 1.0
    if q[0] < 0.0:
        factor = -factor
    return factor * q[0], factor * q[1], factor * q[2], factor * q[3]


@compiled
def rotated(q: Quaternion, v: Vector) -> Vector:
    """Returns R(q) v."""
    u = (q[1], q[2], q[3])
    t = scaled(2.0, cross(u, v))
    return add(add(v, scaled(q[0], t)), cross(u, t))


@compiled
def quaternion_exp(v: Vector) -> Quaternion:
    """Returns the unit quaternion of the rotation vector v.

    exp(v) = (cos(θ/2), sin(θ/2) v/θ),   θ = |v| in rad
    """
    angle = norm(v)
    # below 1e-8 rad the second term of sin(θ/2)/θ = 1/2 − θ²/48 is below a double's rounding
    factor = math.sin(0.5 * angle) / angle if angle > 1e-8 else 0.5
    return math.cos(0.5 * angle), factor * v[0], factor * v[1], factor * v[2]


@compiled
def quaternion_log(q: Quaternion) -> Vector:
    """Returns the rotation vector of a unit quaternion, of length 0 to π rad.

    At π the axis is ambiguous and the vector's sign flips, so a spring's deflection must stay below
    π.
    """
    w, v = q[0], (q[1], q[2], q[3])
    if w < 0.0:
        w, v = -w, scaled(-1.0, v)
    sine = norm(v)
    factor = 2.0 * math.atan2(sine, w) / sine if sine > 1e-300 else 2.0
    return scaled(factor, v)


@compiled
def rotation_between(a: Quaternion, b: Quaternion) -> Vector:
    """Returns log(R(b) R(a)ᵀ), the rotation vector in the world frame from a to b."""
    return quaternion_log(product(b, conjugate(a)))
