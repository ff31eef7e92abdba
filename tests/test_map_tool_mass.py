"""Claims of the map ``tool_mass``."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from map_runs import NEVER, recorded_and_audited
from map_tables import Row, written

from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import StudyError
from hapticbridge.lab.maps.base import Point, run_map, set_tool_mass
from hapticbridge.lab.maps.tool_mass import (
    DAMPING,
    DEVICE_DAMPING,
    KNOCK,
    PATH,
    PERIOD,
    THEORIES,
    TOOL_MASS,
    coupling_of,
    evaluate,
    felt,
    hand_worst_for,
    held_still,
    least_mass,
    predicted_limit,
    worst_angle,
    worst_hand,
)
from hapticbridge.scene import Scene, load_scene
from hapticbridge.theory.sampled_loop import SampledLoop
from hapticbridge.theory.virtual_mass import Integrator, environment_minimum_damping, minimum_mass

TWINS: dict[str, Integrator] = {"implicit": "implicit", "explicit": "semi_implicit"}


@pytest.mark.parametrize("method", TWINS)
def test_the_theory_here_is_that_of_the_passivity_package(method: str) -> None:
    coupling, angle = Coupling(1000.0, 2.0, 0.0, 0.0), np.array([0.1, 1.0, 3.0])
    assert least_mass(method, 1000.0, 2.0, 1e-3) == minimum_mass(coupling, 1e-3, TWINS[method])
    for mass in (0.005, 0.05):
        other = SampledLoop(coupling, 1e-3, mass=mass, integrator=TWINS[method])
        mine = felt(method, 1000.0, 2.0, mass, 1e-3, angle)
        np.testing.assert_allclose(mine, other.response(angle / 1e-3), rtol=1e-12)
        needed = environment_minimum_damping(coupling, 1e-3, mass, TWINS[method])
        assert worst_angle(method, 1000.0, 2.0, mass, 1e-3)[1] == pytest.approx(needed, rel=1e-6)


@pytest.mark.parametrize(
    ("method", "mass", "needed"), [("implicit", 0.01, 2.2222), ("explicit", 0.01, 2.8571)]
)
def test_the_damping_needed_is_that_of_the_paper(method: str, mass: float, needed: float) -> None:
    assert worst_angle(method, 1000.0, 2.0, mass, 1e-3)[1] == pytest.approx(needed, abs=1e-4)


def largest_root(method: str, stiffness: float, damping: float, mass: float) -> float:
    """Returns |z| of the slowest mode of a tool behind a handle held still, from its step."""
    k, b, t = stiffness, damping, 1e-3
    # state: x_k, v_k, f_{k-1}, x_{k-1}; the force of RK4 and Euler is that of the tick before
    force = np.array([-k - b / t, 0.0, b / t])  # on x_k, v_k, x_{k-1}
    if method == "implicitfast":
        v = np.array([-k * t, mass]) / (mass + b * t)
        return float(np.abs(np.linalg.eigvals(np.array([[1 + t * v[0], t * v[1]], v]))).max())
    half = t**2 / mass * (0.5 if method == "explicit:rk4" else 1.0)
    step = np.array(
        [
            np.array([1.0, t, 0.0]) + half * force,
            np.array([0.0, 1.0, 0.0]) + t / mass * force,
            [1.0, 0.0, 0.0],
        ]
    )
    return float(np.abs(np.linalg.eigvals(step)).max())


@pytest.mark.parametrize("method", ["implicitfast", "explicit", "explicit:rk4"])
@pytest.mark.parametrize(("stiffness", "damping"), [(20_000.0, 5.0), (9000.0, 5.0), (1000.0, 0.6)])
def test_a_tool_just_above_the_least_mass_is_stable_and_just_below_is_not(
    method: str, stiffness: float, damping: float
) -> None:
    least = least_mass(method, stiffness, damping, 1e-3)
    if not np.isfinite(least):
        assert all(largest_root(method, stiffness, damping, m) > 1 for m in (1e-3, 0.1, 10.0))
    elif least == 0:
        assert all(largest_root(method, stiffness, damping, m) < 1 for m in (1e-6, 1e-3, 10.0))
    else:
        assert largest_root(method, stiffness, damping, 1.001 * least) < 1
        assert largest_root(method, stiffness, damping, 0.999 * least) > 1


@pytest.mark.parametrize(
    ("method", "stiffness"),
    [("implicitfast", 40_000.0), ("explicit", 9000.0), ("explicit:rk4", 9000.0)],
)
def test_behind_a_handle_held_still_a_method_fails_where_theory_says(
    method: str, stiffness: float
) -> None:
    least = least_mass(method, stiffness, DAMPING, PERIOD)
    failed = held_still(method, stiffness, 0.97 * least)
    assert not failed.is_stable
    assert failed.environment == "active"  # the ledger's port: what lies behind the coupling
    assert failed.first_active >= 0
    assert held_still(method, stiffness, 1.03 * least).is_stable
    twin = held_still("implicit", stiffness, 0.97 * least)
    assert twin.is_stable
    assert twin.environment == "strict"


@pytest.mark.parametrize(
    ("method", "stiffness"), [("explicit", 20_000.0), ("implicitfast", 15_000.0)]
)
def test_the_worst_hand_turns_a_light_tool_unstable_where_theory_says(
    method: str, stiffness: float
) -> None:
    limit = float(predicted_limit(method, stiffness, is_held=False)["limit"])
    assert not worst_hand(method, stiffness, 0.9 * limit).is_stable
    assert worst_hand(method, stiffness, 1.1 * limit).is_stable
    assert worst_hand("implicit", stiffness, 0.9 * limit).is_stable


def test_implicit_fails_at_no_mass() -> None:
    for mass in (1e-3, 0.1, 10.0):
        outcome = evaluate(
            {"what": "cell", "method": "implicit", "stiffness": 25_000.0, "mass": mass}
        )
        assert outcome["stable_held_still"] is True
        assert outcome["stable_worst_hand"] is True
        assert outcome["environment"] == "strict"


@pytest.mark.parametrize("method", ["compensated", "lossless"])
def test_without_the_lag_no_mass_fails_up_to_twice_b_over_t(method: str) -> None:
    limit = 2 * DEVICE_DAMPING / PERIOD
    assert held_still(method, 0.98 * limit, 1e-3).is_stable
    for mass in (2e-3, 5.0):
        assert worst_hand(method, 0.98 * limit, mass).is_stable
    assert not worst_hand(method, 1.02 * limit, 5.0).is_stable
    # the twin that keeps its lag bears a quarter less
    assert not worst_hand("implicit", 0.98 * limit, 5.0).is_stable


def test_a_light_tool_is_no_help_to_the_lossless_coupling() -> None:
    limit = 2 * DEVICE_DAMPING / PERIOD
    assert not worst_hand("lossless", 1.02 * limit, 2e-3).is_stable
    assert worst_hand("compensated", 1.02 * limit, 2e-3).is_stable


def test_a_heavy_tool_on_a_soft_coupling_decays() -> None:
    # it swings twice a second: a fifth of 2 s holds less than a swing, and would show growth
    assert held_still("explicit", 2000.0, 10.0).is_stable


def test_implicitfast_uses_up_the_slack_where_the_spring_outweighs_the_damper() -> None:
    # E_k is K δx² and the slack ½ (K + B/T) δx², whatever the mass
    for stiffness, verdict in ((4000.0, "within slack"), (6000.0, "active")):
        share = 2 * stiffness / (stiffness + DAMPING / PERIOD)
        point: Point = {"what": "cell", "method": "implicitfast"}
        point |= {"stiffness": stiffness, "mass": 0.01}
        outcome = evaluate(point)
        assert outcome["environment"] == verdict
        assert (float(outcome["first_active"]) >= 0) is (verdict == "active")
        assert outcome["slack_share"] == pytest.approx(share, rel=0.02)


def test_where_no_mass_is_stable_theory_has_no_limit() -> None:
    nowhere = predicted_limit("explicit", 40_000.0, is_held=False)
    assert (nowhere["stable_if_light"], nowhere["stable_if_heavy"]) == (False, False)
    assert np.isnan(nowhere["limit"])


def test_a_search_finds_the_predicted_limit() -> None:
    found = evaluate({"what": "held still", "method": "explicit", "stiffness": 9000.0, "mass": 0.0})
    assert found["limit"] == pytest.approx(0.00475, rel=0.01)


def tool_of(mass: float) -> Scene:
    scene = load_scene("point_mass")
    set_tool_mass(scene.model, "tool", mass)
    mujoco.mj_setConst(scene.model, scene.data)
    return scene


def unlimited(**options: object) -> SimulatedDevice:
    return SimulatedDevice(force_limit=NEVER, torque_limit=NEVER, **options)  # type: ignore[arg-type]


def test_the_audit_names_the_environment_where_a_held_force_meets_too_light_a_tool(
    tmp_path: Path,
) -> None:
    least = least_mass("explicit", 9000.0, DAMPING, PERIOD)
    for mass, verdict in ((0.97 * least, "active"), (1.03 * least, "passive")):
        # an ordinary hand swings the tool; device and coupling are as they should be
        device = unlimited(damping=DEVICE_DAMPING, path=PATH)
        scene, coupling = tool_of(mass), coupling_of(9000.0)
        report = recorded_and_audited(
            scene, device, coupling, "explicit", PERIOD, 600, tmp_path, name=verdict
        )
        assert (report.verdict, report.certified) == (verdict, True)
        assert report.resimulation == "bit for bit"
        if verdict == "active":
            assert report.port == "environment"
            assert report.tick is not None and 0 < report.tick < 600


def test_the_audit_names_the_device_where_the_worst_hand_holds_a_tool_too_heavy(
    tmp_path: Path,
) -> None:
    # 'implicit' beyond (6): there a light tool is stable, and a heavy one in the worst hand is not
    stiffness = 33_000.0
    limit = float(predicted_limit("implicit", stiffness, is_held=False)["limit"])
    for mass, verdict in ((4 * limit, "active"), (0.5 * limit, "passive")):
        hand = hand_worst_for("implicit", stiffness, mass)
        device = unlimited(damping=DEVICE_DAMPING, hand=hand)
        report = recorded_and_audited(
            tool_of(mass),
            device,
            coupling_of(stiffness),
            "implicit",
            PERIOD,
            400,
            tmp_path,
            knock=KNOCK,
            name=verdict,
        )
        assert (report.verdict, report.environment) == (verdict, "strict")
        assert report.certified is False  # (6) is enough for any tool, and needed for a wall
        assert report.port == ("device" if verdict == "active" else "")


def cell(name: str, stiffness: float, *, held: bool, worst: bool, created: float = 0.0) -> Row:
    point: Point = {"what": "cell", "method": name, "stiffness": stiffness, "mass": 0.01}
    return point, {
        "stable_held_still": held,
        "stable_worst_hand": worst,
        "environment": "strict",
        "created": created,
        "slack_share": 0.0,
        "first_active": -1,
    }


def limit_row(what: str, stiffness: float, mass: float, *, light: bool, heavy: bool) -> Row:
    point: Point = {"what": what, "method": "explicit", "stiffness": stiffness, "mass": 0.0}
    return point, {"limit": mass, "stable_if_light": light, "stable_if_heavy": heavy}


NONE = float("nan")
FULL = [
    cell("explicit", 2000.0, held=True, worst=True, created=0.25),
    cell("explicit", 20_000.0, held=False, worst=True, created=9.0),
    cell("explicit", 29_000.0, held=True, worst=False, created=8.0),
    cell("explicit", 31_000.0, held=False, worst=False, created=7.0),  # (6) is at 30 kN/m
    cell("explicit", 50_000.0, held=True, worst=True, created=0.125),
    # theory: 4.75 g, 7.5 g and 10 g at 9, 20 and 30 kN/m
    limit_row("held still", 9000.0, 1.2 * 0.00475, light=False, heavy=True),
    limit_row("held still", 20_000.0, NONE, light=True, heavy=True),
    limit_row("held still", 30_000.0, 0.010, light=False, heavy=True),
    limit_row("worst hand", 9000.0, NONE, light=False, heavy=False),
    limit_row("worst hand", 40_000.0, NONE, light=False, heavy=False),
]


def test_what_is_read_is_what_the_table_says() -> None:
    found = TOOL_MASS.read(written(FULL))
    mine = found.boundary["methods"]["explicit"]
    assert mine["points"] == 5
    assert mine["unstable_held_still"] == 2
    assert mine["points_below_6"] == 3
    assert mine["unstable_below_6"] == 2
    assert mine["most_created"] == 0.25
    held, worst = mine["held still"], mine["worst hand"]
    assert held["measured_mass"] == [1.2 * 0.00475, None, 0.010]
    assert held["predicted_mass"] == pytest.approx([0.00475, 0.0075, 0.010], rel=1e-3)
    assert held["worst_ratio_error"] == pytest.approx(0.2, rel=1e-2)
    assert held["disagreements"] == 1  # where no limit was found and theory has one
    assert "'explicit': held still, a tool is unstable at 2 of 5 points" in found.paragraph
    assert worst["disagreements"] == 1  # beyond (6) nothing is stable, and theory says so too


def test_a_limit_at_the_other_end_is_a_disagreement_too() -> None:
    right = limit_row("held still", 9000.0, 0.00475, light=False, heavy=True)
    turned = limit_row("held still", 9000.0, 0.00475, light=True, heavy=False)
    for row, count in ((right, 0), (turned, 1)):
        mine = TOOL_MASS.read(written([row])).boundary["methods"]["explicit"]["held still"]
        assert mine["disagreements"] == count


def test_what_failed_is_left_out_and_named() -> None:
    found = TOOL_MASS.read(written([row for row in FULL if row[0]["what"] == "cell"]))
    assert found.boundary["methods"]["implicit"] == {}
    assert "held still" not in found.boundary["methods"]["explicit"]
    TOOL_MASS.read(written([row for row in FULL if row[0]["what"] != "cell"]))
    some = [(p, "SceneError: no") if p["what"] == "worst hand" else (p, got) for p, got in FULL]
    assert "worst hand" not in TOOL_MASS.read(written(some)).boundary["methods"]["explicit"]


def few(count: int) -> list[Point]:
    """Returns the whole grid, and of the searches one method's behind a handle held still."""
    return [
        point
        for point in TOOL_MASS.points(count)
        if point["what"] == "cell" or (point["what"], point["method"]) == ("held still", "explicit")
    ]


def test_the_map_is_drawn_and_says_what_was_found(tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as executor:
        files = run_map(replace(TOOL_MASS, points=few), tmp_path, points=16, executor=executor)
    assert files.failed == 0
    assert files.picture.stat().st_size > 10_000
    methods = files.finding.boundary["methods"]
    assert set(methods) == set(THEORIES)
    assert methods["implicit"]["unstable_held_still"] == 0
    assert methods["explicit"]["unstable_held_still"] > 0


def test_bad_values_are_refused() -> None:
    with pytest.raises(StudyError, match="no theory for method 'weld'"):
        least_mass("weld", 1000.0, 1.0, 1e-3)
    with pytest.raises(StudyError, match="mass is nan kg"):
        worst_angle("explicit", 1000.0, 1.0, float("nan"), 1e-3)
