"""The bound of a delayed coupling against a wall, against a dense sweep over frequency."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.theory.bounds import minimum_damping, worst_frequency
from hapticbridge.theory.spectrum import damping_spectrum, search_grid
from hapticbridge.theory.transfer import MOST_DELAY, CouplingGrid, Discretization
from hapticbridge.theory.z_width import z_width

T = 1e-3
SCHEMES: tuple[Discretization, ...] = ("backward", "tustin")
THETA = np.union1d(np.linspace(1e-4, np.pi, 20_001), np.geomspace(1e-6, 1e-1, 4001))


@given(
    st.floats(0, 5),
    st.floats(-2, 2),
    st.sampled_from(SCHEMES),
    st.integers(0, 6),
    st.floats(-3, 2),
)
@settings(max_examples=60)
def test_bound_and_worst_frequency_are_those_of_a_dense_sweep(
    log_k: float, log_b: float, scheme: Discretization, delay: int, log_lag: float
) -> None:
    coupling, tau = Coupling(10**log_k, 10**log_b, 0, 0), T * 10**log_lag
    bound = minimum_damping(coupling, T, discretization=scheme, delay=delay, filter_time=tau)
    swept = damping_spectrum(
        coupling, T, THETA / T, discretization=scheme, delay=delay, filter_time=tau
    )
    scale = 10**log_k * T * (delay + 1) + 10**log_b
    # between its points the sweep misses a maximum by (7 · half a step)²/2, 2e-7 of the ripple
    assert swept.max() == pytest.approx(bound, abs=1e-6 * scale)
    assert swept.max() <= bound + 1e-9 * scale
    worst = worst_frequency(coupling, T, discretization=scheme, delay=delay, filter_time=tau)
    there = damping_spectrum(
        coupling, T, worst or 1e-6 / T, discretization=scheme, delay=delay, filter_time=tau
    )
    assert float(there) == pytest.approx(bound, abs=1e-8 * scale)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("tau", [0.0, 3e-4, 1e-2])
@pytest.mark.parametrize("delay", [1, 4])
def test_spectrum_of_a_late_coupling_is_the_printed_condition(
    scheme: Discretization, tau: float, delay: int
) -> None:
    theta = np.linspace(1e-2, 3.1, 300)
    z = np.exp(1j * theta)
    rate = (1 - 1 / z) / T if scheme == "backward" else 2 / T * (z - 1) / (z + 1)
    late = (1500 + 0.7 * rate / (1 + tau * rate)) * z**-delay
    needed = T / 2 * np.real((1 - 1 / z) * late) / (1 - np.cos(theta))
    spectrum = damping_spectrum(
        Coupling(1500, 0.7, 0, 0),
        T,
        theta / T,
        discretization=scheme,
        delay=delay,
        filter_time=tau,
    )
    np.testing.assert_allclose(spectrum, needed, rtol=1e-8, atol=1e-8)


def test_a_weak_low_pass_hides_no_maximum_near_the_first_cell() -> None:
    grid = CouplingGrid(1000, 0.5606992373916568)
    bound = minimum_damping(grid, T, delay=2, filter_time=1e-6)
    swept = damping_spectrum(grid, T, THETA / T, delay=2, filter_time=1e-6)
    assert bound == pytest.approx(swept.max(), rel=1e-8)


@given(st.integers(1, MOST_DELAY), st.floats(1e-3, 1e6))
@example(36, 1.90625)  # the low-pass begins beside the end of the first cell
@example(8, 0.01 / (1e-6 + (np.pi - 1e-6) / 144) * (1 + 1e-13))  # beside it by rounding
@example(1, 1e4 * (1 - 1e-13))  # beside the lowest angle
def test_no_two_angles_of_the_search_are_equal_but_for_rounding(delay: int, lag: float) -> None:
    grid = search_grid(delay, lag)
    assert grid[-1] == np.pi
    assert (np.diff(grid) > 1e-3 * grid[:-1]).all()


def test_worst_frequency_of_a_rotation_is_that_of_its_own_pair() -> None:
    coupling = Coupling(1000, 0.1, 1.0, 2e-3)
    turned = Coupling(1.0, 2e-3, 0, 0)
    assert worst_frequency(coupling, T, delay=1, axis="rotation") == worst_frequency(
        turned, T, delay=1
    )
    assert worst_frequency(coupling, T, delay=1, axis="rotation") != worst_frequency(
        coupling, T, delay=1
    )


def test_tustins_damper_is_worst_at_nyquist_unless_there_is_none_or_a_low_pass() -> None:
    grid = CouplingGrid(1000, [0.0, 1.0])
    unfiltered = worst_frequency(grid, T, discretization="tustin", delay=2)
    np.testing.assert_array_equal(unfiltered, [0, np.pi / T])
    low_passed = Coupling(1000, 1, 0, 0)
    backward, tustin = (
        worst_frequency(low_passed, T, discretization=scheme, delay=2, filter_time=T)
        for scheme in SCHEMES
    )
    assert backward != pytest.approx(tustin, rel=1e-3)


def test_many_couplings_give_what_each_gives_alone() -> None:
    k, b = np.meshgrid(np.geomspace(10, 1e5, 60), np.geomspace(0.01, 20, 40))
    together = np.asarray(minimum_damping(CouplingGrid(k, b), T, delay=3, filter_time=2e-3))
    assert together.shape == (40, 60)
    for i, j in ((0, 0), (39, 59), (7, 31)):
        alone = minimum_damping(Coupling(k[i, j], b[i, j], 0, 0), T, delay=3, filter_time=2e-3)
        assert together[i, j] == pytest.approx(alone, rel=1e-12)


def test_thirty_samples_of_delay_are_computed_in_two_seconds() -> None:
    began = time.process_time()
    z_width(2, T, mass=0.1, delay=30)
    assert time.process_time() - began < 2


def test_a_delay_beyond_all_use_is_refused() -> None:
    with pytest.raises(CouplingError, match=r"delay is 51; it must be .* >= 0 and <= 50"):
        minimum_damping(Coupling(1, 0, 0, 0), T, delay=MOST_DELAY + 1)
    with pytest.raises(CouplingError, match="delay is"):
        z_width(2, T, delay=10**30)
    with pytest.raises(CouplingError, match="delay is True"):
        minimum_damping(Coupling(1, 0, 0, 0), T, delay=True)
