"""The worst hand and the loop in the time domain, against the bounds in the frequency domain."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.theory.bounds import wall_damping
from hapticbridge.theory.sampled_loop import (
    SampledLoop,
    WorstHand,
    decays,
    stability_limit,
    threshold,
)
from hapticbridge.theory.virtual_mass import Integrator, environment_minimum_damping, minimum_mass

PERIODS = (2e-3, 1e-3, 2.5e-4)
SHARE = 1e-3  # the bound and the run agree within 0.1 %
WALL = Coupling(1000, 1, 1.0, 0.0)


def coupling(stiffness: float, damping: float) -> Coupling:
    return Coupling(stiffness, damping, 1.0, 0.0)


def hand_impedance(hand: WorstHand, frequency: float) -> complex:
    """Returns F/V of a hand's recursion at a frequency."""
    p, q, r = hand.recursion()
    back = np.exp(-1j * frequency * hand.period)
    return complex((1 - p * back) / (q + r * back))


@pytest.mark.parametrize("period", PERIODS)
@pytest.mark.parametrize(
    ("delay", "filter_time", "stiffness", "damping"),
    [(0, 0.0, 2000, 0.5), (0, 1e-3, 500, 3.0), (1, 0.0, 5000, 0.0), (3, 0.0, 500, 3.0),
     (1, 2e-3, 2000, 0.5)],
)  # fmt: skip
def test_run_against_a_wall_ends_where_the_bound_says(
    period: float, delay: int, filter_time: float, stiffness: float, damping: float
) -> None:
    k_and_b = coupling(stiffness, damping)
    loop = SampledLoop(k_and_b, period, delay=delay, filter_time=filter_time)
    bound = wall_damping(k_and_b, period, delay=delay, filter_time=filter_time)
    assert stability_limit(loop) == pytest.approx(bound, rel=SHARE)


@pytest.mark.parametrize("period", PERIODS)
@pytest.mark.parametrize("integrator", ["implicit", "semi_implicit", "explicit"])
@pytest.mark.parametrize("mass", [0.005, 0.05, 1.0])
def test_mass_ends_where_bound_says(period: float, integrator: Integrator, mass: float) -> None:
    k_and_b = coupling(1000, 2)
    loop = SampledLoop(k_and_b, period, mass=mass, integrator=integrator)
    bound = environment_minimum_damping(k_and_b, period, mass, integrator)
    assert stability_limit(loop) == pytest.approx(bound, rel=SHARE)


@settings(max_examples=25)
@given(
    st.floats(10, 1e5),
    st.floats(0, 1.5),
    st.floats(0.05, 1.5),
    st.sampled_from(["semi_implicit", "explicit"]),
)
def test_too_light_a_tool_is_unstable_whatever_the_device(
    stiffness: float, ratio: float, share: float, integrator: Integrator
) -> None:
    period = 1e-3
    k_and_b = coupling(stiffness, (1.1 + ratio) * stiffness * period)
    mass = share * float(minimum_mass(k_and_b, period, integrator))
    limit = stability_limit(SampledLoop(k_and_b, period, mass=mass, integrator=integrator))
    if share < 0.99:
        assert limit == math.inf
    elif share > 1.01:
        bound = environment_minimum_damping(k_and_b, period, mass, integrator)
        assert limit == pytest.approx(bound, rel=SHARE)


@settings(max_examples=50)
@given(
    st.floats(0.1, 20),
    st.floats(0.02, 0.999),
    st.complex_numbers(max_magnitude=1e4, allow_nan=False),
)
def test_hand_closes_the_loop_at_its_frequency(b: float, share: float, felt: complex) -> None:
    period = 1e-3
    theta = share * np.pi
    hand = WorstHand(b, theta / period, period, felt)
    # −H h = F and h = T v/(z − 1): the hand's impedance makes up for everything but the damping
    closing = -felt * period / (np.exp(1j * theta) - 1)
    impedance = hand_impedance(hand, theta / period)
    scale = b + abs(closing)
    assert impedance.real == pytest.approx(b, abs=1e-9 * scale)
    assert impedance.imag == pytest.approx(closing.imag, abs=1e-9 * scale)


def test_line_of_a_spring_has_the_closed_form() -> None:
    b, theta, period = 2.5, 0.3, 1e-3
    stiffness = 2 * b / period  # b is then the bound
    expected = b / math.tan(theta / 2) ** 2
    for response in (None, complex(stiffness)):
        hand = WorstHand(b, theta / period, period, response)
        assert hand.impedance == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("reactance", ["mass", "spring"])
def test_hand_never_gives_energy_out(reactance: str) -> None:
    felt = 3000 + (2000j if reactance == "mass" else -40000j)
    hand = WorstHand(1.3, 800.0, 1e-3, felt)
    assert (hand.reactance > 0) == (reactance == "mass")
    p, q, r = hand.recursion()
    force = np.random.default_rng(3).normal(size=5000)
    velocity, v, before = np.zeros_like(force), 0.0, 0.0
    for k, f in enumerate(force):
        v = p * v + q * f + r * before
        velocity[k], before = v, f
    absorbed = np.cumsum((force - hand.damping * velocity) * velocity)
    assert absorbed.min() > -1e-9
    # without the damper's share the line is lossless: it gives back nearly all that it took
    assert absorbed[-1] < 0.05 * np.cumsum(np.abs(force * velocity))[-1]


