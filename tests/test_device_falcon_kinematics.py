"""The Falcon's geometry against another writing of it, differences and published numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from emulated.falcon_model import leg_angles
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticbridge.device.falcon import kinematics

MIDDLE = np.array([0.0, 0.0, 0.125])

Array = NDArray[np.float64]


def places(count: int, radius: float = 0.04) -> Array:
    """Places within the workspace: a cylinder of this radius, 0.08 to 0.165 m from the base."""
    rng = np.random.default_rng(4)
    turn, way = rng.uniform(0, 2 * np.pi, count), radius * np.sqrt(rng.uniform(0, 1, count))
    height = rng.uniform(0.08, 0.165, count)
    return np.column_stack([way * np.cos(turn), way * np.sin(turn), height])


def angles_of(place: Array) -> Array:
    return np.array(leg_angles(*place))


def test_homed_encoders_at_zero_put_the_grip_where_it_was_published() -> None:
    place = MIDDLE.copy()
    assert kinematics.forward(np.full(3, kinematics.ZERO_ANGLE), place)
    np.testing.assert_allclose(place, [0, 0, 0.1346], atol=5e-5)
    assert pytest.approx(6.359e-4, rel=1e-4) == kinematics.RADIANS_PER_COUNT


def test_forward_undoes_the_inverse_all_over_the_workspace_and_from_afar() -> None:
    for place in places(2000):
        found = MIDDLE.copy()
        assert kinematics.forward(angles_of(place), found)
        np.testing.assert_allclose(found, place, rtol=0, atol=1e-12)


def test_the_shin_has_its_length_in_space() -> None:
    # joints placed one by one in the world: knee, then plate; what is left between them, less the
    # two links along the leg's plane, is the parallelogram's side
    for place in places(200):
        for angle, phi in zip(angles_of(place), kinematics.LEG_ANGLES, strict=True):
            out = np.array([math.cos(phi), math.sin(phi), 0.0])
            side = np.array([-math.sin(phi), math.cos(phi), 0.0])
            up = np.array([0.0, 0.0, 1.0])
            hip = 0.0400 * out - 0.02309 * side
            knee = hip + kinematics.THIGH * (math.cos(angle) * out + math.sin(angle) * up)
            plate = place + 0.01443 * out - 0.025 * side
            shin = plate - knee
            in_plane = shin - (shin @ side) * side
            shin = shin - 0.0225 * in_plane / np.linalg.norm(in_plane)
            assert np.linalg.norm(shin) == pytest.approx(kinematics.SHIN, abs=1e-15)


def test_the_resolution_is_the_largest_way_of_an_encoder_step() -> None:
    step = 1e-6
    ways = step * np.eye(3)
    slopes = [(angles_of(MIDDLE + w) - angles_of(MIDDLE - w)) / (2 * step) for w in ways]
    farthest = 1.0 / np.linalg.svd(np.array(slopes), compute_uv=False).min()
    expected = kinematics.RADIANS_PER_COUNT * farthest
    # central differences: truncation of order step², rounding of order 1e-16/step
    assert kinematics.resolution() == pytest.approx(expected, rel=1e-6)


def test_torques_do_the_work_of_the_force() -> None:
    rng = np.random.default_rng(5)
    for place in places(200):
        force, way = rng.normal(size=3), 1e-7 * rng.normal(size=3)
        torques = np.empty(3)
        assert kinematics.thigh_torques(place, angles_of(place), force, torques)
        turned = angles_of(place + way) - angles_of(place - way)
        assert torques @ turned == pytest.approx(2 * force @ way, rel=1e-5, abs=1e-13)


def test_nine_newton_along_the_axis_take_the_published_torque() -> None:
    place, torques = np.array([0.0, 0.0, 0.12]), np.empty(3)
    assert kinematics.thigh_torques(place, angles_of(place), np.array([0.0, 0.0, 9.0]), torques)
    np.testing.assert_allclose(torques, 0.226, atol=5e-4)


@given(st.tuples(*[st.floats(allow_nan=True, allow_infinity=True)] * 3))
def test_any_angles_give_a_place_within_reach_or_leave_it(angles: tuple[float, ...]) -> None:
    place = MIDDLE.copy()
    if kinematics.forward(np.array(angles), place):
        assert math.hypot(place[0], place[1]) <= kinematics.MAX_RADIUS
        assert kinematics.NEAREST <= place[2] <= kinematics.FARTHEST
    else:
        assert place.tolist() == MIDDLE.tolist()


def test_a_stretched_leg_has_neither_torque_nor_place() -> None:
    # on the axis the legs reach 0.178 m at full stretch: approached from below
    low, high = 0.15, 0.30
    for _ in range(60):
        middle = 0.5 * (low + high)
        try:
            angles = angles_of(np.array([0.0, 0.0, middle]))
        except ValueError:
            high = middle
        else:
            low = middle
    place = np.array([0.0, 0.0, low])
    torques = np.ones(3)
    found = place.copy()
    assert not kinematics.forward(angles, found)
    assert found.tolist() == place.tolist()
    far = np.array([0.0, 0.2, 0.12])
    assert not kinematics.thigh_torques(far, angles, np.ones(3), torques)
    assert torques.tolist() == [0.0, 0.0, 0.0]
