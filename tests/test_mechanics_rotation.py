"""Rotation of a rigid body: what each scheme does to energy and momentum."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from hapticbridge.errors import MechanicsError
from hapticbridge.theory.rigid_body import Scheme, integrate_rotation

ALL: tuple[Scheme, ...] = ("explicit", "semi_implicit", "implicit", "midpoint")
INERTIA = np.array([1.5e-3, 3.63e-3, 4.53e-3])
SPIN = np.array([1e-3, 10.0, 1e-3])


def reference(
    inertia: NDArray[np.float64], omega: NDArray[np.float64], end: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """ω and the rotation matrix at the end of free rotation, by DOP853 on Euler's equations."""

    def rate(_: float, y: NDArray[np.float64]) -> NDArray[np.float64]:
        w, r = y[:3], y[3:].reshape(3, 3)
        hat = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([-np.cross(w, inertia * w) / inertia, (r @ hat).ravel()])

    start = np.concatenate([omega, np.eye(3).ravel()])
    found = solve_ivp(rate, (0, end), start, method="DOP853", rtol=1e-12, atol=1e-12)
    return found.y[:3, -1], found.y[3:, -1].reshape(3, 3)


def matrix(q: NDArray[np.float64]) -> NDArray[np.float64]:
    w, u = q[0], q[1:]
    hat = np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])
    return np.asarray(np.eye(3) + 2 * w * hat + 2 * hat @ hat)


def test_midpoint_keeps_energy_and_momentum_over_ten_seconds_of_tumbling() -> None:
    motion = integrate_rotation(INERTIA, SPIN, 1e-3, 10_000, "midpoint")
    energy, momentum = motion.kinetic_energy, motion.angular_momentum
    assert np.abs(motion.angular_velocity[:, 1]).min() < 1  # it did tumble
    assert energy == pytest.approx(np.full(10_001, energy[0]), rel=1e-9)
    drift = np.linalg.norm(momentum - momentum[0], axis=1).max()
    assert drift <= 1e-9 * np.linalg.norm(momentum[0])


def test_explicit_schemes_gain_energy_and_implicit_loses_it() -> None:
    motions = {s: integrate_rotation(INERTIA, SPIN, 1e-3, 10_000, s) for s in ALL}
    energy = {s: m.kinetic_energy for s, m in motions.items()}
    for scheme in ("explicit", "semi_implicit"):
        assert np.all(np.diff(energy[scheme]) >= -1e-15)
        assert energy[scheme][-1] > 1.001 * energy[scheme][0]
    assert np.all(np.diff(energy["implicit"]) <= 1e-15)
    assert energy["implicit"][-1] < 0.999 * energy["implicit"][0]


@pytest.mark.parametrize(("scheme", "order"), [("midpoint", 2), *((s, 1) for s in ALL[:3])])
def test_error_against_dop853_falls_with_the_order_of_the_scheme(
    scheme: Scheme, order: int
) -> None:
    omega = np.array([3.0, 8.0, -4.0])
    expected_rate, expected_turn = reference(INERTIA, omega, 1.0)
    errors = []
    for steps in (4000, 8000):
        motion = integrate_rotation(INERTIA, omega, 1 / steps, steps, scheme)
        turn = matrix(motion.orientation[-1])
        rate_error = np.linalg.norm(motion.angular_velocity[-1] - expected_rate)
        errors.append((rate_error, np.linalg.norm(turn - expected_turn)))
    falls = np.log2(np.divide(errors[0], errors[1]))
    assert falls == pytest.approx([order, order], abs=0.15)


@settings(max_examples=40)
@given(
    st.tuples(*[st.floats(1e-4, 1)] * 3).filter(lambda i: 2 * max(i) <= sum(i)),
    st.tuples(*[st.floats(-20, 20)] * 3),
    st.integers(0, 2**32 - 1),
)
def test_energy_balance_of_every_scheme_under_torque_is_its_closed_form(
    inertia: tuple[float, ...], omega: tuple[float, ...], seed: int
) -> None:
    period, steps = 1e-3, 20
    torque = np.random.default_rng(seed).normal(0, 5, (steps + 1, 3)) * min(inertia)
    for scheme in ALL:
        motion = integrate_rotation(inertia, omega, period, steps, scheme, torque=torque)
        w = motion.angular_velocity
        acting = torque[1:] if scheme in {"implicit", "midpoint"} else torque[:-1]
        mover = {"explicit": w[:-1], "semi_implicit": w[:-1], "implicit": w[1:]}
        work = period * np.sum(acting * mover.get(scheme, (w[1:] + w[:-1]) / 2), axis=1)
        second_order = 0.5 * np.sum(motion.inertia * np.diff(w, axis=0) ** 2, axis=1)
        sign = {"implicit": -1, "midpoint": 0}.get(scheme, 1)
        gain = np.diff(motion.kinetic_energy) - work
        rounding = 1e-12 * (motion.kinetic_energy.max() + np.abs(work).max())
        assert gain == pytest.approx(sign * second_order, rel=1e-9, abs=rounding)


