"""Bounds of the passivity theory against frequency sweeps and printed numbers."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.theory.bounds import (
    coupled_stability_limit,
    matrix_margin,
    maximum_stiffness,
    minimum_damping,
)
from hapticbridge.theory.device_limits import quantization_limit
from hapticbridge.theory.spectrum import damping_spectrum, damping_spectrum_of
from hapticbridge.theory.transfer import CouplingGrid, Discretization
from hapticbridge.theory.virtual_mass import (
    FORCE_DELAY,
    Integrator,
    environment_minimum_damping,
    minimum_mass,
)

T = 1e-3
SCHEMES: tuple[Discretization, ...] = ("backward", "tustin")
INTEGRATORS: tuple[Integrator, ...] = ("implicit", "semi_implicit", "explicit")
THETA = np.union1d(np.linspace(1e-4, np.pi, 8001), np.geomspace(1e-5, 1, 2001))
stiffnesses = st.floats(1, 1e5)
dampings = st.floats(0, 50)


def needed_behind(transfer: np.ndarray, theta: np.ndarray, period: float) -> np.ndarray:
    """(2), written as it is printed."""
    backward = 1 - np.exp(-1j * theta)
    return np.asarray(period / 2 * (1 - np.cos(theta)) / np.real(backward / transfer))


@given(stiffnesses, dampings, st.floats(1e-5, 1e-1), st.sampled_from(SCHEMES))
@settings(max_examples=40)
def test_low_passed_bounds_are_the_supremum_of_their_spectra(
    stiffness: float, damping: float, tau: float, scheme: Discretization
) -> None:
    coupling = Coupling(stiffness, damping, 0, 0)
    bound = minimum_damping(coupling, T, discretization=scheme, filter_time=tau)
    z = np.exp(1j * THETA[THETA > 1e-2])
    low = (1 - 1 / z) / T if scheme == "backward" else 2 / T * (z - 1) / (z + 1)
    needed = needed_behind(stiffness + damping * low / (1 + tau * low), np.angle(z), T)
    # (z − 1)/(z + 1) loses digits beside Nyquist: 1e-6; the closed spectrum does not: 1e-9
    assert needed[:-1].max() == pytest.approx(bound, rel=2e-3)
    assert needed[:-1].max() <= bound * (1 + 1e-6)
    spectrum = damping_spectrum(coupling, T, THETA / T, discretization=scheme, filter_time=tau)
    assert spectrum.max() == pytest.approx(bound, rel=1e-9)


@given(stiffnesses, st.floats(1e-3, 50))
def test_tustins_damper_follows_its_closed_form_and_no_damping_suffices(
    stiffness: float, damping: float
) -> None:
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


@given(stiffnesses, dampings, st.integers(1, 6))
@settings(max_examples=40)
def test_bound_against_a_wall_is_the_supremum_of_the_dirichlet_kernel(
    stiffness: float, damping: float, delay: int
) -> None:
    needed = stiffness * T / 2 * np.sin((2 * delay + 1) * THETA / 2) / np.sin(
        THETA / 2
    ) - damping * np.cos((delay + 1) * THETA)
    bound = minimum_damping(Coupling(stiffness, damping, 0, 0), T, delay=delay)
    assert isinstance(bound, float)
    # the sweep misses a maximum by at most (curvature) · (half a grid step)²
    assert needed.max() == pytest.approx(bound, rel=2e-5)
    assert needed.max() <= bound * (1 + 1e-9)
    if damping == 0:
        assert bound == pytest.approx(stiffness * (T / 2 + delay * T), rel=1e-9)
    else:
        assert minimum_damping(Coupling(stiffness, 0, 0, 0), T, delay=delay) == pytest.approx(
            stiffness * (T / 2 + delay * T), rel=1e-9
        )


def test_one_sample_of_delay_against_a_wall_has_a_closed_form() -> None:
    # a(1 + 2x) − B(2x² − 1), x = cos θ, a = KT/2: maximum at x = a/(2B) for a < 2B
    stiffness, damping = 1000.0, 2.0
    a = stiffness * T / 2
    closed = a + a**2 / (2 * damping) + damping
    bound = minimum_damping(Coupling(stiffness, damping, 0, 0), T, delay=1)
    assert bound == pytest.approx(closed, rel=1e-9)


def test_no_damping_suffices_for_every_environment_behind_a_delayed_coupling() -> None:
    frequency = np.linspace(1, np.pi / T, 500)
    delayed = damping_spectrum_of(lambda z: 1000 / z, T, frequency)
    assert np.isinf(delayed).any()
    assert np.isfinite(damping_spectrum_of(lambda z: 1000 + 0 / z, T, frequency)).all()


def test_any_transfer_function_gives_the_spectrum_of_the_coupling_it_is() -> None:
    k, b = 1500.0, 1.5
    frequency = np.linspace(10, np.pi / T, 300)
    expected = damping_spectrum(Coupling(k, b, 0, 0), T, frequency)
    system = signal.TransferFunction([k + b / T, -b / T], [1, 0], dt=T)
    np.testing.assert_allclose(damping_spectrum_of(system, T, frequency), expected, rtol=1e-9)
    by_callable = damping_spectrum_of(lambda z: k + b / T * (1 - 1 / z), T, frequency)
    np.testing.assert_allclose(by_callable, expected, rtol=1e-9)
    with pytest.raises(CouplingError, match="sampled every"):
        damping_spectrum_of(system, 2 * T, frequency / 2)
    with pytest.raises(CouplingError, match="continuous in time"):
        damping_spectrum_of(signal.TransferFunction([1], [1, 1]), T, frequency)


@pytest.mark.parametrize(
    ("mass", "needed"),
    [
        (0.002, (1.5385, 6.6667, np.inf)),
        (0.005, (2.0, 3.3333, 2.0)),
        (0.01, (2.2222, 2.8571, 2.2222)),
        (0.05, (2.4390, 2.5641, 2.4390)),
    ],
)
def test_mass_behind_the_coupling_needs_the_printed_damping(
    mass: float, needed: tuple[float, ...]
) -> None:
    coupling = Coupling(1000, 2, 0, 0)
    found = [environment_minimum_damping(coupling, T, mass, scheme) for scheme in INTEGRATORS]
    assert found == pytest.approx(needed, abs=5e-5)


@given(st.floats(1, 5), st.floats(-2, 2), st.floats(-3, 1), st.sampled_from(INTEGRATORS))
@settings(max_examples=60)
def test_mass_bound_is_the_supremum_of_what_the_device_feels(
    log_k: float, log_b: float, log_m: float, integrator: Integrator
) -> None:
    k, b, mass = 10.0**log_k, 10.0**log_b, 10.0**log_m
    bound = environment_minimum_damping(Coupling(k, b, 0, 0), T, mass, integrator)
    delay = FORCE_DELAY[integrator]
    denominator = [1.0, -2.0, 1.0]
    # F = C (h − x), x = (T²/m) z^{−j} F / (1 − z⁻¹)²; characteristic polynomial in z⁻¹
    loop = np.zeros(5)
    loop[:3] = denominator
    loop[delay] += (k + b / T) * T**2 / mass
    loop[delay + 1] -= b / T * T**2 / mass
    radius = np.abs(np.roots(loop)).max()
    if abs(radius - 1) < 1e-9:
        return
    assert np.isinf(bound) == (radius > 1)
    if np.isinf(bound):
        return

    def needed(theta: np.ndarray) -> np.ndarray:
        z = np.exp(1j * theta)
        transfer = k + b / T * (1 - 1 / z)
        felt = transfer / (1 + transfer * T**2 / mass * z ** (2.0 - delay) / (z - 1) ** 2)
        return np.asarray(T / 2 * np.real((1 - 1 / z) * felt) / (1 - np.cos(theta)))

    resonance = min(2.0, np.sqrt(k / mass) * T)
    near = resonance * np.linspace(0.5, 1.5, 4001)
    theta = np.union1d(THETA, near[near < np.pi])
    # a lightly damped resonance is narrower than any grid: zoom in on its top
    for _ in range(5):
        top = int(needed(theta).argmax())
        low, high = theta[max(top - 1, 0)], theta[min(top + 1, theta.size - 1)]
        theta = np.linspace(low, high, 1001)
    assert needed(theta).max() == pytest.approx(bound, rel=1e-5)


def test_smallest_mass_is_where_the_environment_turns_unstable() -> None:
    k, b = 1000.0, 2.0
    coupling = Coupling(k, b, 0, 0)
    assert minimum_mass(coupling, T) == 0
    assert minimum_mass(coupling, T, "semi_implicit") == pytest.approx(T / 2 * 2.5, rel=1e-12)
    # the least over B, 4 K T², is at B = 2 K T
    assert minimum_mass(coupling, T, "explicit") == pytest.approx(4 * k * T**2, rel=1e-12)
    assert minimum_mass(Coupling(k, k * T, 0, 0), T, "explicit") == np.inf


def test_quantization_has_diolaitis_four_regions() -> None:
    coupling = Coupling(1000, 0, 0, 0)
    regions = {
        (b, friction): quantization_limit(
            SimpleNamespace(damping=b, friction=friction, resolution=1e-4), coupling, T
        ).region
        for b in (0.4, 0.6)
        for friction in (0.04, 0.06)
    }
    assert regions == {
        (0.6, 0.06): "passive",
        (0.4, 0.06): "locally stable",
        (0.6, 0.04): "bounded limit cycle",
        (0.4, 0.04): "unstable",
    }


def test_stiffness_at_the_quantization_limit_needs_just_the_friction_there_is() -> None:
    device = SimpleNamespace(damping=5.0, friction=0.05, resolution=1e-5)
    limit = quantization_limit(device, Coupling(1000, 1.0, 0, 0), T)
    assert limit.stiffness == pytest.approx(min(2 * 4 / T, 2 * (0.05 / 1e-5 - 1 / T)), rel=1e-12)
    rough = SimpleNamespace(damping=5.0, friction=0.05, resolution=4e-5)
    limit = quantization_limit(rough, Coupling(1000, 1.0, 0, 0), T)
    assert limit.limited_by == "friction"
    at_limit = quantization_limit(rough, Coupling(limit.stiffness, 1.0, 0, 0), T)
    assert at_limit.friction_needed == pytest.approx(0.05, rel=1e-12)
    with pytest.raises(CouplingError, match="friction is not known"):
        quantization_limit(
            SimpleNamespace(damping=1.0, friction=None, resolution=0.0), Coupling(1, 0, 0, 0), T
        )


@given(st.integers(1, 5), st.integers(0, 10_000))
def test_matrix_margin_does_not_depend_on_the_axes(size: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    k, damping, b = (generator.uniform(0, high, size) for high in (4e3, 2, 5))
    axes, _ = np.linalg.qr(generator.normal(size=(size, size)))
    first, second, third = (axes @ np.diag(value) @ axes.T for value in (k, damping, b))
    margin = matrix_margin(first, second, third, T, scale=2, force_scale=0.75)
    assert margin == pytest.approx((b - 1.5 * (k * T / 2 + damping)).min(), abs=1e-11)


def test_stability_under_delay_gains_from_the_damper_that_passivity_pays_for() -> None:
    assert coupled_stability_limit(2, T) == pytest.approx(maximum_stiffness(2, T), rel=1e-12)
    assert coupled_stability_limit(2, T, damping=1, delay=1) == pytest.approx(2000, rel=1e-12)


def test_grid_agrees_with_single_couplings() -> None:
    k, b = np.array([[500.0], [2000.0]]), np.array([0.0, 0.5, 3.0])
    grid = CouplingGrid(k, b)
    singles = [[Coupling(float(row[0]), float(column), 0, 0) for column in b] for row in k]
    bounds: tuple[Callable[[Any], Any], ...] = (
        lambda c: minimum_damping(c, T),
        lambda c: minimum_damping(c, T, delay=2, filter_time=1e-3),
        lambda c: minimum_damping(c, T, discretization="tustin"),
        lambda c: environment_minimum_damping(c, T, 0.02, "semi_implicit"),
        lambda c: minimum_mass(c, T, "explicit"),
    )
    for bound in bounds:
        np.testing.assert_allclose(bound(grid), [[bound(c) for c in row] for row in singles])
    assert damping_spectrum(grid, T, np.ones(7)).shape == (2, 3, 7)


@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_what_is_out_of_range_is_refused_in_a_sentence(value: float) -> None:
    coupling = Coupling(1000, 1, 0, 0)
    with pytest.raises(CouplingError, match="filter time is"):
        minimum_damping(coupling, T, filter_time=value)
    with pytest.raises(CouplingError, match="frequency is"):
        damping_spectrum(coupling, T, [100.0, value])
    with pytest.raises(CouplingError, match="mass is"):
        environment_minimum_damping(coupling, T, [0.1, value])
    with pytest.raises(CouplingError, match="coupling stiffness is"):
        CouplingGrid([1.0, value])
    with pytest.raises(CouplingError, match="delay is"):
        coupled_stability_limit(1, T, delay=value)


def test_mis_shaped_and_unknown_arguments_are_refused() -> None:
    coupling = Coupling(1000, 1, 0, 0)
    with pytest.raises(CouplingError, match="do not broadcast"):
        CouplingGrid([1.0, 2.0], [1.0, 2.0, 3.0])
    with pytest.raises(CouplingError, match="whole number of samples"):
        minimum_damping(coupling, T, delay=0.5)  # type: ignore[call-overload]
    with pytest.raises(CouplingError, match="choose one of 'backward', 'tustin'"):
        minimum_damping(coupling, T, discretization="euler")  # type: ignore[call-overload]
    with pytest.raises(
        CouplingError, match="choose one of 'explicit', 'implicit', 'semi_implicit'"
    ):
        minimum_mass(coupling, T, "rk4")  # type: ignore[arg-type]
    with pytest.raises(CouplingError, match="half the sampling rate"):
        damping_spectrum(coupling, T, 4 / T)
    with pytest.raises(CouplingError, match="must be square"):
        matrix_margin(np.ones(3), 0, 0, T)
    with pytest.raises(CouplingError, match="not symmetric"):
        matrix_margin([[1, 2], [0, 1]], np.eye(2), np.eye(2), T)
    with pytest.raises(CouplingError, match="sizes"):
        matrix_margin(np.eye(3), np.eye(2), np.eye(2), T)


@pytest.mark.parametrize(
    ("b", "friction", "region"),
    [
        (0.5, 0.06, "locally stable"),  # β = ½ is not above it
        (0.6, 0.05, "bounded limit cycle"),  # nor is σ = ½
        (0.5, 0.05, "unstable"),
    ],
)
def test_edges_of_diolaitis_regions_belong_to_what_promises_less(
    b: float, friction: float, region: str
) -> None:
    device = SimpleNamespace(damping=b, friction=friction, resolution=1e-4)
    limit = quantization_limit(device, Coupling(1000, 0, 0, 0), T)
    assert limit.region == region
    assert (limit.beta == 0.5) == (b == 0.5)
    assert (limit.sigma == 0.5) == (friction == 0.05)


def test_exact_positions_leave_only_the_damping_to_limit() -> None:
    device = SimpleNamespace(damping=1.0, friction=0.0, resolution=0.0)
    limit = quantization_limit(device, Coupling(1000, 2.0, 0, 0), T)
    assert limit.limited_by == "damping"
    assert limit.stiffness == 0  # the damper alone is too much
    assert limit.sigma == np.inf
    assert limit.friction_needed == 0


def test_fields_of_a_grid_are_its_own_and_cannot_be_written() -> None:
    stiffness = np.array([1.0, 2.0])
    grid = CouplingGrid(stiffness, 1.0)
    stiffness[0] = 7.0
    for field in (grid.stiffness, grid.damping, grid.rotational_stiffness):
        array = np.asarray(field)
        assert not array.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 3.0
    assert np.asarray(grid.stiffness)[0] == 1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"stiffness": -np.eye(2)}, "stiffness has the eigenvalue -1; all must be >= 0"),
        ({"damping": [[1, 2], [2, 1]]}, "damping has the eigenvalue -1"),
        ({"stiffness": [[np.nan, 0], [0, 1]]}, "stiffness is nan"),
        ({"device_damping": [[1, 2], [3]]}, "device damping is .* must be numbers"),
        ({"device_damping": np.zeros((0, 0))}, "device damping is an empty array"),
        ({"stiffness": np.ones((2, 1, 1)), "damping": np.ones((3, 1, 1))}, "do not broadcast"),
        ({"scale": 0.0}, "scale is 0"),
        ({"force_scale": -1.0}, "force scale is -1"),
        ({"period": 0.0}, "period is 0"),
    ],
)
def test_matrices_without_meaning_are_refused(arguments: dict[str, Any], sentence: str) -> None:
    valid: dict[str, Any] = dict.fromkeys(("stiffness", "damping", "device_damping"), np.eye(2))
    valid["period"] = T
    if "stiffness" in arguments and "damping" in arguments:
        valid["device_damping"] = 1.0
    with pytest.raises(CouplingError, match=sentence):
        matrix_margin(**(valid | arguments))


def test_a_late_force_without_damper_is_no_stable_environment_whatever_the_mass() -> None:
    undamped = Coupling(1000, 0, 0, 0)
    late = environment_minimum_damping(undamped, T, [0.05, 1, 1e6], "semi_implicit")
    np.testing.assert_array_equal(late, np.inf)
    assert np.isfinite(environment_minimum_damping(undamped, T, 0.05, "implicit"))


def test_stiffness_inertia_and_damper_a_hundred_orders_apart_are_refused() -> None:
    grid = CouplingGrid([1e-30, 1000], [1e30, 1])
    with pytest.raises(CouplingError, match="too far apart for double precision"):
        environment_minimum_damping(grid, 1e-30, 1e30)
