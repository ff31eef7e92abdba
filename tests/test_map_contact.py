"""The map ``contact``: what creates energy on a wall and in a hole, and what does not."""

from __future__ import annotations

import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from map_runs import recorded_and_audited
from map_tables import Row, written

from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.lab.maps import contact
from hapticbridge.lab.maps.base import MISSING, VERDICTS, Point, loop_in, run_map, set_tool_mass
from hapticbridge.lab.maps.contact import (
    COMPARED,
    CONTACT,
    PANELS,
    RIGS,
    agreement,
    cases_of,
    evaluate,
    exceptions,
    method_runs,
    points,
)
from hapticbridge.lab.maps.contact_rigs import (
    PERIOD,
    SHIPPED,
    TREATMENTS,
    ContactRun,
    Treatment,
    peg_device,
    peg_runs,
    start_in_hole,
    summary,
    ticks_of,
    until_active,
    wall_runs,
)
from hapticbridge.lab.methods import METHODS
from hapticbridge.scene import load_scene
from hapticbridge.scene.contacts import SUGGESTED

LIGHT = [(0.03, 0.0, 1)]
"""A peg of 30 g without friction in the first random hand: the hardest case of the search."""

LIGHT_AT_MOUTH = (1000.0, *LIGHT[0])
"""The same in and out of the hole, at 1000 N/m."""

DAMPED = Treatment((SUGGESTED[0] * PERIOD, SUGGESTED[1]))


def test_light_frictionless_peg_goes_beyond_the_slack_as_shipped_and_not_damped() -> None:
    (shipped,) = peg_runs(Treatment(), 1000.0, LIGHT)
    assert shipped.environment == "active"
    assert shipped.created > 1e-3
    assert 50 < shipped.first_active < 500
    (damped,) = peg_runs(DAMPED, 1000.0, LIGHT)
    assert damped.environment == "strict"
    assert damped.created <= 0
    assert damped.first_active == -1
    assert damped.peak_force > 3
    assert damped.depth < 1.5 * shipped.depth


def test_strict_contact_need_not_be_softer_than_the_shipped_one() -> None:
    hard = TREATMENTS["damped hard: 0.00002 100"]
    for k in (1000.0, 6000.0):
        (run,) = peg_runs(hard, k, LIGHT)
        (shipped,) = peg_runs(Treatment(), k, LIGHT)
        assert run.environment == "strict"
        assert run.depth < shipped.depth


def test_four_substeps_with_the_rule_in_their_own_steps_are_strict_and_stiffer() -> None:
    (finer,) = peg_runs(TREATMENTS["4 substeps, 0.0005 4"], 1000.0, LIGHT)
    (whole,) = peg_runs(DAMPED, 1000.0, LIGHT)
    assert finer.environment == "strict"
    assert finer.depth < 0.5 * whole.depth


def test_pyramidal_cone_is_active_where_friction_is_low_and_the_elliptic_one_is_not() -> None:
    slippery = [(0.03, 0.1, hand) for hand in (0, 1, 2)]
    soft = Treatment((0.02, 1.0))
    pyramidal = list(peg_runs(replace(soft, cone="pyramidal"), 1000.0, slippery))
    assert max(run.slack_share for run in pyramidal) > 1.5
    assert max(run.first_active for run in pyramidal) > 0
    assert {run.environment for run in peg_runs(soft, 1000.0, slippery)} == {"strict"}


def test_direct_format_is_the_same_contact_in_other_words() -> None:
    # k = 1/(timeconst dampratio)², b = 2/timeconst
    (one,) = peg_runs(Treatment((0.002, 1.0)), 1000.0, LIGHT)
    (other,) = peg_runs(Treatment((-2.5e5, -1000.0)), 1000.0, LIGHT)
    assert other.created == pytest.approx(one.created, rel=1e-6)
    assert other.depth == pytest.approx(one.depth, rel=1e-6)


