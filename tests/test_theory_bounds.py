"""Bounds of the passivity theory against closed forms, frequency sweeps and printed numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.theory.bounds import (
    maximum_stiffness,
    minimum_damping,
    stiffest_coupling,
    wall_damping,
    worst_frequency,
)
from hapticbridge.theory.spectrum import damping_spectrum, damping_spectrum_of, search_grid
from hapticbridge.theory.transfer import MAX_DELAY, CouplingGrid, Discretization
from hapticbridge.theory.virtual_mass import (
    Integrator,
    environment_minimum_damping,
    minimum_mass,
)
from hapticbridge.theory.z_width import quantization_limit, z_width

T = 1e-3
positive = st.floats(1e-6, 1e6)


@pytest.mark.parametrize("damping", [0.5, 1.0, 2.0, 5.0, 10.0, 20.0])
def test_largest_stiffness_at_1_khz_is_2000_per_unit_of_damping(damping: float) -> None:
    assert maximum_stiffness(damping, T) == pytest.approx(2000 * damping, rel=1e-15)
    assert maximum_stiffness(damping, T / 2) == 2 * maximum_stiffness(damping, T)


def test_default_coupling_of_the_default_device() -> None:
    coupling = dataclasses.astuple(stiffest_coupling(2.0, 2e-3, T))
    assert coupling == pytest.approx((2400, 0.5, 2.4, 5e-4), rel=1e-15)


@given(positive, st.floats(0, 0.999), st.floats(1e-5, 1))
def test_largest_stiffness_is_exact(device_damping: float, share: float, period: float) -> None:
    damping = share * device_damping
    stiffness = maximum_stiffness(device_damping, period, damping)
    needed = minimum_damping(Coupling(stiffness, damping, 0, 0), period)
    assert needed == pytest.approx(device_damping, rel=1e-12)


@given(positive, positive, st.floats(1e-5, 1))
def test_default_leaves_a_fifth(damping: float, rotational_damping: float, period: float) -> None:
    coupling = stiffest_coupling(damping, rotational_damping, period)
    # K T/2 + B = 0.8 · (3/4) b + b/4 = 0.85 b
    assert minimum_damping(coupling, period) == pytest.approx(0.85 * damping, rel=1e-12)
    turned = CouplingGrid(coupling.rotational_stiffness, coupling.rotational_damping)
    assert minimum_damping(turned, period) == pytest.approx(0.85 * rotational_damping, rel=1e-12)


SCHEMES: tuple[Discretization, ...] = ("backward", "tustin")
INTEGRATORS: tuple[Integrator, ...] = ("implicit", "semi_implicit", "explicit")
WALL = Coupling(1000, 1, 0, 0)
THETA = np.union1d(np.linspace(1e-4, np.pi, 8001), np.geomspace(1e-5, 1, 2001))
stiffnesses = st.floats(1, 1e5)


@given(stiffnesses, st.floats(1e-3, 50))
def test_tustins_damper_has_no_bound_but_a_closed_form(stiffness: float, damping: float) -> None:
    coupling = Coupling(stiffness, damping, 0, 0)
    theta = THETA[:-1]
    closed = ((stiffness * T) ** 2 + 4 * damping**2 * np.tan(theta / 2) ** 2) / (
        2 * (stiffness * T + 2 * damping)
    )
    spectrum = damping_spectrum(coupling, T, theta / T, discretization="tustin")
    np.testing.assert_allclose(spectrum, closed, rtol=1e-9)
    assert damping_spectrum(coupling, T, np.pi / T, discretization="tustin") == np.inf
    assert minimum_damping(coupling, T, discretization="tustin") == np.inf
    assert minimum_damping(coupling, T, discretization="tustin", delay=2) == np.inf


def test_delay_against_a_wall_has_closed_forms() -> None:
    for delay in range(4):  # Colgate & Schenkel
        bound = wall_damping(Coupling(1000, 0, 0, 0), T, delay=delay)
        assert bound == pytest.approx(1000 * (T / 2 + delay * T), rel=1e-9)
    # a(1 + 2x) − B(2x² − 1), x = cos θ, a = KT/2 = 0.5: maximum at x = a/(2B) for a < 2B
    bound = wall_damping(Coupling(1000, 2, 0, 0), T, delay=1)
    assert bound == pytest.approx(0.5 + 0.5**2 / 4 + 2, rel=1e-9)
    assert wall_damping(WALL, T, discretization="tustin", delay=2) == np.inf


@given(stiffnesses, st.floats(0, 50))
def test_one_tick_of_delay_has_a_closed_form_in_every_scene(k: float, damping: float) -> None:
    # with x = sin²(θ/2): (1 − x)(4 (β² + K β) x + K²), largest inside for y² > 2 K²
    y = k + 2 * damping / T
    closed = T * y**3 / (2 * (y**2 - k**2)) if y**2 > 2 * k**2 else 2 * T * k**2 / y
    law = Coupling(k, damping, 0, 0)
    assert minimum_damping(law, T, delay=1) == pytest.approx(closed, rel=1e-9)
    # y² = 3 K² is the stiffest: K = 4 b/(3 √3 T)
    assert closed > 0.75 * np.sqrt(3) * k * T * (1 - 1e-9)


def test_no_damping_suffices_if_the_tool_too_gets_its_force_late() -> None:
    frequency = np.linspace(1, np.pi / T, 500)
    delayed = damping_spectrum_of(lambda z: 1000 / z, T, frequency)
    assert np.isinf(delayed).any()
    assert np.isfinite(damping_spectrum_of(lambda z: 1000 + 0 / z, T, frequency)).all()


def test_any_transfer_function_gives_the_spectrum_of_the_coupling_it_is() -> None:
    k, b = 1500.0, 1.5
    frequency = np.linspace(10, np.pi / T, 300)
    expected = damping_spectrum(Coupling(k, b, 0, 0), T, frequency)
    by_callable = damping_spectrum_of(lambda z: k + b / T * (1 - 1 / z), T, frequency)
    np.testing.assert_allclose(by_callable, expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("mass", "needed"),
    [
        (0.002, (1.5385, 6.6667, np.inf)),
        (0.005, (2.0, 3.3333, 2.0)),
        (0.01, (2.2222, 2.8571, 2.2222)),
        (0.05, (2.4390, 2.5641, 2.4390)),
    ],
)
def test_mass_behind_coupling_needs_printed_damping(mass: float, needed: tuple[float, ...]) -> None:
    coupling = Coupling(1000, 2, 0, 0)
    found = [environment_minimum_damping(coupling, T, mass, scheme) for scheme in INTEGRATORS]
    assert found == pytest.approx(needed, abs=5e-5)


def test_smallest_mass_is_where_the_environment_turns_unstable() -> None:
    k, b = 1000.0, 2.0
    coupling = Coupling(k, b, 0, 0)
    assert minimum_mass(coupling, T) == 0
    assert minimum_mass(coupling, T, "semi_implicit") == pytest.approx(T / 2 * 2.5, rel=1e-12)
    # the least over B, 4 K T², is at B = 2 K T
    assert minimum_mass(coupling, T, "explicit") == pytest.approx(4 * k * T**2, rel=1e-12)
    assert minimum_mass(Coupling(k, k * T, 0, 0), T, "explicit") == np.inf


@pytest.mark.parametrize(
    ("b", "friction", "region"),
    [
        (0.6, 0.06, "passive"),
        (0.4, 0.06, "locally stable"),
        (0.6, 0.04, "bounded limit cycle"),
        (0.4, 0.04, "unstable"),
        # an edge belongs to what promises less: neither β = ½ nor σ = ½ is above it
        (0.5, 0.06, "locally stable"),
        (0.6, 0.05, "bounded limit cycle"),
        (0.5, 0.05, "unstable"),
    ],
)
def test_quantization_has_diolaitis_four_regions(b: float, friction: float, region: str) -> None:
    limit = quantization_limit(b, friction, 1e-4, Coupling(1000, 0, 0, 0), T)
    assert limit.region == region
    assert (limit.beta == 0.5, limit.sigma == 0.5) == (b == 0.5, friction == 0.05)


def test_stiffness_at_the_quantization_limit_needs_just_the_friction_there_is() -> None:
    limit = quantization_limit(5.0, 0.05, 1e-5, Coupling(1000, 1.0, 0, 0), T)
    assert limit.stiffness == pytest.approx(min(2 * 4 / T, 2 * (0.05 / 1e-5 - 1 / T)), rel=1e-12)
    limit = quantization_limit(5.0, 0.05, 4e-5, Coupling(1000, 1.0, 0, 0), T)
    assert limit.limited_by == "friction"
    at_limit = quantization_limit(5.0, 0.05, 4e-5, Coupling(limit.stiffness, 1.0, 0, 0), T)
    assert at_limit.friction_needed == pytest.approx(0.05, rel=1e-12)


def test_grid_agrees_with_single_couplings() -> None:
    k, b = np.array([[500.0], [2000.0]]), np.array([0.0, 0.5, 3.0])
    grid = CouplingGrid(k, b)
    singles = [[Coupling(float(row[0]), float(column), 0, 0) for column in b] for row in k]
    bounds: tuple[Callable[[Any], Any], ...] = (
        lambda c: minimum_damping(c, T),
        lambda c: minimum_damping(c, T, delay=2.5, filter_time=1e-3),
        lambda c: minimum_damping(c, T, delay=3, ticks_per_sample=2),
        lambda c: wall_damping(c, T, delay=2, filter_time=1e-3),
        lambda c: minimum_damping(c, T, discretization="tustin"),
        lambda c: environment_minimum_damping(c, T, 0.02, "semi_implicit"),
        lambda c: minimum_mass(c, T, "explicit"),
    )
    for bound in bounds:
        np.testing.assert_allclose(bound(grid), [[bound(c) for c in row] for row in singles])
    assert damping_spectrum(grid, T, np.ones(7)).shape == (2, 3, 7)


OUT_OF_RANGE: list[tuple[Callable[[Any], Any], str]] = [
    (lambda v: minimum_damping(WALL, v), "period is"),
    (lambda v: maximum_stiffness(1, v), "period is"),
    (lambda v: maximum_stiffness(v, T), "device damping is"),
    (lambda v: maximum_stiffness(1, T, damping=v), "coupling damping is"),
    (lambda v: stiffest_coupling(v, 1, T), "device damping is"),
    (lambda v: stiffest_coupling(1, v, T), "device damping is"),
    (lambda v: minimum_damping(WALL, T, filter_time=v), "filter time is"),
    (lambda v: damping_spectrum(WALL, T, [100.0, v]), "frequency is"),
    (lambda v: environment_minimum_damping(WALL, T, [0.1, v]), "mass is"),
    (lambda v: CouplingGrid([1.0, v]), "coupling stiffness is"),
]
REFUSED: list[tuple[Callable[[], Any], str]] = [
    *((partial(call, bad), words) for call, words in OUT_OF_RANGE for bad in (-1, np.nan, np.inf)),
    (lambda: minimum_damping(WALL, 0.0), "period is"),
    (lambda: maximum_stiffness(2, T / 2, damping=2), "no stiffness is passive"),
    (lambda: CouplingGrid([1.0, 2.0], [1.0, 2.0, 3.0]), "do not broadcast"),
    (lambda: wall_damping(WALL, T, delay=0.5), "whole number of samples"),  # type: ignore[arg-type]
    (lambda: wall_damping(WALL, T, delay=51), r"delay is 51; it must be .*, 0 to 50"),
    (lambda: minimum_damping(WALL, T, delay=True), "delay is True"),
    (lambda: minimum_damping(WALL, T, delay=50.1), r"delay is 50.1 ticks; it must be .*50"),
    (lambda: minimum_damping(WALL, T, ticks_per_sample=0), "ticks per sample is 0"),
    (lambda: z_width(2, T, delay=10**30), "delay is"),
    (lambda: minimum_damping(WALL, T, discretization="euler"), "one of 'backward', 'tustin'"),  # type: ignore[call-overload]
    (lambda: minimum_mass(WALL, T, "rk4"), "one of 'explicit', 'implicit', 'semi_implicit'"),  # type: ignore[arg-type]
    (lambda: damping_spectrum(WALL, T, 4 / T), "half the sampling rate"),
    (lambda: quantization_limit(1.0, None, 0.0, WALL, T), "device friction is None"),  # type: ignore[arg-type]
    (
        lambda: environment_minimum_damping(CouplingGrid([1e-30, 1000], [1e30, 1]), 1e-30, 1e30),
        "too far apart for double precision",
    ),
]


@pytest.mark.parametrize(("call", "words"), REFUSED)
def test_what_has_no_meaning_is_refused(call: Callable[[], Any], words: str) -> None:
    with pytest.raises(CouplingError, match=words):
        call()


def test_exact_positions_leave_only_the_damping_to_limit() -> None:
    limit = quantization_limit(1.0, 0.0, 0.0, Coupling(1000, 2.0, 0, 0), T)
    assert limit.limited_by == "damping"
    assert limit.stiffness == 0  # the damper alone is too much
    assert limit.sigma == np.inf
    assert limit.friction_needed == 0


def test_fields_of_a_grid_are_its_own_and_cannot_be_written() -> None:
    stiffness = np.array([1.0, 2.0])
    grid = CouplingGrid(stiffness, 1.0)
    stiffness[0] = 7.0
    for field in (grid.stiffness, grid.damping):
        array = np.asarray(field)
        assert not array.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 3.0
    assert np.asarray(grid.stiffness)[0] == 1


def test_a_late_force_without_damper_is_no_stable_environment_whatever_the_mass() -> None:
    undamped = Coupling(1000, 0, 0, 0)
    late = environment_minimum_damping(undamped, T, [0.05, 1, 1e6], "semi_implicit")
    np.testing.assert_array_equal(late, np.inf)
    assert np.isfinite(environment_minimum_damping(undamped, T, 0.05, "implicit"))


FINE = np.union1d(np.linspace(1e-4, np.pi, 20_001), np.geomspace(1e-6, 1e-1, 4001))


@given(
    st.floats(1, 1e5),
    st.floats(0, 50),
    st.sampled_from(SCHEMES),
    st.one_of(st.integers(0, 6), st.floats(0, 6)),
    st.one_of(st.just(0.0), st.floats(-3, 2).map(lambda log: 10**log)),
)
@settings(max_examples=100)
@example(1000, 0.5606992373916568, "backward", 2, 1e-3)  # a maximum near the first cell
def test_bound_and_worst_frequency_are_those_of_a_dense_sweep(
    stiffness: float, damping: float, scheme: Discretization, delay: float, lag: float
) -> None:
    assume(scheme == "backward" or damping == 0 or lag > 0)  # Tustin's damper alone has no bound
    coupling = Coupling(stiffness, damping, 0, 0)
    how: Any = {"discretization": scheme, "delay": delay, "filter_time": lag * T}
    bound = minimum_damping(coupling, T, **how)
    swept = damping_spectrum(coupling, T, FINE / T, **how)
    scale = stiffness * T * (delay + 1) ** 2 + damping
    # between its points the sweep misses a maximum by (7 · half a step)²/2, 2e-7 of the ripple
    assert swept.max() == pytest.approx(bound, rel=1e-6, abs=1e-6 * scale)
    assert swept.max() <= bound * (1 + 1e-9) + 1e-9 * scale
    worst = worst_frequency(coupling, T, **how)
    there = damping_spectrum(coupling, T, worst or 1e-6 / T, **how)
    assert float(there) == pytest.approx(bound, rel=1e-7, abs=1e-8 * scale)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(("tau", "delay"), [(0, 0), (3e-4, 0), (0, 1), (3e-4, 4), (1e-2, 1)])
def test_spectrum_is_the_condition_as_printed(
    scheme: Discretization, tau: float, delay: int
) -> None:
    law = Coupling(1500, 0.7, 0, 0)
    options: Any = {"discretization": scheme, "delay": delay, "filter_time": tau}
    theta = np.linspace(1e-2, 3.1, 300)
    z = np.exp(1j * theta)
    rate = (1 - 1 / z) / T if scheme == "backward" else 2 / T * (z - 1) / (z + 1)
    transfer = 1500 + 0.7 * rate / (1 + tau * rate)
    needed = T / 2 * (1 - np.cos((delay + 1) * theta)) / np.real((1 - 1 / z) / transfer)
    of_any = damping_spectrum_of(lambda _: transfer, T, theta / T, delay=delay)
    np.testing.assert_allclose(of_any, needed, rtol=1e-8, atol=1e-8)
    found = damping_spectrum(law, T, theta / T, **options)
    np.testing.assert_allclose(found, needed, rtol=1e-8, atol=1e-8)


@given(st.integers(1, MAX_DELAY), st.floats(1e-3, 1e6))
@example(36, 1.90625)  # the low-pass begins beside the end of the first cell
@example(8, 0.01 / (1e-6 + (np.pi - 1e-6) / 144) * (1 + 1e-13))  # beside it by rounding
@example(1, 1e4 * (1 - 1e-13))  # beside the lowest angle
def test_no_two_angles_of_the_search_are_equal_but_for_rounding(delay: int, lag: float) -> None:
    grid = search_grid(delay, lag)
    assert grid[-1] == np.pi
    assert (np.diff(grid) > 1e-3 * grid[:-1]).all()


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
