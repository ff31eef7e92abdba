"""Chart of rebounds: e asked and rendered, and the energy that Newton's rule would create."""

from __future__ import annotations

import numpy as np
import pytest

from hapticbridge.kernel.restitution import MAX_RESTITUTION
from hapticbridge.lab.rebounds import BLOWS, by_newton, damping_of, draw, rendered

UPRIGHT, SLIDING = BLOWS


@pytest.mark.parametrize("e", [0.3, 0.6, 0.9])
def test_a_central_blow_has_the_e_that_was_asked_for_and_newtons_energy(e: float) -> None:
    had, created = rendered(UPRIGHT, e)
    assert had == pytest.approx(e, abs=0.01)
    assert created == pytest.approx(by_newton(UPRIGHT, e), abs=0.01)
    assert created == pytest.approx(-0.5 * (1 - e**2), abs=0.01)


def test_where_newtons_rule_creates_energy_the_rebound_is_poissons() -> None:
    had, created = rendered(SLIDING, 0.9)
    assert by_newton(SLIDING, 0.9) == pytest.approx(0.0406, abs=1e-3)
    assert created == pytest.approx(-0.1441, abs=2e-3)
    assert had == pytest.approx(0.468, abs=5e-3)


def test_a_small_e_does_not_bounce() -> None:
    had, _ = rendered(UPRIGHT, 0.15)
    assert abs(had) < 0.01


def test_damping_of_an_e() -> None:
    assert damping_of(MAX_RESTITUTION) < damping_of(0.5) < 1.0 < damping_of(0.1)


def test_the_chart_has_both_energies_of_every_blow() -> None:
    rebound, energy = draw().axes
    assert len(rebound.lines) == len(BLOWS) + 2
    assert len(energy.lines) == 2 * len(BLOWS) + 1
    ours, newton = (np.asarray(line.get_ydata(), np.float64) for line in energy.lines[2:4])
    assert ours.max() <= 0.0 < newton.max()