def test_a_row_that_the_step_cannot_resolve_is_replaced_unless_refsafe_is_off() -> None:
    cases = [(0.05, 0)]
    (resolved,) = wall_runs(Treatment((0.001, 1.0)), 2000.0, cases)
    (stiffer,) = wall_runs(Treatment((0.00025, 1.0)), 2000.0, cases)
    (as_written,) = wall_runs(Treatment((0.00025, 1.0), refsafe=False), 2000.0, cases)
    assert stiffer.depth == pytest.approx(resolved.depth, rel=1e-3)
    assert as_written.depth < 0.97 * resolved.depth


@pytest.mark.parametrize("stiffness", [2000.0, 20_000.0])
def test_implicitfast_creates_energy_on_a_wall_where_implicit_creates_none(
    stiffness: float,
) -> None:
    implicit = list(wall_runs(DAMPED, stiffness))
    assert {run.environment for run in implicit} == {"strict"}
    fast = wall_runs(replace(DAMPED, method="implicitfast"), stiffness)
    assert max(run.created for run in fast) > 1e-4


def test_bouncing_contact_is_active_on_a_wall_and_a_critically_damped_one_is_not() -> None:
    (bouncing,) = wall_runs(Treatment((0.02, 0.3)), 2000.0, [(0.05, 1)])
    assert bouncing.environment == "active"
    assert bouncing.first_active > 0
    (damped,) = wall_runs(Treatment((0.02, 2.0)), 2000.0, [(0.05, 1)])
    assert damped.environment == "strict"


@pytest.mark.parametrize(("ratio", "verdict"), [(3.0, "active"), (5.0, "passive")])
def test_the_audit_of_a_bridge_names_the_tick_at_which_the_map_sees_a_contact_create(
    ratio: float, verdict: str, tmp_path: Path
) -> None:
    # at timeconst T/2 a light peg is active up to dampratio 4, strict from 6 on
    treatment = Treatment((0.5 * PERIOD, ratio))
    (mapped,) = peg_runs(treatment, 1000.0, LIGHT)
    ((mass, friction, hand),) = LIGHT
    scene = load_scene("peg_in_hole")
    start_in_hole(scene.model)
    treatment.apply(scene.model, friction)
    set_tool_mass(scene.model, "peg", mass)
    mujoco.mj_setConst(scene.model, scene.data)
    scene.reset()
    device, coupling = peg_device(1000.0, hand)
    with warnings.catch_warnings(record=True) as concerns:
        warnings.simplefilter("always")
        report = recorded_and_audited(
            scene, device, coupling, "implicit", PERIOD, ticks_of(device), tmp_path
        )
    assert bool(concerns) == (verdict == "active")  # the rule for scenes sees it coming
    assert report.resimulation == "bit for bit"
    assert report.certified  # the device is not to blame
    assert report.verdict == verdict
    assert report.environment == mapped.environment
    assert report.slack_share == pytest.approx(mapped.slack_share, rel=1e-6)
    if verdict == "active":
        assert (report.tick, report.port) == (mapped.first_active, "environment")
    else:
        assert mapped.first_active == -1


@pytest.mark.parametrize("rig", RIGS)
def test_methods_meet_the_same_hands_and_come_and_go(rig: str) -> None:
    runs = {
        method: list(method_runs(rig, method, [(1000.0, 0.1, 0.0, hand) for hand in (0, 1)]))
        for method in COMPARED
    }
    for one, other in zip(runs["lossless"], runs["compensated"], strict=True):
        assert one.depth > 0
        # the same contact, but not the same approach to it
        assert one.peak_force == pytest.approx(other.peak_force, rel=0.2)
        assert one.peak_force != other.peak_force
    assert len(cases_of(rig, 0.1)) == {"taps": 40, "mouth": 80}[rig]


def test_on_the_same_device_a_jamming_peg_uses_the_same_slack_by_every_method() -> None:
    case = [LIGHT_AT_MOUTH]
    (lossless,) = method_runs("mouth", "lossless", case)
    implicit, compensated = (
        next(method_runs("mouth", method, case, same_law=True))
        for method in ("implicit", "compensated")
    )
    assert implicit == compensated
    assert lossless.environment == "active"
    assert lossless.slack_share == pytest.approx(implicit.slack_share, rel=1e-9)
    # asked for the same B instead, implicit has another damper, and the peg jams otherwise
    (felt,) = method_runs("mouth", "implicit", case)
    assert abs(felt.slack_share / lossless.slack_share - 1) > 0.02


