"""Point mass and rotation: energy, momentum and accuracy of each rule."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from closed_forms import swing_from_rest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from hapticbridge.coupling import Coupling
from hapticbridge.errors import MechanicsError
from hapticbridge.theory.rigid_body import (
    CoupledStepRule,
    StepRule,
    drive_mass,
    exact_mass_response,
    integrate_particle,
    integrate_rotation,
)

T = 1e-3
COUPLING = Coupling(1000, 5, 0, 0)
ALL: tuple[StepRule, ...] = ("explicit", "semi_implicit", "implicit", "midpoint")
seeds = st.integers(0, 2**32 - 1)


def random_force(seed: int, *shape: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(0, 3, shape)


def size(*terms: NDArray[np.float64]) -> float:
    """Largest energy in a balance, times what rounding may leave of it."""
    return 1e-12 * max(float(np.abs(term).max()) for term in terms)


@given(seeds, st.floats(0.01, 10), st.floats(1e-4, 1e-2), st.floats(-1, 1))
def test_energy_gain_is_closed(seed: int, mass: float, period: float, velocity: float) -> None:
    force = random_force(seed, 50)
    for rule in ALL:
        motion = integrate_particle(mass, force, period, rule, velocity=velocity)
        v, gain, kinetic = motion.velocity, motion.energy_gain, motion.kinetic_energy
        rounding = size(kinetic, force * period * np.abs(v).max())
        if rule == "implicit":
            expected = -0.5 * mass * np.diff(v) ** 2
            by_force = -(period**2) * force[1:] ** 2 / (2 * mass)
            assert gain == pytest.approx(by_force, rel=1e-9, abs=rounding)
        elif rule == "midpoint":
            expected = np.zeros(49)
        elif rule == "explicit":
            gain = gain[:-1]  # the last sample's v_{k+1} is not computed
            expected = 0.5 * mass * (v[1:-1] + v[:-2]) ** 2 - mass * v[:-2] * (v[:-2] + v[2:])
        else:
            gain = np.diff(kinetic)[1:] - force[1:-1] * np.diff(motion.position)[:-1]
            expected = 0.5 * mass * np.diff(v)[1:] ** 2
        assert gain == pytest.approx(expected, rel=1e-9, abs=rounding)


@pytest.mark.parametrize("rule", ALL)
def test_map_of_every_rule_is_the_recursion_it_documents(rule: StepRule) -> None:
    force, mass = random_force(1, 20), 0.3
    motion = integrate_particle(mass, force, T, rule, velocity=-0.1)
    x, v = 0.0, -0.1
    for k in range(1, 20):
        old = v
        v += T / mass * force[k if rule in {"implicit", "midpoint"} else k - 1]
        x += T * {"explicit": old, "midpoint": (old + v) / 2}.get(rule, v)
        assert motion.velocity[k] == pytest.approx(v, rel=1e-12)
        assert motion.position[k] == pytest.approx(x, rel=1e-12)


def test_many_masses_move_at_once_as_they_move_alone() -> None:
    mass, force = np.array([[0.1], [0.2]]), random_force(2, 30, 3)[:, None, :]
    together = integrate_particle(mass, force, T, "midpoint")
    assert together.position.shape == (30, 2, 3)
    alone = integrate_particle(0.2, force[:, 0, 1], T, "midpoint")
    assert together.position[:, 1, 1] == pytest.approx(alone.position, rel=1e-12)
    handle = force[:, 0, :]
    driven = drive_mass(COUPLING, mass, handle, T, "midpoint")
    single = drive_mass(COUPLING, 0.2, handle[:, 1], T, "midpoint")
    assert driven.position[:, 1, 1] == pytest.approx(single.position, rel=1e-12)


def steady_response(rule: CoupledStepRule, mass: float, period: float, hertz: float) -> complex:
    """X/H of a rule from its transfer function, without any recursion."""
    d = 1 - np.exp(-2j * np.pi * hertz * period)  # 1 − z⁻¹
    k, b = COUPLING.stiffness, COUPLING.damping
    inertial = mass * d**2 / period**2
    if rule == "compensated":
        b = max(b - k * period, 0)
    force = k + b / period * d
    if rule == "held":
        inertial /= 1 - d
    if rule == "midpoint":
        inertial *= 2 / (2 - d)
        force -= k * d / 2
    return complex(force / (force + inertial))


ERRORS: dict[CoupledStepRule, tuple[float, ...]] = {
    "held": (0.54, 0.25, 0.12, 0.060, 0.030),
    "implicit": (3.9, 2.4, 1.33, 0.71, 0.37),
    "compensated": (0.41, 0.22, 0.114, 0.058, 0.029),
    "midpoint": (0.127, 0.032, 0.0079, 0.0020, 0.0005),
}
"""RMS error over the amplitude in % at T = 4, 2, 1, 0.5, 0.25 ms, by an independent program."""


@pytest.mark.parametrize("rule", ERRORS)
def test_driven_mass_follows_the_transfer_function_of_its_rule(rule: CoupledStepRule) -> None:
    mass, hertz = 1.0, 2.0
    time = np.arange(8001) * T
    motion = drive_mass(COUPLING, mass, np.sin(2 * np.pi * hertz * time), T, rule)
    response = steady_response(rule, mass, T, hertz)
    expected = np.imag(response * np.exp(2j * np.pi * hertz * time))
    # the transient decays with B/2m = 2.5 per second
    assert motion.position[-500:] == pytest.approx(expected[-500:], abs=1e-6)


@pytest.mark.parametrize("rule", ERRORS)
def test_accuracy_behind_the_coupling_is_as_the_theory_prints(rule: CoupledStepRule) -> None:
    """From rest, 2 s of a 2 Hz sine of amplitude 1, against the closed form with its transient."""
    for period, percent in zip((4e-3, 2e-3, 1e-3, 5e-4, 2.5e-4), ERRORS[rule], strict=True):
        time = np.arange(round(2 / period) + 1) * period
        motion = drive_mass(COUPLING, 1.0, np.sin(4 * np.pi * time), period, rule)
        exact = swing_from_rest(time, COUPLING, 1.0)
        error = 100 * np.sqrt(np.mean((motion.position - exact) ** 2))
        # printed to one or two digits: half a unit of the last one
        assert error == pytest.approx(percent, abs=0.5 * last_digit(percent) + 1e-3 * percent)


def last_digit(value: float) -> float:
    return float(10.0 ** -len(repr(value).partition(".")[2]))


@given(seeds, st.floats(1e-3, 10), st.floats(1, 1e5), st.floats(0, 100))
def test_only_held_forces_create(seed: int, mass: float, stiffness: float, damping: float) -> None:
    handle = np.cumsum(random_force(seed, 100) * 1e-4)
    coupling = Coupling(stiffness, damping, 0, 0)
    for rule in ("implicit", "compensated", "midpoint"):
        motion = drive_mass(coupling, mass, handle, T, rule)
        work = motion.force[1:] * np.diff(motion.position)
        rounding = size(mass * motion.velocity**2, work) + 1e-15
        gain = motion.energy_gain
        if rule == "midpoint":
            assert np.abs(gain).max() <= rounding
        else:
            lost = -0.5 * mass * np.diff(motion.velocity) ** 2
            assert gain == pytest.approx(lost, rel=1e-9, abs=rounding)


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


@pytest.mark.parametrize(("rule", "order"), [("midpoint", 2), *((s, 1) for s in ALL[:3])])
def test_error_against_dop853_falls_with_order_of_rule(rule: StepRule, order: int) -> None:
    omega = np.array([3.0, 8.0, -4.0])
    expected_rate, expected_turn = reference(INERTIA, omega, 1.0)
    errors = []
    for steps in (4000, 8000):
        motion = integrate_rotation(INERTIA, omega, 1 / steps, steps, rule)
        turn = matrix(motion.orientation[-1])
        rate_error = np.linalg.norm(motion.angular_velocity[-1] - expected_rate)
        errors.append((rate_error, np.linalg.norm(turn - expected_turn)))
    falls = np.log2(np.divide(errors[0], errors[1]))
    assert falls == pytest.approx([order, order], abs=0.15)


@settings(max_examples=40)
@given(
    st.tuples(*[st.floats(1e-4, 1)] * 3).filter(lambda i: 2 * max(i) <= sum(i)),
    st.tuples(*[st.floats(-20, 20)] * 3),
)
def test_rotation_gains_what_its_rule_documents(
    inertia: tuple[float, ...], omega: tuple[float, ...]
) -> None:
    for rule in ALL:
        motion = integrate_rotation(inertia, omega, T, 20, rule)
        change = np.diff(motion.angular_velocity, axis=0)
        sign = {"implicit": -1, "midpoint": 0}.get(rule, 1)
        gain, energy = np.diff(motion.kinetic_energy), motion.kinetic_energy.max()
        expected = 0.5 * sign * change**2 @ motion.inertia
        assert gain == pytest.approx(expected, rel=1e-9, abs=1e-12 * energy)


ONES = np.ones(5)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: integrate_particle(0, ONES, T, "explicit"), "mass is 0 kg; it must be"),
        (lambda: integrate_particle(np.nan, ONES, T, "explicit"), "mass is nan kg; it must"),
        (lambda: integrate_particle(1, ONES, -1, "explicit"), "period is -1 s"),
        (lambda: integrate_particle(1, [1.0], T, "explicit"), r"force has shape \(1,\)"),
        (lambda: integrate_particle(1, ["a"], T, "explicit"), "must be numbers in N"),
        (lambda: integrate_particle([1, 2], np.ones((5, 3)), T, "explicit"), "do not broadcast"),
        (lambda: integrate_particle(1, ONES, [T], "explicit"), r"period has shape \(1,\)"),  # type: ignore[arg-type]
        (lambda: drive_mass(COUPLING, 1, [0, np.inf], T, "midpoint"), "handle position is inf m"),
        (lambda: drive_mass(COUPLING, 1, 0.0, T, "midpoint"), "handle has shape"),
        (lambda: drive_mass(COUPLING, 1, ONES, T, "explicit"), "choose one of 'compensated'"),  # type: ignore[arg-type]
        (lambda: exact_mass_response(COUPLING, 1, 0), "frequency is 0 Hz"),
        (lambda: integrate_rotation([1, 1, -1], SPIN, T, 1, "implicit"), "inertia is -1 kg m²"),
        (lambda: integrate_rotation([1, 1, 3], SPIN, T, 1, "implicit"), "which no rigid body has"),
        (lambda: integrate_rotation(INERTIA, [1, 2], T, 1, "implicit"), r"has shape \(2,\)"),
        (lambda: integrate_rotation(1.0, SPIN, T, 1, "implicit"), r"inertia has shape \(\)"),
        (lambda: integrate_rotation(INERTIA, [1, 2, np.nan], T, 1, "implicit"), "velocity is nan"),
        (lambda: integrate_rotation(INERTIA, SPIN, T, 0, "implicit"), "steps is 0"),
        (lambda: integrate_rotation(INERTIA, SPIN, T, 5, "rk4"), "choose one of 'explicit'"),  # type: ignore[arg-type]
        (lambda: integrate_rotation(INERTIA, [100, 1000, 100], 1.0, 500, "explicit"),
         "shorten the period"),
    ],
)  # fmt: skip
def test_what_cannot_be_integrated_is_refused(call: Callable[[], Any], words: str) -> None:
    with pytest.raises(MechanicsError, match=words):
        call()