def test_tustins_damper_on_a_wall_needs_less_than_a_spring() -> None:
    # (7) is for every environment; a wall never asks the damper for its gain at Nyquist
    loop = SampledLoop(coupling(2000, 0.4), 1e-3, discretization="tustin")
    frequency = np.linspace(100, 3000, 50)
    assert loop.damping_spectrum(frequency) == pytest.approx(1.0 - 0.4, rel=1e-9)


def test_tustins_damper_rings_on_a_wall_but_not_behind_a_low_pass() -> None:
    loop = SampledLoop(coupling(2000, 0.2), 1e-3, discretization="tustin")
    assert stability_limit(loop) == math.inf
    filtered = replace(loop, filter_time=1e-3)
    assert stability_limit(filtered) == pytest.approx(1.1, rel=SHARE)


def test_tustins_damper_on_a_light_tool_asks_for_a_hundred_newton_seconds_per_metre() -> None:
    loop = SampledLoop(coupling(4000, 0.5), 1e-3, mass=0.05, discretization="tustin")
    assert stability_limit(loop) == pytest.approx(100.0, rel=SHARE)
    assert stability_limit(replace(loop, discretization="backward")) < 2.5


@given(st.floats(-20, 20), st.floats(-3, 3))
def test_threshold_is_found_from_any_start(log_threshold: float, log_start: float) -> None:
    value = 10**log_threshold
    found = threshold(lambda x: x > value, 10**log_start, 1e-6)
    assert found == pytest.approx(value, rel=1e-6)


def test_threshold_that_lies_outside_the_range_is_zero_or_infinite() -> None:
    assert threshold(lambda _: True, 1.0, 1e-3) == 0
    assert threshold(lambda _: False, 1.0, 1e-3) == math.inf


def test_run_that_diverges_with_its_last_sample_is_not_whole() -> None:
    loop = SampledLoop(coupling(2000, 0.5), 1e-3)
    hand = WorstHand(0.1, np.pi / 1e-3, 1e-3)
    whole = loop.simulate(hand, 10_000).force
    assert np.abs(whole[-1]) >= 1e100 > np.abs(whole[:-1]).max()
    assert loop.simulate(hand, whole.size).force.size == whole.size - 1
    assert loop.simulate(hand, whole.size - 1).force.size == whole.size - 1
    assert not decays(loop.simulate(hand, whole.size).force, whole.size)


@pytest.mark.parametrize("period", [1e-3, 7e-4, 1 / 3000])
def test_nyquist_hand_has_no_reactance_left_from_rounding(period: float) -> None:
    for response in (None, 1e9 + 1e9j):
        hand = WorstHand(2.0, np.pi / period, period, response)
        assert hand.reactance == 0
        assert hand.recursion() == (0.0, 0.5, 0.0)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        *((lambda bad=bad: WorstHand(1.0, bad, 1e-3), "frequency")
          for bad in (math.nan, math.inf, -1.0, 0.0, 4000.0, [100.0], "a", None, True)),
        (lambda: WorstHand(1.0, 100.0, 1e-3, "a"), "response is"),  # type: ignore[arg-type]
        (lambda: WorstHand(1.0, 100.0, 1e-3, complex(math.inf, 0)), "response"),
        (lambda: WorstHand(0.0, 100.0, 1e-3), "device damping"),
        (lambda: WorstHand(math.nan, 100.0, 1e-3), "device damping"),
        (lambda: WorstHand(1.0, 100.0, -1e-3), "period"),
        (lambda: SampledLoop(WALL, 0.0), "period"),
        (lambda: SampledLoop(WALL, 1e-3, mass=-0.1), "mass"),
        (lambda: SampledLoop(WALL, 1e-3, mass=math.inf), "mass"),
        (lambda: SampledLoop(WALL, 1e-3, delay=-1), "delay"),
        (lambda: SampledLoop(WALL, 1e-3, delay=1.5), "delay"),  # type: ignore[arg-type]
        (lambda: SampledLoop(WALL, 1e-3, filter_time=math.nan), "filter time"),
        (lambda: SampledLoop(WALL, 1e-3, integrator="leapfrog"), "'implicit', 'semi_implicit'"),  # type: ignore[arg-type]
        (lambda: SampledLoop(WALL, 1e-3).simulate(WorstHand(1, 100, 2e-3), 10), r"0\.002 s, the l"),
        (lambda: SampledLoop(WALL, 1e-3).simulate(WorstHand(1, 100, 1e-3), 0), "run is 0"),
    ],
)  # fmt: skip
def test_what_is_no_hand_and_no_loop_is_refused(call: Callable[[], Any], words: str) -> None:
    with pytest.raises(CouplingError, match=words):
        call()