def of(environment: str, depth: float, *, created: float = 0.0, first: int = -1) -> ContactRun:
    return ContactRun(environment, created, 10 * created, first, 1e3 * depth, depth)


def test_runs_end_with_the_first_that_is_active_and_are_counted_by_verdict() -> None:
    runs = [
        of("strict", 1e-3),
        of("within slack", 4e-3, created=0.02),
        of("active", 2e-3, created=0.2, first=70),
        of("active", 9e-3, created=0.9, first=5),
    ]
    asked = iter(runs)
    made = until_active(asked)
    assert made == runs[:3]
    assert next(asked) is runs[3]  # never made
    found = summary(made)
    assert (found["runs"], found["strict"], found["within_slack"], found["active"]) == (3, 1, 1, 1)
    assert found["created"] == 0.2
    assert found["slack_share"] == 2.0
    assert found["first_active"] == 70
    assert found["peak_force"] == 4.0
    assert found["median_depth"] == 2e-3
    assert found["largest_depth"] == 4e-3
    assert summary(runs)["first_active"] == 5
    assert summary(runs[:2])["first_active"] == -1


def test_a_mass_set_before_leaves_no_trace_in_a_run() -> None:
    (alone,) = peg_runs(Treatment(), 1000.0, LIGHT)
    list(peg_runs(Treatment(), 1000.0, [(0.1, 0.0, 1), (0.37, 0.0, 1)]))
    (after,) = peg_runs(Treatment(), 1000.0, LIGHT)
    assert after == alone


def grid_row(rig: str, method: str, k: float, setting: tuple[float, float], verdict: str) -> Row:
    """Returns a row of the grid, of one run."""
    point: Point = {"rig": rig, "treatment": "", "method": method, "stiffness": k}
    steps, ratio = setting
    return point | {"steps": steps, "dampratio": ratio, "mass": 0.0}, counted(verdict)


def counted(*verdicts: str, depth: float = 1e-4) -> dict[str, float | int]:
    counts = {name.replace(" ", "_"): verdicts.count(name) for name in VERDICTS[:3]}
    return {
        "runs": len(verdicts),
        **counts,
        "created": 0.01 * counts["active"],
        "slack_share": 0.25 * len(verdicts),
        "first_active": -1,
        "peak_force": 1.0,
        "median_depth": depth,
        "largest_depth": 3 * depth,
    }


def search_row(name: str, mass: float, *verdicts: str, depth: float = 1e-4) -> Row:
    point = grid_row("search", "implicit", 0.0, (0.0, 0.0), "strict")[0]
    return point | {"treatment": name, "mass": mass}, counted(*verdicts, depth=depth)


def method_row(rig: str, method: str, *verdicts: str) -> Row:
    point = grid_row(rig, method, 0.0, (0.0, 0.0), "strict")[0]
    return point | {"mass": 0.1}, counted(*verdicts)


SETTINGS = ((0.5, 8.0), (2.0, 2.0), (1.0, 1.0))
"""τ = 60.8, 15.2 and 1.9 steps: strict, for heavy tools alone and none by the rule."""

WRITTEN = [
    *(
        grid_row(rig, method, k, setting, verdict)
        for rig, method, stiffness, _ in PANELS
        for k in stiffness
        for setting, verdict in zip(SETTINGS, ("strict", "within slack", "active"), strict=True)
    ),
    search_row(SHIPPED, 0.03, "strict", "active", depth=2e-4),
    search_row(SHIPPED, 0.3, "strict", "within slack", "strict", depth=4e-4),
    search_row("damped: 0.0005 8", 0.03, "strict", "strict", depth=3e-4),
    search_row("damped: 0.0005 8", 0.3, "strict", "strict", depth=5e-4),
    search_row("MuJoCo's default 0.02 1", 0.03, "strict", depth=2e-3),
    search_row("4 substeps, 0.002 1", 0.03, "strict", depth=1e-5),
    *(method_row("taps", method, "strict", "strict") for method in COMPARED),
    method_row("mouth", "implicit", "strict", "active"),
    method_row("mouth", "lossless", "strict", "within slack"),
]


