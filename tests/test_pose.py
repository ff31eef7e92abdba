"""Rotations: MuJoCo's own functions and SciPy are the reference."""

from __future__ import annotations

import math
from typing import TypeAlias

import mujoco
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.kernel import pose

Array: TypeAlias = NDArray[np.float64]

# a handful of products of numbers <= 1, each rounded to 1.1e-16
ROUNDING = 4e-15

numbers = st.floats(-10, 10, allow_subnormal=False)
vectors = st.tuples(numbers, numbers, numbers)


def _unit(values: tuple[float, float, float, float]) -> pose.Quaternion:
    a = np.array(values)
    length = np.linalg.norm(a)
    a = a / length if length > 1e-3 else np.array([1.0, 0.0, 0.0, 0.0])
    return float(a[0]), float(a[1]), float(a[2]), float(a[3])


quaternions = st.builds(_unit, st.tuples(*[st.floats(-1, 1, allow_subnormal=False)] * 4))
directions = st.builds(
    lambda a, b: (math.cos(a) * math.cos(b), math.cos(a) * math.sin(b), math.sin(a)),
    st.floats(-math.pi / 2, math.pi / 2),
    st.floats(-math.pi, math.pi),
)
# tiny angles, where sin(x)/x needs care, and the neighbourhood of π, where the axis is nearly lost
angles = st.one_of(
    st.floats(0, math.pi - 1e-3),
    st.floats(-320, -3).map(lambda e: 10.0**e),
    st.floats(-12, -3).map(lambda e: math.pi - 10.0**e),
)


@given(vectors, vectors, numbers)
def test_vector_algebra_is_that_of_numpy(a: pose.Vector, b: pose.Vector, factor: float) -> None:
    x, y = np.array(a), np.array(b)
    assert pose.add(a, b) == tuple(x + y)
    assert pose.subtract(a, b) == tuple(x - y)
    assert pose.scaled(factor, a) == tuple(factor * x)
    # sums of three products of numbers up to 10: 100 times the rounding of 1
    assert pose.dot(a, b) == pytest.approx(float(x @ y), abs=100 * ROUNDING)
    assert pose.cross(a, b) == pytest.approx(np.cross(x, y), abs=100 * ROUNDING)
    assert pose.norm(a) == pytest.approx(float(np.linalg.norm(x)), rel=ROUNDING)


@given(quaternions, quaternions)
def test_product_and_conjugate_are_those_of_mujoco(a: pose.Quaternion, b: pose.Quaternion) -> None:
    expected = np.zeros(4)
    mujoco.mju_mulQuat(expected, np.array(a), np.array(b))
    assert pose.product(a, b) == pytest.approx(expected, abs=ROUNDING)
    mujoco.mju_negQuat(expected, np.array(a))
    assert pose.conjugate(a) == tuple(expected)


@given(quaternions, vectors)
def test_rotated_is_mujocos_rotation_of_a_vector(q: pose.Quaternion, v: pose.Vector) -> None:
    expected = np.zeros(3)
    mujoco.mju_rotVecQuat(expected, np.array(v), np.array(q))
    assert pose.rotated(q, v) == pytest.approx(expected, abs=100 * ROUNDING)


@given(directions, angles)
def test_exponential_is_mujocos_quaternion_of_axis_and_angle(
    axis: pose.Vector, angle: float
) -> None:
    expected = np.zeros(4)
    mujoco.mju_axisAngle2Quat(expected, np.array(axis), angle)
    assert pose.quaternion_exp(pose.scaled(angle, axis)) == pytest.approx(expected, abs=ROUNDING)


@given(quaternions)
@example((0.0, 1.0, 0.0, 0.0))
@example((-1.0, 0.0, 0.0, 0.0))
def test_logarithm_is_mujocos_velocity_over_one_second(q: pose.Quaternion) -> None:
    expected = np.zeros(3)
    mujoco.mju_quat2Vel(expected, np.array(q), 1.0)
    vector = np.array(pose.quaternion_log(q))
    if abs(q[0]) < 1e-15 and vector @ expected < 0:  # half a turn either way is the same rotation
        vector = -vector
    assert vector == pytest.approx(expected, abs=ROUNDING)
    assert pose.norm(pose.quaternion_log(q)) <= math.pi * (1 + ROUNDING)


@given(directions, angles)
@example((1.0, 0.0, 0.0), 0.0)
@example((1.0, 0.0, 0.0), 5e-324)
def test_logarithm_undoes_the_exponential(axis: pose.Vector, angle: float) -> None:
    vector = pose.scaled(angle, axis)
    again = pose.quaternion_log(pose.quaternion_exp(vector))
    # relative to the angle, so tiny ones keep their digits; the last subnormals have none to keep
    assert again == pytest.approx(vector, rel=1e-12, abs=max(1e-14 * angle, 1e-320))


@given(quaternions, quaternions)
def test_rotation_between_is_in_the_world_frame(a: pose.Quaternion, b: pose.Quaternion) -> None:
    vector = pose.rotation_between(a, b)
    start = Rotation.from_quat(a, scalar_first=True)
    end = Rotation.from_quat(b, scalar_first=True)
    # as a rotation, because near π the vector has two values; so the matrices are compared
    reached = (Rotation.from_rotvec(vector) * start).as_matrix()
    assert reached == pytest.approx(end.as_matrix(), abs=4 * ROUNDING)
    local = np.zeros(3)
    mujoco.mju_subQuat(local, np.array(b), np.array(a))  # the same vector in the frame of a
    if pose.norm(vector) < math.pi - 1e-6:
        assert vector == pytest.approx(start.apply(local), abs=4 * ROUNDING)


@given(quaternions, st.floats(0.5, 2))
def test_canonical_has_unit_length_scalar_not_negative_and_is_idempotent_to_the_bit(
    q: pose.Quaternion, length: float
) -> None:
    result = pose.canonical((length * q[0], length * q[1], length * q[2], length * q[3]))
    assert math.sqrt(sum(c * c for c in result)) == pytest.approx(1.0, abs=1e-12)
    assert result[0] >= 0.0
    assert pose.canonical(result) == result
    assert Rotation.from_quat(result, scalar_first=True).as_matrix() == pytest.approx(
        Rotation.from_quat(q, scalar_first=True).as_matrix(), abs=1e-11
    )
