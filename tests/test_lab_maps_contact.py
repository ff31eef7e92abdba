"""The map ``contact``: contacts that create energy on a wall and in a hole, and rigid ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_runs import boundary_of

from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.lab.maps import contact
from hapticbridge.lab.maps import contact_rigs as rigs
from hapticbridge.lab.maps.base import PERIOD, loop_in
from hapticbridge.lab.maps.contact_rigs import Case, ContactRun, Treatment, run_cases
from hapticbridge.lab.methods import METHODS
from hapticbridge.scene.contacts import SUGGESTED, contact_numbers

LIGHT = rigs.WORST
"""A peg of 30 g without friction in a random hand: the hardest case of the map."""

DAMPED = Treatment(solref=(SUGGESTED[0] * PERIOD, SUGGESTED[1]))
ON_WALL = [Case("wall", 2000.0, mass, 0.0, hand) for mass in (0.01, 0.05, 0.2) for hand in (-1, -2)]


def one(treatment: Treatment, case: Case) -> ContactRun:
    (run,) = run_cases(treatment, [case])
    return run


def test_light_frictionless_peg_is_active_as_shipped_strict_but_deep_damped_and_both_rigid() -> (
    None
):
    shipped = one(rigs.SCENE, LIGHT)
    assert shipped.environment == "active"
    assert shipped.created > 1e-3
    assert shipped.first_active > 500
    damped = one(DAMPED, LIGHT)
    assert damped.environment == "strict"
    assert damped.median_depth > 50e-6
    for name in ("rigid", "rigid, lossless"):
        rigid = one(rigs.TREATMENTS[name], LIGHT)
        assert rigid.environment == "strict"
        assert rigid.created <= 1e-9
        assert rigid.peak_force > 3
        assert rigid.depth < 10e-6
        assert rigid.median_depth < 2e-6


def test_pyramidal_cone_creates_energy_where_friction_is_low_and_the_elliptic_one_does_not() -> (
    None
):
    slippery = [Case("peg", 1000.0, 0.03, 0.1, hand) for hand in (1, 3, 5)]
    soft = Treatment(solref=(0.02, 1.0))
    pyramidal = list(run_cases(replace(soft, cone="pyramidal"), slippery))
    assert max(run.created for run in pyramidal) > 1e-3
    assert {run.environment for run in run_cases(soft, slippery)} == {"strict"}
    rigid = run_cases(Treatment("rigid", cone="pyramidal"), slippery)
    assert {run.environment for run in rigid} == {"strict"}


@pytest.mark.parametrize("stiffness", [2000.0, 20_000.0])
def test_implicitfast_creates_energy_on_a_wall_where_implicit_creates_none(
    stiffness: float,
) -> None:
    cases = [replace(case, stiffness=stiffness) for case in ON_WALL]
    for treatment in (DAMPED, rigs.RIGID):
        assert {run.environment for run in run_cases(treatment, cases)} == {"strict"}
    fast = run_cases(replace(DAMPED, method="implicitfast"), cases)
    assert max(run.created for run in fast) > 1e-4


def test_bouncing_contact_is_active_on_a_wall_and_a_critically_damped_one_is_not() -> None:
    case = Case("wall", 2000.0, 0.05, 0.0, -2)
    bouncing = one(Treatment(solref=(0.02, 0.3)), case)
    assert bouncing.environment == "active"
    assert bouncing.first_active > 0
    assert one(Treatment(solref=(0.02, 2.0)), case).environment == "strict"


def test_on_the_same_device_a_jamming_peg_creates_about_as_much_energy_by_every_method() -> None:
    lossless, implicit, compensated = (
        rigs.contact_run(rigs.run_case(Treatment(method=method), LIGHT, same_law=True))
        for method in ("lossless", "implicit", "compensated")
    )
    assert implicit == compensated
    assert lossless.environment == implicit.environment == "active"
    assert lossless.slack_share == pytest.approx(implicit.slack_share, rel=0.3)


def test_a_treatment_and_a_mass_set_before_leave_no_trace_in_a_run() -> None:
    alone = one(rigs.SCENE, LIGHT)
    one(rigs.RIGID, replace(LIGHT, mass=0.37, friction=0.4))
    list(run_cases(replace(DAMPED, cone="pyramidal"), [replace(LIGHT, mass=0.1)]))
    assert one(rigs.SCENE, LIGHT) == alone


def test_treatments_reach_the_model_whatever_was_set_before() -> None:
    scene = loop_in(rigs.RIGS["peg"].load, "contact").scene
    pyramidal = Treatment(cone="pyramidal")
    for treatment in [*rigs.TREATMENTS.values(), pyramidal, rigs.SCENE]:
        for friction, condim in ((0.3, 3), (0.0, 1)):
            treatment.apply(scene, Case("peg", friction=friction, mass=0.2))
            assert set(scene.model.geom_condim.tolist()) == {condim}
            assert set(scene.model.geom_friction[:, 0].tolist()) == {friction}
            assert scene.model.opt.cone == (treatment.cone == "elliptic")
            assert tuple(scene.model.geom_solref[0]) == treatment.solref
            assert scene.model.body("tool").mass[0] == 0.2


def test_every_rig_touches_in_every_hand_and_moves_its_tool() -> None:
    for name in rigs.RIGS:
        for case in contact.cases_of(name)[:2]:
            outcome = rigs.run_case(rigs.RIGID, case, keep_records=True)
            # along its own path a soft coupling does not reach the end of the drawer
            is_soft_drawer = (name, case.hand) == ("drawer", 0)
            assert is_soft_drawer or (outcome.records["contacts"] > 0).sum() > 20, case
            assert outcome.peak_force > 0.3, case
            assert np.ptp(outcome.records["tool_position"], axis=0).max() > 1e-4, case


def test_map_at_reduced_resolution_agrees_with_the_rule_and_has_rigid_contacts_strict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contact, "cases_of", lambda rig: [replace(LIGHT, rig=rig)])
    monkeypatch.setitem(contact.GRID_CASES, "peg", ((0.03, 0.0, 5),))
    points = contact.points
    monkeypatch.setattr(contact, "points", lambda _: points(1))
    boundary = boundary_of(
        contact,
        tmp_path,
        4,
        lambda p: p["rig"] in ("peg", "stack") and p["method"] != "lossless",
    )
    rule = boundary["rule"]
    assert rule["strict"]["strict"] == rule["strict"]["cells"] > 0
    assert rule["abrupt"]["strict"] < rule["abrupt"]["cells"]
    found = {one["treatment"]: one for one in boundary["compared"] if not one["rig"]}
    assert found["as shipped, 0.002 1"]["active"] == 1
    for name in ("damped, 0.0005 8", "rigid"):
        assert found[name]["strict"] == found[name]["runs"] == 2
    assert found["rigid"]["largest_depth"] < 0.1 * found["damped, 0.0005 8"]["largest_depth"]


def wall_depths(treatment: Treatment) -> Any:
    """Returns the depth in m of 50 g that a hand presses hard for 1.5 s and then lightly."""
    loop = loop_in(rigs.RIGS["wall"].load, "contact")
    treatment.apply(loop.scene, Case("wall", mass=0.05, friction=0.0))
    place = np.zeros((5, 3))
    place[:, 0] = 0.0, 0.0125, 0.0125, 0.0105, 0.0105
    device = SimulatedDevice(
        damping=5.0,
        hand=Hand(stiffness=2e4, damping=100.0),
        path=Motion([0, 0.2, 1.5, 1.6, 3], place),
    )
    method = METHODS["implicit"].with_contact(treatment.contact)
    coupling = Coupling(2000.0, 2.0, 1.0, 1e-3)
    outcome = loop.run(device, coupling, method, ticks=3000, keep_records=True)
    return outcome.records["tool_position"][:, 0] - 0.01


def test_a_damped_contact_comes_back_with_the_relaxation_time_that_the_rule_is_about() -> None:
    depth = wall_depths(DAMPED)
    left = depth[[1650, 1750]] - depth[-1]
    numbers = contact_numbers(DAMPED.solref, rigs.SHIPPED_SOLIMP, PERIOD)
    relaxation = numbers.relaxation * PERIOD
    assert 0.1 / np.log(left[0] / left[1]) == pytest.approx(relaxation, rel=0.1)


def test_a_rigid_contact_is_back_at_the_surface_at_once_where_the_others_take_their_time() -> None:
    depth = wall_depths(rigs.RIGID)
    assert depth.max() < 2e-6
    assert abs(depth[1650] - depth[-1]) < 1e-7