def test_boundary_and_paragraph_follow_from_a_made_up_table() -> None:
    finding = CONTACT.read(written(WRITTEN))
    found = {one["treatment"]: one for one in finding.boundary["search"]}
    shipped = found[SHIPPED]
    assert (shipped["runs"], shipped["strict"], shipped["within_slack"]) == (5, 3, 1)
    assert shipped["active"] == 1
    assert shipped["created"] == 0.01
    assert shipped["slack_share"] == 0.75
    assert shipped["median_depth"] == pytest.approx(3e-4)
    assert shipped["largest_depth"] == pytest.approx(12e-4)
    rule = finding.boundary["rule"]
    assert {name: one["cells"] for name, one in rule.items()} == {
        "strict": 2,
        "relaxed": 2,
        "abrupt": 2,
    }
    assert len(finding.boundary["methods"]) == 5
    assert finding.boundary["exceptions"] == []
    said = finding.paragraph
    assert "2 of 2 settings that the rule calls strict were so in every run" in said
    assert "creates energy at 67% of the settings" in said
    assert "least deep is 'damped: 0.0005 8', median 0.0004 m, 4 times as deep" in said


@pytest.mark.parametrize("rig", ["peg", "search", "wall", "methods"])
def test_a_rig_that_fails_is_named_and_the_others_are_read(rig: str) -> None:
    rigs = RIGS if rig == "methods" else (rig,)
    rows: list[Row] = [(at, "E" if at["rig"] in rigs else got) for at, got in WRITTEN]
    finding = CONTACT.read(written(rows))
    texts = [MISSING in [text.get_text() for text in axes.texts] for axes in finding.figure.axes]
    assert sum(texts) == {"peg": 2, "search": 1, "wall": 4, "methods": 1}[rig]


