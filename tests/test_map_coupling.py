"""The map of K against B: the bounds are where loops fail, and the verdicts name what failed."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from map_runs import NEVER, recorded_and_audited
from map_tables import Row, written

from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.lab.maps import run_map
from hapticbridge.lab.maps.base import (
    Point,
    free_tool_and_wall,
    limit_by_6,
    needed_by_6,
    used_damping,
)
from hapticbridge.lab.maps.coupling import (
    COUPLING,
    DEVICE_DAMPING,
    PATH,
    PERIOD,
    THEORIES,
    TOOL_MASS,
    evaluate,
    points,
)
from hapticbridge.lab.methods import METHODS
from hapticbridge.theory.bounds import maximum_stiffness, minimum_damping
from hapticbridge.theory.virtual_mass import environment_minimum_damping


def cell(method: str, stiffness: float, damping: float) -> Point:
    return {"what": "cell", "method": method, "stiffness": stiffness, "damping": damping}


@pytest.mark.parametrize("damping", [0.0, 0.5, 1.5])
def test_worst_hand_on_a_wall_finds_the_bound_within_a_percent(damping: float) -> None:
    found = evaluate({"what": "limit", "method": "implicit", "stiffness": 0.0, "damping": damping})
    assert found["limit"] == pytest.approx(
        maximum_stiffness(DEVICE_DAMPING, PERIOD, damping), rel=0.01
    )


@pytest.mark.parametrize("method", ["implicit", "compensated", "lossless", "explicit"])
def test_the_bound_of_a_method_is_that_of_the_coupling_it_uses(method: str) -> None:
    for k in (500.0, 1500.0, 6000.0):
        used = METHODS[method].used(Coupling(k, 1.2, 1.0, 0.0), PERIOD)
        assert used_damping(method, k, 1.2, PERIOD) == pytest.approx(used.damping)
        assert needed_by_6(method, k, 1.2, PERIOD) == pytest.approx(minimum_damping(used, PERIOD))
    limit = limit_by_6(method, DEVICE_DAMPING, PERIOD, 1.2)
    assert needed_by_6(method, limit, 1.2, PERIOD) == pytest.approx(DEVICE_DAMPING)


@pytest.mark.parametrize("method", ["compensated", "lossless"])
def test_what_takes_its_lag_off_is_stable_on_a_wall_beyond_the_bound_of_implicit(
    method: str,
) -> None:
    point: Point = {"what": "limit", "method": method, "stiffness": 0.0, "damping": 1.2}
    assert evaluate(point)["limit"] == pytest.approx(2 * DEVICE_DAMPING / PERIOD, rel=0.01)


def test_coupling_that_the_device_cannot_bear_is_unstable_though_the_scene_is_passive() -> None:
    limit = float(maximum_stiffness(DEVICE_DAMPING, PERIOD, 0.5))
    below = evaluate(cell("implicit", 0.95 * limit, 0.5))
    above = evaluate(cell("implicit", 1.05 * limit, 0.5))
    assert below["stable_on_wall"]
    assert below["stable_free"]
    assert below["environment"] == "strict"
    assert not above["stable_on_wall"]
    assert above["environment"] == "strict"


def test_explicit_free_tool_fails_where_its_own_bound_says_and_implicit_does_not() -> None:
    # an undamped coupling: no device damping saves the explicit scheme, whatever the mass
    stiffness = 1500.0
    needed = environment_minimum_damping(
        Coupling(stiffness, 0.0, 1.0, 0.0), PERIOD, TOOL_MASS, "semi_implicit"
    )
    assert needed > DEVICE_DAMPING
    explicit = evaluate(cell("explicit", stiffness, 0.0))
    implicit = evaluate(cell("implicit", stiffness, 0.0))
    assert explicit["stable_on_wall"]
    assert not explicit["stable_free"]
    assert implicit["stable_free"]


def test_position_explicit_coupling_is_named_active_below_the_bound() -> None:
    found = evaluate(cell("implicitfast", 1500.0, 0.6))
    assert found["environment"] == "active"
    assert float(found["slack_share"]) > 1
    assert float(found["created"]) > 0
    assert evaluate(cell("implicit", 1500.0, 0.6))["created"] == 0.0


def test_weld_is_judged_by_its_device_port_and_has_no_wall_without_contact() -> None:
    # on a wall the hand is given what neither the scene gave up nor the damping burns
    found = evaluate(cell("weld", 1500.0, 0.6))
    assert "stable_on_wall" not in found
    assert found["fault_port"] == "device"
    assert 0 < int(found["fault_tick"]) < 2000
    assert found["stable_tapping"] is False
    twin = evaluate(cell("implicit", 1500.0, 0.6))
    assert (twin["fault_tick"], twin["fault_port"]) == (-1, "")
    assert twin["stable_tapping"] is True


def test_explicit_stays_within_its_slack_where_implicitfast_is_at_fault() -> None:
    explicit = evaluate(cell("explicit", 1500.0, 0.6))
    assert explicit["environment"] == "within slack"
    assert explicit["fault_tick"] == -1
    fast = evaluate(cell("implicitfast", 1500.0, 0.6))
    assert fast["fault_port"] == "environment"
    assert fast["fault_tick"] == 25


@pytest.mark.parametrize(
    ("method", "share", "port"),
    [
        ("implicitfast", 1.03, "environment"),
        ("implicitfast", 0.97, ""),
        ("weld", 2.5, "device"),
        ("implicit", 2.5, ""),
    ],
)
def test_the_audit_of_a_bridge_names_the_tick_and_the_port_of_the_map(
    method: str, share: float, port: str, tmp_path: Path
) -> None:
    # implicitfast: E_k = K δx² − ½m(Δv)² against a slack of ½ (K + B/T) δx², equal at K = B/T
    damping = 0.6
    stiffness = share * damping / PERIOD
    mapped = evaluate(cell(method, stiffness, damping))
    device = SimulatedDevice(
        damping=DEVICE_DAMPING, path=PATH, force_limit=NEVER, torque_limit=NEVER
    )
    coupling = Coupling(stiffness, damping, 1.0, 1e-3)
    report = recorded_and_audited(
        free_tool_and_wall(), device, coupling, method, PERIOD, 500, tmp_path
    )
    assert report.resimulation == "bit for bit"
    assert (report.verdict, report.port) == ("active" if port else "passive", port)
    assert mapped["fault_port"] == port
    assert (-1 if report.tick is None else report.tick) == mapped["fault_tick"]


def ran(method: str, stiffness: float, damping: float, **other: float | str | bool) -> Row:
    """Returns a row of a run in which nothing went wrong, but for what is said."""
    row: dict[str, float | str | bool] = {
        "stable_free": True,
        "stable_tapping": True,
        "environment": "strict",
        "fault_tick": -1,
        "fault_port": "",
        "slack_share": 0.0,
        "peak_force": 3.0,
    }
    if method != "weld":
        row["stable_on_wall"] = True
    return cell(method, stiffness, damping), row | other


def limited(method: str, damping: float, limit: float) -> Row:
    """Returns a row of a search on a wall."""
    point: Point = {"what": "limit", "method": method, "stiffness": 0.0, "damping": damping}
    return point, {"limit": limit}


def test_boundary_counts_each_way_to_fail_and_only_below_the_bound() -> None:
    # (6) is at 4000 N/m for B = 0 and at 2000 N/m for B = 1: three of four points lie below
    grid = [(1000.0, 0.0), (3000.0, 0.0), (1000.0, 1.0), (3000.0, 1.0)]
    rows = [ran("implicit", k, b) for k, b in grid[:3]]
    rows += [ran("implicit", *grid[3], stable_on_wall=False)]
    rows += [
        ran("implicitfast", 1000.0, 0.0, stable_on_wall=False),
        ran("implicitfast", 3000.0, 0.0, stable_free=False),
        ran("implicitfast", 1000.0, 1.0, environment="active", fault_port="environment"),
        ran("implicitfast", 3000.0, 1.0, environment="active", fault_port="environment"),
    ]
    # what is used and felt counts below the bound alone: the last point lies above
    used, felt = (0.4, 0.3, 0.2, 0.9), (3.0, 4.0, 5.0, 8.0)
    rows += [
        ran("explicit", *point, environment="within slack", slack_share=share, peak_force=force)
        for point, share, force in zip(grid, used, felt, strict=True)
    ]
    rows += [ran("weld", k, b) for k, b in grid[1:]]
    rows += [
        ran("weld", *grid[0], stable_tapping=False, fault_port="device", fault_tick=7),
        # at the bound itself nothing is promised any more
        ran("implicit", 4000.0, 0.0, environment="active", fault_port="environment"),
        ran("implicitfast:compensated", 1000.0, 0.0, stable_free=False),
    ]
    rows += [limited("implicit", 0.0, 4040.0), limited("implicit", 1.0, 1990.0)]
    finding = COUPLING.read(written(rows))
    found = finding.boundary["methods"]
    assert found["implicit"]["runs_below_6"] == 3
    assert found["implicit"]["passive_share_below_6"] == 1.0
    assert found["implicit"]["environment_faults_below_6"] == 0
    assert found["implicit"]["damping"] == [0.0, 1.0]
    assert found["implicit"]["measured_on_wall"] == [4040.0, 1990.0]
    assert found["implicit"]["predicted_6"] == pytest.approx([4000.0, 2000.0])
    assert found["implicit"]["largest_deviation"] == pytest.approx(0.01)
    assert found["implicitfast:compensated"]["passive_share_below_6"] == 0.0
    assert found["implicitfast"]["passive_share_below_6"] == 0.0
    assert found["implicitfast"]["environment_faults_below_6"] == 1
    assert found["explicit"]["passive_share_below_6"] == 1.0
    assert found["explicit"]["most_slack_used_below_6"] == 0.4
    assert found["explicit"]["largest_tapping_force_below_6"] == 5.0
    assert found["weld"]["passive_share_below_6"] == pytest.approx(2 / 3)
    assert found["weld"]["device_faults_below_6"] == 1
    assert "unstable within 1.00% of K = 2 (b − B)/T" in finding.paragraph
    assert "'weld' is stable and passive at 67% of the 3 points below (6)" in finding.paragraph
    assert "'explicit:rk4'" not in finding.paragraph  # no point of it was computed


def test_points_are_a_grid_for_every_method_and_about_as_many_as_asked() -> None:
    asked = 4500
    grid = points(asked)
    cells = [point for point in grid if point["what"] == "cell"]
    assert {point["method"] for point in cells} == set(THEORIES)
    assert 3 * len(cells) == pytest.approx(asked, rel=0.1)
    assert COUPLING.default_points >= 4000


def test_map_leaves_picture_table_and_boundary(tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        files = run_map(COUPLING, tmp_path, points=24, executor=pool)
    assert files.failed == 0
    assert files.picture.stat().st_size > 10_000
    said = json.loads(files.boundary.read_text(encoding="utf-8"))
    implicit = said["boundary"]["methods"]["implicit"]
    assert implicit["largest_deviation"] < 0.01
    assert implicit["passive_share_below_6"] == 1.0
    assert np.isfinite(implicit["measured_on_wall"]).all()
    assert "within 0." in said["paragraph"]


def test_a_table_in_which_only_limits_were_found_is_read() -> None:
    found = COUPLING.read(
        written([limited("implicit", 0.0, 4000.0), (cell("weld", 1.0, 0.0), "E")])
    )
    assert found.boundary["methods"]["implicit"]["passive_share_below_6"] is None
