"""The map of K against B: the bounds are where loops fail, and the verdicts name what failed."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from hapticbridge.coupling import Coupling
from hapticbridge.passivity import environment_minimum_damping, maximum_stiffness
from hapticbridge.study.maps import run_map
from hapticbridge.study.maps.coupling import COUPLING
from hapticbridge.study.maps.coupling_runs import (
    DEVICE_DAMPING,
    PERIOD,
    THEORIES,
    TOOL_MASS,
    evaluate,
    points,
)
from hapticbridge.study.maps.stability_map import Point
from hapticbridge.study.table import Outcome, Table, table_of


def cell(method: str, stiffness: float, damping: float) -> Point:
    return {"what": "cell", "method": method, "stiffness": stiffness, "damping": damping}


@pytest.mark.parametrize("damping", [0.0, 0.5, 1.5])
def test_worst_hand_on_a_wall_finds_the_bound_within_a_percent(damping: float) -> None:
    found = evaluate({"what": "limit", "method": "implicit", "stiffness": 0.0, "damping": damping})
    assert found["limit"] == pytest.approx(
        maximum_stiffness(DEVICE_DAMPING, PERIOD, damping), rel=0.01
    )


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


def made_up(rows: list[dict[str, float | str | bool]]) -> Table:
    """Returns a table as a map's points would leave it."""
    given: list[Point] = []
    done = []
    for row in rows:
        names = ("what", "method", "stiffness", "damping")
        given.append({name: row[name] for name in names})
        done.append(Outcome({k: v for k, v in row.items() if k not in names}))
    return table_of(given, done)


def ran(
    method: str, stiffness: float, damping: float, **other: float | str | bool
) -> dict[str, float | str | bool]:
    """Returns a row of a run in which nothing went wrong, but for what is said."""
    row: dict[str, float | str | bool] = {
        "what": "cell",
        "method": method,
        "stiffness": stiffness,
        "damping": damping,
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
    return row | other


def test_boundary_counts_each_way_to_fail_and_only_below_the_bound() -> None:
    # (6) is at 4000 N/m for B = 0 and at 2000 N/m for B = 1: three of four points lie below
    grid = [(1000.0, 0.0), (3000.0, 0.0), (1000.0, 1.0), (3000.0, 1.0)]
    rows = [ran("implicit", k, b) for k, b in grid]
    rows[3] |= {"stable_on_wall": False}
    rows += [
        ran("implicitfast", 1000.0, 0.0, stable_on_wall=False),
        ran("implicitfast", 3000.0, 0.0, stable_free=False),
        ran("implicitfast", 1000.0, 1.0, environment="active", fault_port="environment"),
        ran("implicitfast", 3000.0, 1.0, environment="active", fault_port="environment"),
    ]
    rows += [ran("explicit", k, b, environment="within slack", slack_share=0.4) for k, b in grid]
    rows += [ran("weld", k, b) for k, b in grid]
    rows[13] |= {"stable_tapping": False, "fault_port": "device", "fault_tick": 7}
    rows.append({"what": "limit", "method": "implicit", "stiffness": 0.0, "damping": 0.0})
    rows[-1]["limit"] = 4040.0
    finding = COUPLING.read(made_up(rows))
    found = finding.boundary["methods"]
    assert found["implicit"]["runs_below_6"] == 3
    assert found["implicit"]["passive_share_below_6"] == 1.0
    assert found["implicit"]["largest_deviation"] == pytest.approx(0.01)
    assert found["implicitfast"]["passive_share_below_6"] == 0.0
    assert found["implicitfast"]["environment_faults_below_6"] == 1
    assert found["explicit"]["passive_share_below_6"] == 1.0
    assert found["weld"]["passive_share_below_6"] == pytest.approx(2 / 3)
    assert found["weld"]["device_faults_below_6"] == 1
    said = finding.paragraph
    assert "within 1 % of K = 2 (b − B)/T" in said
    assert "'weld' is stable and passive at 67 % of the points below (6)" in said
    assert "at fault the device port at 1 of 3" in said
    assert "no port at fault and 40 % of the slack used" in said
    assert "'explicit:rk4': no point could be computed below (6)" in said


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
