"""The damping that a felt coupling needs, against spectrum, worst hand and motion."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.theory.bounds import (
    effective_damping,
    largest_effective_damping,
    law_damping,
)
from hapticbridge.theory.rigid_body import drive_mass

T = 1e-3
LAGS = {"implicit": 1.0, "midpoint": 0.5}


def required_device_damping(k: float, felt: float, period: float, lag: float) -> float:
    """K T/2 + B', the device damping for K and an effective B."""
    return 0.5 * k * period + law_damping(k, felt, period, lag)


def tool_spectrum(
    theta: np.ndarray, stiffness: float, damping: float, mass: float, scheme: str
) -> np.ndarray:
    """(T/2) Re[(1 − w) H]/(1 − cos θ) of a free tool behind the law K, B'; an own derivation."""
    w = np.exp(-1j * theta)
    law = stiffness + damping * (1 - w) / T
    moved = T**2 / mass / (1 - w) ** 2  # of a unit force, implicit Euler
    if scheme == "midpoint":
        moved = moved * (1 + w) / 2
    felt = law / (1 + law * moved)
    return np.asarray(T / 2 * ((1 - w) * felt).real / (1 - np.cos(theta)))


@given(
    k=st.floats(10.0, 1e4),
    b=st.floats(0.0, 20.0),
    mass=st.floats(1e-3, 10.0),
    scheme=st.sampled_from(sorted(LAGS)),
)
def test_no_free_tool_needs_more_than_a_wall(k: float, b: float, mass: float, scheme: str) -> None:
    damping = law_damping(k, b, T, LAGS[scheme])
    theta = np.linspace(1e-3, np.pi, 4001)
    needed = required_device_damping(k, b, T, LAGS[scheme])
    spectrum = tool_spectrum(theta, k, damping, mass, scheme)
    assert spectrum.max() <= needed * (1 + 1e-9)
    if scheme == "midpoint":  # at Nyquist a tool of any mass stands still
        assert spectrum[-1] == pytest.approx(needed, rel=1e-6)
    wall = tool_spectrum(theta, k, damping, 1e12, scheme)
    assert wall[-1] == pytest.approx(needed, rel=1e-6)


def test_formulas_of_the_theory_where_nothing_is_clipped() -> None:
    assert required_device_damping(1000.0, 5.0, T, 1.0) == pytest.approx(5.0 - 0.5)  # B − KT/2
    assert required_device_damping(1000.0, 5.0, T, 0.5) == pytest.approx(5.0)  # B
    assert required_device_damping(2400.0, 0.5, T, 0.5) == pytest.approx(1.2)  # clipped: KT/2
    assert effective_damping(2400.0, 0.0, T, 0.5) == pytest.approx(1.2)
    assert law_damping(1000.0, 5.0, T, 0.5) == pytest.approx(4.5)


@pytest.mark.parametrize("scheme", ["compensated", "midpoint"])
def test_a_mass_decays_as_fast_as_the_felt_damping_says(scheme: str) -> None:
    # ln of the amplitude falls by B/(2m) a second, whatever the period, if B is what is felt
    lag = LAGS["implicit"] if scheme == "compensated" else LAGS["midpoint"]
    rates = []
    for period in (1e-3, 5e-4):
        damping = law_damping(1000.0, 5.0, period, lag)
        coupling = Coupling(1000.0, effective_damping(1000.0, damping, period, lag), 0, 0)
        assert coupling.damping == pytest.approx(5.0)
        handle = np.zeros(round(1.0 / period) + 2)
        handle[0] = 0.01  # it jumps to 0 in the first step
        motion = drive_mass(coupling, 1.0, handle, period, scheme)  # type: ignore[arg-type] # one of the schemes
        energy = 500.0 * motion.position**2 + 0.5 * motion.velocity**2
        rates.append(np.log(energy[1] / energy[-1]) / (1.0 * 2))
    assert rates == pytest.approx([2.5, 2.5], rel=0.03)


@pytest.mark.parametrize("period", [0.0, -1e-3, float("nan"), float("inf")])
def test_a_period_out_of_range_is_refused(period: float) -> None:
    with pytest.raises(CouplingError, match="period"):
        required_device_damping(1000.0, 5.0, period, 0.5)


@given(k=st.floats(10.0, 1e4), b=st.floats(0.1, 20.0), scheme=st.sampled_from(sorted(LAGS)))
def test_largest_effective_damping_is_what_device_just_bears(
    k: float, b: float, scheme: str
) -> None:
    most = largest_effective_damping(b, k, T, LAGS[scheme])
    if k * T > 2 * b:
        assert most == 0.0
        assert required_device_damping(k, 0.0, T, LAGS[scheme]) > b
        return
    assert required_device_damping(k, most, T, LAGS[scheme]) == pytest.approx(b)
    assert required_device_damping(k, 1.01 * most, T, LAGS[scheme]) > b


def test_a_device_that_bears_the_larger_damping_bears_any_sequence_of_dampings() -> None:
    """Σ f_k (d_{k+1} − δx_k) + Σ (b/T) d_k² + ½K d_1² >= 0 from e_0 = 0, for any motions."""
    random = np.random.default_rng(3)
    stiffness, low, high = 2400.0, 0.5, 1.7
    device = 0.5 * stiffness * T + high
    for trial, count in itertools.product(range(20), (2, 20, 200)):
        law = random.choice([low, high], count)
        handle = random.normal(size=count + 1)
        if trial % 2:  # every other at Nyquist, where it is hardest
            handle = np.abs(handle) * (-1.0) ** np.arange(count + 1)
        tool = random.normal(size=count) * random.choice([0.0, 0.1, 1.0])
        moved = handle[:-1] - tool
        force = stiffness * np.cumsum(moved) + law / T * moved
        burnt = device / T * np.sum(handle**2)
        work = np.sum(force * (handle[1:] - tool)) + 0.5 * stiffness * handle[0] ** 2
        assert work + burnt >= -1e-9 * burnt
