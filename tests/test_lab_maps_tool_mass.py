"""Claims of the map ``tool_mass``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from map_runs import boundary_of

from hapticbridge.coupling import Coupling
from hapticbridge.errors import StudyError
from hapticbridge.lab.maps import tool_mass
from hapticbridge.lab.maps.base import PERIOD, Point
from hapticbridge.theory.sampled_loop import SampledLoop
from hapticbridge.theory.virtual_mass import Integrator, environment_minimum_damping, minimum_mass

TWINS: dict[str, Integrator] = {"implicit": "implicit", "explicit": "semi_implicit"}


@pytest.mark.parametrize("method", TWINS)
def test_the_theory_here_is_that_of_the_passivity_package(method: str) -> None:
    coupling, angle = Coupling(1000.0, 2.0, 0.0, 0.0), np.array([0.1, 1.0, 3.0])
    assert tool_mass.min_mass(method, 1000.0, 2.0, 1e-3) == minimum_mass(
        coupling, 1e-3, TWINS[method]
    )
    for mass in (0.005, 0.05):
        other = SampledLoop(coupling, 1e-3, mass=mass, integrator=TWINS[method])
        mine = tool_mass.effective_response(method, 1000.0, 2.0, mass, 1e-3, angle)
        np.testing.assert_allclose(mine, other.response(angle / 1e-3), rtol=1e-12)
        needed = environment_minimum_damping(coupling, 1e-3, mass, TWINS[method])
        assert tool_mass.worst_angle(method, 1000.0, 2.0, mass, 1e-3)[1] == pytest.approx(
            needed, rel=1e-6
        )


@pytest.mark.parametrize(
    ("method", "stiffness"),
    [("implicitfast", 40_000.0), ("explicit", 9000.0), ("explicit:rk4", 9000.0)],
)
def test_behind_a_handle_held_still_a_method_fails_where_theory_says(
    method: str, stiffness: float
) -> None:
    least = tool_mass.min_mass(method, stiffness, tool_mass.DAMPING, PERIOD)
    failed = tool_mass.held_still(method, stiffness, 0.97 * least)
    assert not failed.is_stable
    assert failed.environment == "active"  # the ledger's port: what lies behind the coupling
    assert failed.first_active >= 0
    assert tool_mass.held_still(method, stiffness, 1.03 * least).is_stable
    twin = tool_mass.held_still("implicit", stiffness, 0.97 * least)
    assert twin.is_stable
    assert twin.environment == "strict"


@pytest.mark.parametrize(
    ("method", "stiffness"), [("explicit", 20_000.0), ("implicitfast", 15_000.0)]
)
def test_the_worst_hand_turns_a_light_tool_unstable_where_theory_says(
    method: str, stiffness: float
) -> None:
    limit = float(tool_mass.predicted_limit(method, stiffness, is_held=False)["limit"])
    assert not tool_mass.worst_hand(method, stiffness, 0.9 * limit).is_stable
    assert tool_mass.worst_hand(method, stiffness, 1.1 * limit).is_stable
    assert tool_mass.worst_hand("implicit", stiffness, 0.9 * limit).is_stable


def test_implicit_fails_at_no_mass() -> None:
    for mass in (1e-3, 0.1, 10.0):
        outcome = tool_mass.evaluate(
            {"what": "cell", "method": "implicit", "stiffness": 25_000.0, "mass": mass}
        )
        assert outcome["stable_held_still"] is True
        assert outcome["stable_worst_hand"] is True
        assert outcome["environment"] == "strict"


@pytest.mark.parametrize("method", ["compensated", "lossless"])
def test_without_the_lag_no_mass_fails_up_to_twice_b_over_t(method: str) -> None:
    limit = 2 * tool_mass.DEVICE_DAMPING / PERIOD
    assert tool_mass.held_still(method, 0.98 * limit, 1e-3).is_stable
    for mass in (2e-3, 5.0):
        assert tool_mass.worst_hand(method, 0.98 * limit, mass).is_stable
    assert not tool_mass.worst_hand(method, 1.02 * limit, 5.0).is_stable
    # the twin that keeps its lag bears a quarter less
    assert not tool_mass.worst_hand("implicit", 0.98 * limit, 5.0).is_stable


def test_a_light_tool_is_no_help_to_the_lossless_coupling() -> None:
    limit = 2 * tool_mass.DEVICE_DAMPING / PERIOD
    assert not tool_mass.worst_hand("lossless", 1.02 * limit, 2e-3).is_stable
    assert tool_mass.worst_hand("compensated", 1.02 * limit, 2e-3).is_stable


def test_a_heavy_tool_on_a_soft_coupling_decays() -> None:
    # it swings twice a second: a fifth of 2 s holds less than a swing, and would show growth
    assert tool_mass.held_still("explicit", 2000.0, 10.0).is_stable


def test_implicitfast_uses_up_the_slack_where_the_spring_outweighs_the_damper() -> None:
    # E_k is K δx² and the slack ½ (K + B/T) δx², whatever the mass
    for stiffness, verdict in ((4000.0, "within slack"), (6000.0, "active")):
        share = 2 * stiffness / (stiffness + tool_mass.DAMPING / PERIOD)
        point: Point = {"what": "cell", "method": "implicitfast"}
        point |= {"stiffness": stiffness, "mass": 0.01}
        outcome = tool_mass.evaluate(point)
        assert outcome["environment"] == verdict
        assert (float(outcome["first_active"]) >= 0) is (verdict == "active")
        assert outcome["slack_share"] == pytest.approx(share, rel=0.02)


def test_where_no_mass_is_stable_theory_has_no_limit() -> None:
    nowhere = tool_mass.predicted_limit("explicit", 40_000.0, is_held=False)
    assert (nowhere["stable_if_light"], nowhere["stable_if_heavy"]) == (False, False)
    assert np.isnan(nowhere["limit"])


def is_kept(point: Point) -> bool:
    """Keeps the grid of two methods, and a search behind a handle held still."""
    if point["what"] == "cell":
        return point["method"] in ("implicit", "explicit")
    return (point["what"], point["method"]) == ("held still", "explicit")


def test_the_map_says_what_its_table_holds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tool_mass, "CONTOUR", 7)  # the picture is not looked at
    boundary = boundary_of(tool_mass, tmp_path, 16, is_kept)
    methods = boundary["methods"]
    assert methods["implicit"]["unstable_held_still"] == 0
    assert methods["explicit"]["unstable_held_still"] > 0


def test_a_method_without_theory_is_refused() -> None:
    with pytest.raises(StudyError, match="no theory for method 'weld'"):
        tool_mass.min_mass("weld", 1000.0, 1.0, 1e-3)
