"""Z-width, its lines and its corner, against other routes and printed numbers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import default_coupling
from hapticbridge.demand.methods import default_method
from hapticbridge.device import open_device
from hapticbridge.errors import CouplingError
from hapticbridge.theory.bounds import minimum_damping, worst_frequency
from hapticbridge.theory.transfer import CouplingGrid
from hapticbridge.theory.z_width import (
    ANY_HAND,
    NO_LIMIT_CYCLES,
    WITHOUT_HAND,
    free_device_damping,
    free_device_stiffness,
    z_width,
)

T = 1e-3


def growth(
    b: float, mass: float, stiffness: float, damping: float, delay: int, tau: float
) -> float:
    """Returns the largest |eigenvalue| of a period of the free device, from its own recursion."""
    rates = np.array([[0.0, 1.0, 0.0], [0.0, -b / mass, 1 / mass], [0.0, 0.0, 0.0]])
    (_, a, p), (_, e, g) = expm(rates * T)[:2]

    def step(state: np.ndarray) -> list[float]:
        h, v, last, filtered, *waiting = state
        filtered = (tau * filtered + h - last) / (T + tau)
        force, *waiting = [*waiting, -stiffness * h - damping * filtered]
        return [h + a * v + p * force, e * v + g * force, h, filtered, *waiting]

    period = np.column_stack([step(row) for row in np.eye(4 + delay)])
    return float(np.abs(np.linalg.eigvals(period)).max())


FREE = [(2, 0.1, 0, 0, 0.0), (5, 0.3, 2, 1, 0.0), (1, 0.05, 0.5, 4, 0.0), (5, 0.1, 6, 1, 2e-3)]


@pytest.mark.parametrize(("b", "mass", "damping", "delay", "tau"), FREE)
def test_free_boundary_is_exact(
    b: float, mass: float, damping: float, delay: int, tau: float
) -> None:
    limit = free_device_stiffness(b, T, mass, damping, delay=delay, filter_time=tau)
    assert isinstance(limit, float)
    below, above = (
        growth(b, mass, share * limit, damping, delay, tau) for share in (1 - 1e-6, 1 + 1e-6)
    )
    assert below < 1 < above


@pytest.mark.parametrize(("delay", "tau"), [(0, 0.0), (2, 0.0), (1, 2e-3)])
def test_too_much_coupling_damping_leaves_no_stiffness(delay: int, tau: float) -> None:
    most = free_device_damping(2, T, 0.1, delay=delay, filter_time=tau)
    assert isinstance(most, float)
    shares = np.array([0.99, 1.01]) * most
    low, high = np.asarray(free_device_stiffness(2, T, 0.1, shares, delay=delay, filter_time=tau))
    assert low > 0
    assert high == 0
    below, above = (growth(2, 0.1, 1.0, share, delay, tau) for share in shares)
    assert below < 1 < above


@given(st.floats(0.1, 20), st.floats(0, 20), st.floats(0.02, 2), st.integers(0, 2))
@settings(max_examples=20)
def test_passive_is_stable_without_hand(b: float, damping: float, mass: float, delay: int) -> None:
    z = z_width(b, T, mass=mass, delay=delay, points=5)
    free = next(line for line in z.lines if line.name == WITHOUT_HAND)
    first = z.lines[0]
    assert (free.stiffness >= first.stiffness * (1 - 1e-7)).all()
    assert free.largest_damping >= first.largest_damping


def test_limits_of_a_free_device_are_the_printed_ones() -> None:
    limits = free_device_stiffness(np.array([0.5, 1, 2, 5, 10, 20]), T, 0.1)
    assert limits == pytest.approx([1001, 2003, 4013, 10084, 20339, 41378], abs=0.5)
    assert free_device_stiffness(0, T, 0.1) == 0
    # its own damper takes the place of the device's: K = 2 B/T less what the lag costs
    assert 0 < float(np.asarray(free_device_stiffness(0, T, 0.1, 1.0))) < 2 / T


def test_heavy_device_reaches_the_bound_of_the_worst_hand() -> None:
    masses = np.array([0.1, 1, 10, 100])
    found = np.asarray(free_device_stiffness(2, T, masses))
    # 4000 (1 + b T/(6 m)) to first order
    np.testing.assert_allclose(found, 4000 * (1 + 2 * T / 6 / masses), rtol=2e-5)
    assert found.shape == (4,)


@given(st.floats(0.1, 50), st.floats(1e-4, 1e-2), st.floats(0, 1e-2))
def test_without_delay_the_line_meets_the_device(b: float, period: float, tau: float) -> None:
    z = z_width(b, period, filter_time=tau, points=11)
    inside = z.limit > 0
    pairs = CouplingGrid(z.limit[inside], z.damping[inside])
    needed = np.asarray(minimum_damping(pairs, period, filter_time=tau))
    np.testing.assert_allclose(needed, b, rtol=1e-9)
    assert z.limit[0] == pytest.approx(2 * b / period, rel=1e-12)
    assert z.lines[0].largest_damping == pytest.approx(b * (1 + 2 * tau / period), rel=1e-12)


@given(st.floats(0.1, 50), st.integers(1, 4), st.sampled_from([0.0, 1e-3]))
@settings(max_examples=15)
def test_with_delay_the_line_meets_the_device(b: float, delay: int, tau: float) -> None:
    z = z_width(b, T, delay=delay, filter_time=tau, points=7)
    inside = z.limit > 0
    pairs = CouplingGrid(z.limit[inside], z.damping[inside])
    needed = np.asarray(minimum_damping(pairs, T, delay=delay, filter_time=tau))
    np.testing.assert_allclose(needed, b, rtol=1e-9)
    assert z.limit[0] == pytest.approx(2 * b / (T * (delay + 1) ** 2), rel=1e-6)
    assert z.limit[-1] == 0
    assert set(z.limited_by) == {ANY_HAND}
    assert z.notes == ()


OUT_OF_RANGE: list[tuple[Callable[[Any], Any], str]] = [
    (lambda v: z_width(2, T, mass=v), "mass is"),
    (lambda v: z_width(2, T, friction=v), "friction is"),
    (lambda v: z_width(2, T, resolution=v), "resolution is"),
    (lambda v: z_width(2, T, filter_time=v), "filter time is"),
    (lambda v: z_width(v, T), "device damping is"),
    (lambda v: z_width(2, v), "period is"),
    (lambda v: free_device_stiffness(2, T, v), "mass is"),
    (lambda v: free_device_stiffness(2, T, 0.1, v), "coupling damping is"),
    (lambda v: free_device_damping(2, T, v), "mass is"),
]
REFUSED: list[tuple[Callable[[], Any], str]] = [
    *((partial(call, bad), words) for call, words in OUT_OF_RANGE for bad in (-1, np.nan, np.inf)),
    (lambda: free_device_stiffness([1.0, 2.0], T, [1.0, 2.0, 3.0]), "do not broadcast"),
    *((partial(z_width, 2, T, points=n), "points is") for n in (1, True, 10**9)),
    (lambda: z_width([1.0, 2.0], T), "must be one number"),  # type: ignore[arg-type]
    (lambda: z_width(2, T, delay=0.5), "delay is"),  # type: ignore[arg-type]
]


@pytest.mark.parametrize(("call", "words"), REFUSED)
def test_what_has_no_meaning_is_refused(call: Callable[[], Any], words: str) -> None:
    with pytest.raises(CouplingError, match=words):
        call()


@given(st.floats(0.1, 50), st.floats(100, 20_000))
def test_doubling_the_rate_doubles_the_stiffness_but_not_the_damping(b: float, rate: float) -> None:
    slow, fast = (z_width(b, 1 / r, points=5) for r in (rate, 2 * rate))
    np.testing.assert_allclose(fast.limit, 2 * slow.limit, rtol=1e-12)
    np.testing.assert_allclose(fast.damping, slow.damping, rtol=1e-12)


@given(st.floats(0.1, 20), st.floats(0.02, 2))
def test_corner_is_the_default_coupling_where_only_damping_limits(b: float, mass: float) -> None:
    felt = default_coupling(open_device(f"simulated:damping={b!r}").info, T)
    default = default_method().law_coupling(felt, T)
    assert default_method().requested_coupling(default, T).damping == pytest.approx(
        felt.damping
    )  # unclipped
    z = z_width(b, T, mass=mass, friction=1e3, resolution=1e-6)
    assert z.corner.stiffness == pytest.approx(default.stiffness, rel=1e-12)
    assert z.corner.damping == pytest.approx(default.damping, rel=1e-12)
    assert z.corner_limited_by == ANY_HAND


@given(st.floats(0.1, 20), st.integers(0, 3), st.sampled_from([0.0, 5e-4]))
@settings(max_examples=15)
def test_corner_lies_inside_the_region(b: float, delay: int, tau: float) -> None:
    z = z_width(
        b, T, mass=0.1, friction=0.02, resolution=1e-5, delay=delay, filter_time=tau, points=5
    )
    assert minimum_damping(z.corner, T, delay=delay, filter_time=tau) < b
    friction = next(line for line in z.lines if line.name == NO_LIMIT_CYCLES)
    needed = z.corner.stiffness * 1e-5 / 2 + z.corner.damping * 1e-5 / T
    assert friction.is_required  # f_c T/Δ = 2 N s/m is a tenth of 20
    assert needed < 0.02


def test_low_friction_moves_the_corner_along_its_own_line() -> None:
    # f_c T/Δ = 0.5 N s/m takes the place of b = 2 N s/m
    z = z_width(2, T, friction=0.05, resolution=1e-4)
    assert z.corner.damping == pytest.approx(0.125, rel=1e-12)
    assert z.corner.stiffness == pytest.approx(0.8 * 2 * 0.375 / T, rel=1e-12)
    assert z.corner_limited_by == NO_LIMIT_CYCLES
    assert set(z.limited_by) == {NO_LIMIT_CYCLES}
    assert z.notes == ()


@pytest.mark.parametrize("friction", [0.0, 1e-4])
def test_without_friction_worth_name_limit_cycles_are_told_not_forbidden(friction: float) -> None:
    z = z_width(2, T, friction=friction, resolution=1e-5)
    assert z.corner.stiffness == pytest.approx(2400, rel=1e-12)
    (line,) = (line for line in z.lines if line.name == NO_LIMIT_CYCLES)
    assert not line.is_required
    assert line.stiffness[0] == pytest.approx(2 * friction / 1e-5, rel=1e-12)
    (note,) = z.notes
    assert "too low" in note
    assert "bounded" in note


def test_unknown_friction_is_said_to_be_unknown() -> None:
    z = z_width(2, T, resolution=1e-5)
    assert [line.name for line in z.lines] == [ANY_HAND]
    assert "friction is not known" in z.notes[0]
    assert z_width(2, T, friction=0.1).notes == ()


def test_worst_frequency_of_known_cases() -> None:
    nyquist = np.pi / T
    assert worst_frequency(Coupling(1000, 2, 0, 0), T) == nyquist
    assert worst_frequency(Coupling(1000, 2, 0, 0), T, discretization="tustin") == nyquist
    assert worst_frequency(Coupling(1000, 0, 0, 0), T, delay=3) == 0.0
    damper = Coupling(1e-3, 2, 0, 0)
    assert worst_frequency(damper, T, delay=1) * T == pytest.approx(np.pi / 2, rel=1e-5)
    # with one tick of delay cos θ = K²/(y² − K²), y = K + 2B/T
    worst = worst_frequency(CouplingGrid(1000, [0.1, 1.0, 2.0]), T, delay=1)
    np.testing.assert_allclose(np.cos(worst * T), [1, 1 / 8, 1 / 24], atol=1e-6)


@pytest.mark.parametrize("mass", [1e3, 1e6, 1e9, 1e15])
def test_no_rounding_puts_the_line_of_a_heavy_device_below_the_passive_one(mass: float) -> None:
    z = z_width(2, T, mass=mass)
    passive, free = z.lines
    assert (free.stiffness >= passive.stiffness).all()
    assert free.largest_damping >= passive.largest_damping
    assert z.corner.stiffness == pytest.approx(2400, rel=1e-12)
    assert z.corner_limited_by == ANY_HAND


def test_friction_counts_as_a_limit_from_a_tenth_of_the_damping_on() -> None:
    # f_c T/Δ = 0.2 N s/m is a tenth of b = 2 N s/m
    enough, little = (z_width(2, T, friction=f, resolution=1e-5) for f in (2.001e-3, 1.999e-3))
    assert [line.is_required for line in enough.lines] == [True, True]
    assert [line.is_required for line in little.lines] == [True, False]
    assert enough.notes == ()
