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
from hapticbridge.study.maps.coupling import (
    COUPLING,
    DEVICE_DAMPING,
    PERIOD,
    THEORIES,
    TOOL_MASS,
    evaluate,
    points,
)
from hapticbridge.study.maps.stability_map import Point


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
