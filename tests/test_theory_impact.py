"""Planar impact with friction: Routh's path, three laws of restitution, energy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticbridge.errors import MechanicsError
from hapticbridge.theory.impact import ImpactBody, Law, Mode, resolve_impact

Array = NDArray[np.float64]
LAWS: tuple[Law, ...] = ("newton", "poisson", "stronge")
ROD = ImpactBody(1, 1 / 12, np.array([-0.5, -0.5]) / np.sqrt(2))
TWO = ImpactBody([1, 2], 1, [0, 0])


class Cases(NamedTuple):
    body: ImpactBody
    velocity: Array
    friction: Array
    restitution: Array


def random_cases(n: int, seed: int) -> Cases:
    rng = np.random.default_rng(seed)
    velocity = np.stack([rng.uniform(-3, 3, n), -rng.uniform(1e-3, 3, n)], axis=-1)
    velocity[::100, 0] = 0  # hits without tangential velocity belong to the cases too
    friction = rng.uniform(0, 2, n)
    friction[::97] = 0
    restitution = rng.uniform(0, 1, n)
    mass, radius = rng.uniform(0.1, 10, n), rng.uniform(0.05, 1, n)
    body = ImpactBody(mass, mass * radius**2, rng.uniform(-1, 1, (n, 2)))
    return Cases(body, velocity, friction, restitution)


@pytest.mark.parametrize(
    ("law", "normal", "tangential", "energy", "tolerance"),
    [
        ("newton", 0.8875, 0.2125, 0.040625, 1e-12),
        ("poisson", 0.6175, 0.0505, -0.144055, 1e-12),
        # the irrational one: printed to six decimals, exact below
        ("stronge", 0.703360, 0.102016, -0.097975, 6e-7),
    ],
)
def test_rod_at_45_degrees(
    law: Law, normal: float, tangential: float, energy: float, tolerance: float
) -> None:
    impact = resolve_impact(ROD, [0.8, -1.0], 0.75, 0.9, law)
    assert impact.impulse == pytest.approx(np.array([tangential, normal]), abs=tolerance)
    assert float(impact.energy_change) == pytest.approx(energy, abs=tolerance)


def marched(cases: Cases, law: Law, steps: int = 10_000) -> Array:
    """P from Coulomb's law followed in small steps of P_n, knowing nothing of modes."""
    a, d, g = cases.body.compliance()
    v_t, v_n = cases.velocity[:, 0].copy(), cases.velocity[:, 1].copy()
    e, mu, start = cases.restitution, cases.friction, v_n.copy()
    p_t, p_n, p_c, work, taken = (np.zeros_like(v_n) for _ in range(5))
    active, compressing = np.ones(len(v_n), bool), np.ones(len(v_n), bool)
    dp = resolve_impact(*cases, law).impulse[:, 1] * 1.5 / steps
    for _ in range(steps):
        # the friction that would stop the slip within this step, bounded by Coulomb's cone
        dq = np.clip((g * dp - v_t) / a, -mu * dp, mu * dp) * active
        dn, before = dp * active, v_n.copy()
        v_t += a * dq - g * dn
        v_n += d * dn - g * dq
        p_t += dq
        p_n += dn
        work += 0.5 * (before + v_n) * dn
        ended = compressing & (v_n >= 0)
        p_c[ended], taken[ended] = p_n[ended], work[ended]
        compressing &= ~ended
        done = {
            "newton": v_n >= -e * start,
            "poisson": p_n >= (1 + e) * p_c,
            "stronge": work - taken >= -(e**2) * taken,
        }[law]
        active &= compressing | ~done
    assert not active.any()
    return np.stack([p_t, p_n], axis=-1)


@pytest.mark.parametrize("law", LAWS)
def test_impulse_is_that_of_coulombs_law_followed_in_small_steps(law: Law) -> None:
    cases = random_cases(500, 3)
    impact = resolve_impact(*cases, law)
    assert set(np.unique(impact.mode)) == set(Mode)
    size = np.linalg.norm(impact.impulse, axis=1, keepdims=True)
    # the end is met to a step, 1.5e-4 of the impulse; compression's error counts 1 + e fold
    assert np.abs((marched(cases, law) - impact.impulse) / size).max() < 4e-3


@pytest.mark.parametrize("law", LAWS)
def test_of_200_000_impacts_only_newton_ever_gains_energy(law: Law) -> None:
    cases = random_cases(200_000, 4)
    impact = resolve_impact(*cases, law)
    scale = np.sum(np.abs(impact.impulse * (np.abs(cases.velocity) + np.abs(impact.velocity))), -1)
    gained = float((impact.energy_change > 1e-12 * scale).mean())
    assert 1e-4 < gained < 0.1 if law == "newton" else gained == 0
    tangential, normal = impact.impulse.T
    assert np.all(normal > 0)
    assert np.all(np.abs(tangential) <= cases.friction * normal * (1 + 1e-12))
    assert np.all(impact.velocity[:, 1] >= -1e-12 * np.abs(cases.velocity).max())


