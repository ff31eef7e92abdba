"""The bounds between a coupling, the period and a device's damping (closed forms)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError
from hapticbridge.theory.bounds import maximum_stiffness, minimum_damping, stiffest_coupling

T = 1e-3
positive = st.floats(1e-6, 1e6)


@pytest.mark.parametrize(
    ("damping", "stiffness"),
    [(0.5, 1000.0), (1, 2000), (2, 4000), (5, 10000), (10, 20000), (20, 40000)],
)
def test_largest_stiffness_at_one_kilohertz_is_2000_newton_per_metre_per_unit_of_damping(
    damping: float, stiffness: float
) -> None:
    assert maximum_stiffness(damping, T) == pytest.approx(stiffness, rel=1e-15)


def test_default_coupling_of_the_default_device() -> None:
    coupling = stiffest_coupling(2.0, 2e-3, T)
    assert coupling.stiffness == pytest.approx(2400, rel=1e-15)
    assert coupling.damping == pytest.approx(0.5, rel=1e-15)
    assert coupling.rotational_stiffness == pytest.approx(2.4, rel=1e-15)
    assert coupling.rotational_damping == pytest.approx(5e-4, rel=1e-15)


@given(st.floats(1, 1e5), st.floats(0, 100), st.floats(1e-4, 1e-2))
def test_bound_is_the_supremum_of_the_condition_over_frequency(
    stiffness: float, damping: float, period: float
) -> None:
    """b > (T/2)(1 − cos θ)/Re{(1 − e^{−jθ})/C}, C = K + (B/T)(1 − e^{−jθ}), over 0 < θ <= π."""
    theta = np.linspace(1e-3, np.pi, 2000)
    backward = 1 - np.exp(-1j * theta)
    transfer = stiffness + damping / period * backward
    needed = period / 2 * (1 - np.cos(theta)) / np.real(backward / transfer)
    bound = minimum_damping(Coupling(stiffness, damping, 0, 0), period)
    # the supremum is attained at Nyquist, the grid's last point; 1e-9 for cancellation at small θ
    assert needed.max() == pytest.approx(bound, rel=1e-9)
    assert needed[-1] == pytest.approx(bound, rel=1e-9)


@given(positive, st.floats(0, 0.999), st.floats(1e-5, 1))
def test_largest_stiffness_needs_exactly_the_damping_it_was_asked_for(
    device_damping: float, share: float, period: float
) -> None:
    damping = share * device_damping
    stiffness = maximum_stiffness(device_damping, period, damping)
    coupling = Coupling(stiffness, damping, stiffness, damping)
    for axis in ("translation", "rotation"):
        needed = minimum_damping(coupling, period, axis=axis)
        assert needed == pytest.approx(device_damping, rel=1e-12)


@given(positive, positive, st.floats(1e-5, 1))
def test_default_coupling_leaves_a_fifth_of_the_stiffness_unused(
    damping: float, rotational_damping: float, period: float
) -> None:
    coupling = stiffest_coupling(damping, rotational_damping, period)
    # K T/2 + B = 0.8 · (3/4) b + b/4 = 0.85 b
    assert minimum_damping(coupling, period) == pytest.approx(0.85 * damping, rel=1e-12)
    assert minimum_damping(coupling, period, axis="rotation") == pytest.approx(
        0.85 * rotational_damping, rel=1e-12
    )


def test_axes_do_not_mix() -> None:
    coupling = Coupling(1000, 1, 3, 0.25)
    assert minimum_damping(coupling, T) == pytest.approx(1.5, rel=1e-15)
    assert minimum_damping(coupling, T, axis="rotation") == pytest.approx(0.2515, rel=1e-15)


def test_doubling_the_rate_doubles_the_stiffness_but_not_the_damping() -> None:
    assert maximum_stiffness(2, T / 2) == 2 * maximum_stiffness(2, T)
    with pytest.raises(CouplingError, match="no stiffness is passive"):
        maximum_stiffness(2, T / 2, damping=2)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_what_is_not_finite_and_positive_is_refused_by_name(value: float) -> None:
    with pytest.raises(CouplingError, match="period is"):
        minimum_damping(Coupling(1, 0, 0, 0), value)
    with pytest.raises(CouplingError, match="period is"):
        maximum_stiffness(1, value)
    with pytest.raises(CouplingError, match="device damping is"):
        maximum_stiffness(value, T)
    with pytest.raises(CouplingError, match="device damping is"):
        stiffest_coupling(value, 1, T)
    with pytest.raises(CouplingError, match="device damping is"):
        stiffest_coupling(1, value, T)


@pytest.mark.parametrize("value", [-1e-9, float("nan"), float("inf")])
def test_coupling_damping_out_of_range_is_refused(value: float) -> None:
    with pytest.raises(CouplingError, match="coupling damping is"):
        maximum_stiffness(1, T, damping=value)


def test_unknown_axis_is_refused_with_the_choices() -> None:
    with pytest.raises(CouplingError, match="choose one of 'rotation', 'translation'"):
        minimum_damping(Coupling(1, 0, 0, 0), T, axis="x")  # type: ignore[call-overload]
