"""Pictures of the theory, and the table of alternatives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hapticbridge.coupling import Coupling
from hapticbridge.demand.plots import alternatives

T = 1e-3


@given(st.floats(1, 1e5), st.floats(1e-3, 50))
@settings(max_examples=30)
def test_alternatives_follow_their_closed_forms(stiffness: float, damping: float) -> None:
    needed = {
        way.name.partition(":")[0]: way.needed
        for way in alternatives(Coupling(stiffness, damping, 0, 0), T, 2 * T)
    }
    a = stiffness * T / 2
    assert next(iter(needed)) == "lossless"
    assert needed.pop("lossless") == pytest.approx(max(damping, a), rel=1e-12)
    assert needed.pop("compensated") == pytest.approx(max(damping - a, a), rel=1e-12)
    assert needed.pop("implicit") == pytest.approx(a + damping, rel=1e-12)
    half = needed.pop("B_law = B at half the period")
    assert half == pytest.approx(a / 2 + damping, rel=1e-12)
    low_pass = needed.pop("B_law = B, low-pass of 2 ms on it")
    assert low_pass == pytest.approx(a + damping / 5, rel=1e-12)
    assert needed.pop("B_law = B, Tustin's damper") == np.inf
    # at every frequency, written out by eq. (2) with the force on the device a tick late
    theta = np.linspace(1e-3, np.pi, 20_000)
    beta = damping / T
    late = T * np.sin(theta) ** 2 / (stiffness / 2 + beta)
    late *= beta**2 + stiffness * beta + (stiffness / 2 / np.sin(theta / 2)) ** 2
    anywhere = needed.pop("B_law = B, one tick late")
    assert anywhere == pytest.approx(late.max(), rel=1e-4)
    line = needed.pop("transmission line of that stiffness")
    assert line == pytest.approx(2 * a, rel=1e-12)


def test_each_spectrum_reaches_what_its_alternative_needs() -> None:
    for way in alternatives(Coupling(2000, 1, 0, 0), T, T):
        if way.spectrum is None:
            assert way.frequency is None
            continue
        frequency, needed = way.spectrum
        assert needed.max() == pytest.approx(way.needed, rel=1e-3)
        if way.frequency is not None:
            nearest = frequency[np.nanargmax(needed)]
            assert nearest == pytest.approx(way.frequency, rel=2e-2)