@settings(max_examples=40)
@given(st.tuples(*[st.floats(-30, 30)] * 3))
def test_midpoint_keeps_the_momentum_in_the_world_whatever_the_spin(omega: tuple[float]) -> None:
    momentum = integrate_rotation(INERTIA, omega, 1e-3, 100, "midpoint").angular_momentum
    scale = np.linalg.norm(momentum[0]) + 1e-300
    assert np.linalg.norm(momentum - momentum[0], axis=1).max() <= 1e-12 * scale + 1e-300


def test_torque_about_a_principal_axis_spins_up_at_a_constant_rate() -> None:
    torque = np.tile([0, 0, 2e-3], (1001, 1))
    for scheme in ALL:
        motion = integrate_rotation(INERTIA, [0, 0, 1], 1e-3, 1000, scheme, torque=torque)
        assert motion.angular_velocity[-1, 2] == pytest.approx(1 + 2e-3 / INERTIA[2], rel=1e-12)
        angle = 2 * np.arctan2(motion.orientation[-1, 3], motion.orientation[-1, 0])
        # first-order schemes are off by half a step of the change in rate: T/2 · 0.44 rad/s
        exact = 1 + 1e-3 / INERTIA[2]
        assert angle == pytest.approx(exact, abs=1e-6 if scheme == "midpoint" else 3e-4)


def test_many_bodies_turn_at_once_as_they_turn_alone() -> None:
    omegas = np.array([[1.0, 2, 3], [4, 5, 6]])
    motion = integrate_rotation(INERTIA, omegas, 1e-3, 50, "implicit")
    alone = integrate_rotation(INERTIA, omegas[1], 1e-3, 50, "implicit")
    assert motion.angular_velocity.shape == (51, 2, 3)
    assert motion.orientation.shape == (51, 2, 4)
    assert motion.angular_momentum.shape == (51, 2, 3)
    assert np.array_equal(motion.orientation[:, 1], alone.orientation)


def test_what_cannot_be_turned_is_refused_in_a_sentence() -> None:
    with pytest.raises(MechanicsError, match="inertia is -1 kg m²"):
        integrate_rotation([1, 1, -1], SPIN, 1e-3, 1, "implicit")
    with pytest.raises(MechanicsError, match="which no rigid body has"):
        integrate_rotation([1, 1, 3], SPIN, 1e-3, 1, "implicit")
    with pytest.raises(MechanicsError, match=r"angular velocity has shape \(2,\)"):
        integrate_rotation(INERTIA, [1, 2], 1e-3, 1, "implicit")
    with pytest.raises(MechanicsError, match=r"inertia has shape \(\)"):
        integrate_rotation(1.0, SPIN, 1e-3, 1, "implicit")
    with pytest.raises(MechanicsError, match="angular velocity is nan"):
        integrate_rotation(INERTIA, [1, 2, np.nan], 1e-3, 1, "implicit")
    with pytest.raises(MechanicsError, match="steps is 0"):
        integrate_rotation(INERTIA, SPIN, 1e-3, 0, "implicit")
    with pytest.raises(MechanicsError, match=r"torque has shape \(4, 3\); it must be \(6"):
        integrate_rotation(INERTIA, SPIN, 1e-3, 5, "implicit", torque=np.zeros((4, 3)))
    with pytest.raises(MechanicsError, match="choose one of 'explicit'"):
        integrate_rotation(INERTIA, SPIN, 1e-3, 5, "rk4")  # type: ignore[arg-type]
    with pytest.raises(MechanicsError, match="shorten the period"):
        integrate_rotation(INERTIA, [100, 1000, 100], 1.0, 500, "explicit")