def test_energy_change_is_that_of_the_bodys_own_motion() -> None:
    """½ P·(v⁻ + v⁺) against ½ m V² + ½ I ω² of the body, with a random spin before."""
    cases = random_cases(2000, 5)
    body = cases.body
    mass, inertia, arm = (np.asarray(a) for a in (body.mass, body.inertia, body.arm))
    lever = np.stack([-arm[:, 1], arm[:, 0]], axis=-1)

    def contact(motion: Array) -> Array:
        return np.asarray(motion[:, :2] + motion[:, 2:] * lever)

    def kinetic(motion: Array) -> Array:
        moving = mass * (motion[:, :2] ** 2).sum(-1) + inertia * motion[:, 2] ** 2
        return np.asarray(0.5 * moving)

    motion = np.random.default_rng(6).uniform(-1, 1, (2000, 3))
    motion[:, :2] += cases.velocity - contact(motion)
    for law in LAWS:
        impact = resolve_impact(body, contact(motion), *cases[2:], law)
        after = motion + body.velocity_change(impact.impulse)
        change = kinetic(after) - kinetic(motion)
        scale = 1e-13 * float(np.max(kinetic(motion)) + np.abs(impact.energy_change).max())
        assert impact.energy_change == pytest.approx(change, rel=1e-9, abs=10 * scale)
        assert contact(after) == pytest.approx(impact.velocity, abs=1e-9)


def test_laws_agree_without_friction_and_for_central_impact() -> None:
    body = ImpactBody(2, 0.1, [0.3, -0.4])
    for arm, friction in (([0.3, -0.4], 0.0), ([0.0, -0.4], 0.7)):
        body = ImpactBody(2, 0.1, arm)
        impulses = [resolve_impact(body, [0.5, -1], friction, 0.6, law).impulse for law in LAWS]
        assert impulses[1] == pytest.approx(impulses[0], abs=1e-13)
        if friction:  # with friction zero a reversal cannot change v_n either
            assert impulses[2] == pytest.approx(impulses[0], abs=1e-13)


def test_a_jam_goes_on_until_the_slip_is_over() -> None:
    """Sliding that presses the bodies together: μ|G| > D with sG < 0."""
    body = ImpactBody(1, 0.01, [0.1, -0.4])
    a, d, g = body.compliance()
    assert d + 1.5 * g < 0
    impact = resolve_impact(body, [1.0, -0.1], 1.5, 0.5)
    corner = 1 / (1.5 * a + g)
    assert impact.compression > corner
    assert impact.mode == Mode.STICKS_IN_COMPRESSION
    assert impact.energy_change < 0


def hit(velocity: Any = (0.8, -1.0), friction: Any = 0.5, *rest: Any, **named: Any) -> Any:
    return resolve_impact(ROD, velocity, friction, *(rest or (0.5,)), **named)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: hit((1, -1), 0.5, 1.01), r"restitution is 1.01 \(no unit\); it must be 0 to 1"),
        (lambda: hit((1, -1), 0.5, -0.1), r"it must be 0 to 1"),
        (lambda: hit(friction=-0.1), r"friction is -0.1 \(no unit\); it must be finite and >= 0"),
        (lambda: hit(friction=np.inf), "friction is inf .* finite"),
        (lambda: hit([0.0, 0.5]), "normal velocity is 0.5 m/s; it must be < 0"),
        (lambda: hit([0.0, 0.0]), "normal velocity is 0 m/s"),
        (lambda: hit([np.nan, -1]), "velocity is nan m/s; it must be finite"),
        (lambda: hit([1, 2, -3]), r"velocity has shape \(3,\)"),
        (lambda: hit((1, -1), [0.1, 0.2], [0.1, 0.2, 0.3]), "do not broadcast"),
        (lambda: ImpactBody(0, 1, [0, 0]), "mass is 0 kg; it must be finite and > 0"),
        (lambda: ImpactBody(1, -1, [0, 0]), "inertia is -1 kg m²"),
        (lambda: ImpactBody(1, 1, [0, np.inf]), "arm is inf m"),
        (lambda: ImpactBody(1, 1, [0, 0, 0]), r"arm has shape \(3,\)"),
        (lambda: ImpactBody([1, 2], [1, 2, 3], [0, 0]), "do not broadcast"),
        (lambda: TWO.velocity_change([1, 2, 3]), r"impulse has shape \(3,\)"),
        (lambda: TWO.velocity_change(1.0), r"impulse has shape \(\)"),
        (lambda: TWO.velocity_change(np.ones((3, 2))), "do not broadcast"),
    ],
)
def test_impossible_impacts_and_bodies_are_refused(call: Callable[[], Any], words: str) -> None:
    with pytest.raises(MechanicsError, match=words):
        call()