def test_map_at_reduced_resolution_agrees_with_the_rule(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def few(treatment: Treatment, stiffness: float, *_: Any) -> Any:
        return peg_runs(treatment, stiffness, LIGHT)

    monkeypatch.setattr(contact, "peg_runs", few)
    monkeypatch.setattr(contact, "peg_runs", few)
    names = (SHIPPED, "damped: 0.0005 8")
    monkeypatch.setattr(contact, "HANDS", 1)
    chosen = [
        p
        for p in points(1)
        if p["rig"] not in ("search", *RIGS)
        or p["treatment"] in names
        or (p["rig"] in RIGS and p["mass"] == 0.1)
    ]
    files = run_map(
        replace(CONTACT, points=lambda _: chosen), tmp_path, executor=ThreadPoolExecutor(2)
    )
    assert files.failed == 0
    assert files.picture.stat().st_size > 10_000
    rule = files.finding.boundary["rule"]
    assert rule["strict"]["strict"] == rule["strict"]["cells"] > 0
    assert rule["abrupt"]["strict"] < rule["abrupt"]["cells"]
    methods = files.finding.boundary["methods"]
    assert [(one["rig"], one["method"]) for one in methods] == [
        (rig, method) for rig in RIGS for method in COMPARED
    ]
    assert [one["runs"] for one in methods] == [2] * 3 + [4] * 3
    shipped, damped = files.finding.boundary["search"]
    assert shipped["active"] > 0
    assert damped["strict"] == damped["runs"]


def test_treatments_reach_the_model_whatever_was_set_before() -> None:
    model = loop_in("virtual_wall", "contact").scene.model
    exact = int(mujoco.mjtEnableBit.mjENBL_DIAGEXACT)
    safe = int(mujoco.mjtDisableBit.mjDSBL_REFSAFE)
    for treatment in [*TREATMENTS.values(), Treatment()]:
        treatment.apply(model, 0.3)
        assert set(model.geom_condim.tolist()) == {treatment.condim}
        assert bool(model.opt.enableflags & exact) == treatment.diagexact
        assert bool(model.opt.disableflags & safe) != treatment.refsafe
        assert model.opt.cone == (treatment.cone == "elliptic")
        assert tuple(model.opt.o_solref) == treatment.solref
        assert tuple(model.opt.o_solimp[:3]) == treatment.solimp
        assert model.opt.o_friction[0] == 0.3


class Rows(dict[str, Any]):
    """The part of a table that the comparison needs."""

    def select(self, rows: Any) -> Rows:
        return Rows({name: values[rows] for name, values in self.items()})


@pytest.mark.parametrize(
    ("name", "mass", "measured", "is_worse"),
    [
        (SHIPPED, 0.03, "active", False),
        (SHIPPED, 0.1, "active", True),
        (SHIPPED, 0.1, "within slack", False),
        ("0.00025 8", 0.03, "active", True),
        ("damped: 0.0005 8", 0.1, "within slack", True),
        ("damped: 0.0005 8", 0.1, "strict", False),
        ("impedance 0.99 throughout", 0.3, "active", False),
        ("pyramidal cone", 0.3, "active", False),
        ("diagexact off", 0.3, "active", False),
        ("implicitfast", 0.3, "active", False),
    ],
)
def test_only_runs_worse_than_the_rule_says_are_exceptions(
    name: str, mass: float, measured: str, is_worse: bool
) -> None:
    row: Any = Rows(
        treatment=np.array([name]),
        mass=np.array([mass]),
        active=np.array([int(measured == "active")]),
        within_slack=np.array([int(measured == "within slack")]),
    )
    assert bool(exceptions(row)) == is_worse


def test_regions_of_the_rule_are_told_apart_on_the_grid() -> None:
    # τ = 60.8, 30.4, 15.2 and 1.9 h; what promises nothing is abrupt
    steps, ratio = [0.5, 0.25, 2.0, 1.0], [8.0, 8.0, 2.0, 1.0]
    table: Any = Rows(
        rig=np.array(["peg"] * 4),
        steps=np.array(steps),
        dampratio=np.array(ratio),
        active=np.array([0, 0, 0, 1]),
        within_slack=np.array([0, 1, 0, 0]),
    )
    found = agreement(table)
    assert {name: one["cells"] for name, one in found.items()} == {
        "strict": 1,
        "relaxed": 2,
        "abrupt": 1,
    }
    assert found["relaxed"]["within_slack"] == found["abrupt"]["active"] == 1


def wall_depths(treatment: Treatment) -> Any:
    """Returns the depth in m of 50 g that a hand presses hard for 1.5 s and then lightly."""
    loop = loop_in("virtual_wall", "contact")
    treatment.apply(loop.scene.model, 0.0)
    set_tool_mass(loop.scene.model, "tool", 0.05)
    mujoco.mj_setConst(loop.scene.model, loop.scene.data)
    place = np.zeros((5, 3))
    place[:, 0] = 0.0, 0.0125, 0.0125, 0.0105, 0.0105
    device = SimulatedDevice(
        damping=5.0,
        hand=Hand(stiffness=2e4, damping=100.0),
        path=Motion([0, 0.2, 1.5, 1.6, 3], place),
    )
    outcome = loop.run(
        device, Coupling(2000.0, 2.0, 1.0, 1e-3), METHODS["implicit"], ticks=3000, keep_records=True
    )
    return outcome.records["tool_position"][:, 0] - 0.01


def test_a_damped_contact_comes_back_with_the_relaxation_time_that_the_rule_is_about() -> None:
    depth = wall_depths(DAMPED)
    left = depth[[1650, 1750]] - depth[-1]
    assert 0.1 / np.log(left[0] / left[1]) == pytest.approx(DAMPED.relaxation, rel=0.1)


@pytest.mark.parametrize("name", ["damped: 0.0005 8", "MuJoCo's default 0.02 1"])
def test_steady_depth_is_as_many_times_the_shipped_one_as_said(name: str) -> None:
    # the impedance rises with depth, so that deep contacts are stiffer than d₀ says
    shipped, other = wall_depths(Treatment()), wall_depths(TREATMENTS[name])
    ratio = float(other[-1] / shipped[-1])
    said = TREATMENTS[name].static_depth
    assert 0.35 * said < ratio < 1.05 * said


def test_points_are_about_as_many_as_asked_and_evaluate_to_numbers() -> None:
    assert abs(len(points(CONTACT.default_points)) - CONTACT.default_points) < 40
    first = next(p for p in points(1) if p["rig"] == "wall")
    found = evaluate(first)
    assert found["runs"] == found["strict"] + found["within_slack"] + found["active"]
