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
    lossless, compensated, asked, half, low_pass, tustin, wall, anywhere, line = alternatives(
        Coupling(stiffness, damping, 0, 0), T, 2 * T
    )
    a = stiffness * T / 2
    assert asked.needed == pytest.approx(a + damping, rel=1e-12)
    assert half.needed == pytest.approx(a / 2 + damping, rel=1e-12)
    assert low_pass.needed == pytest.approx(a + damping / 5, rel=1e-12)
    assert tustin.needed == np.inf
    # at every frequency, written out by eq. (2) with the force on the device a tick late
    theta = np.linspace(1e-3, np.pi, 20_000)
    beta = damping / T
    late = T * np.sin(theta) ** 2 / (stiffness / 2 + beta)
    late *= beta**2 + stiffness * beta + (stiffness / 2 / np.sin(theta / 2)) ** 2
    assert anywhere.needed == pytest.approx(max(late.max(), a + damping), rel=1e-4)
    assert line.needed == pytest.approx(2 * a, rel=1e-12)
    assert compensated.needed == pytest.approx(max(damping - a, a), rel=1e-12)
    assert lossless.needed == pytest.approx(max(damping, a), rel=1e-12)
    if a < 2 * damping:
        assert wall.needed == pytest.approx(a + a**2 / (2 * damping) + damping, rel=1e-9)
    else:
        assert wall.needed == pytest.approx(3 * a - damping, rel=1e-9)


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
