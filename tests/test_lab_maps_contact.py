"""The map ``contact``: what creates energy on a wall and in a hole, and what does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from map_runs import boundary_of

from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.lab.maps import contact
from hapticbridge.lab.maps import contact_rigs as rigs
from hapticbridge.lab.maps.base import loop_in, set_tool_mass
from hapticbridge.lab.maps.contact import method_runs
from hapticbridge.lab.methods import METHODS
from hapticbridge.scene.contacts import SUGGESTED

LIGHT = [(0.03, 0.0, 1)]
"""A peg of 30 g without friction in the first random hand: the hardest case of the search."""

LIGHT_AT_MOUTH = (1000.0, *LIGHT[0])
"""The same in and out of the hole, at 1000 N/m."""

DAMPED = rigs.Treatment((SUGGESTED[0] * rigs.PERIOD, SUGGESTED[1]))


def test_light_frictionless_peg_goes_beyond_the_slack_as_shipped_and_not_damped() -> None:
    (shipped,) = rigs.peg_runs(rigs.Treatment(), 1000.0, LIGHT)
    assert shipped.environment == "active"
    assert shipped.created > 1e-3
    assert 50 < shipped.first_active < 500
    (damped,) = rigs.peg_runs(DAMPED, 1000.0, LIGHT)
    assert damped.environment == "strict"
    assert damped.created <= 0
    assert damped.first_active == -1
    assert damped.peak_force > 3
    assert damped.depth < 1.5 * shipped.depth


def test_strict_contact_need_not_be_softer_than_the_shipped_one() -> None:
    hard = rigs.TREATMENTS["damped hard: 0.00002 100"]
    for k in (1000.0, 6000.0):
        (run,) = rigs.peg_runs(hard, k, LIGHT)
        (shipped,) = rigs.peg_runs(rigs.Treatment(), k, LIGHT)
        assert run.environment == "strict"
        assert run.depth < shipped.depth


def test_four_substeps_with_the_rule_in_their_own_steps_are_strict_and_stiffer() -> None:
    (finer,) = rigs.peg_runs(rigs.TREATMENTS["4 substeps, 0.0005 4"], 1000.0, LIGHT)
    (whole,) = rigs.peg_runs(DAMPED, 1000.0, LIGHT)
    assert finer.environment == "strict"
    assert finer.depth < 0.5 * whole.depth


def test_pyramidal_cone_is_active_where_friction_is_low_and_the_elliptic_one_is_not() -> None:
    slippery = [(0.03, 0.1, hand) for hand in (0, 1, 2)]
    soft = rigs.Treatment((0.02, 1.0))
    pyramidal = list(rigs.peg_runs(replace(soft, cone="pyramidal"), 1000.0, slippery))
    assert max(run.slack_share for run in pyramidal) > 1.5
    assert max(run.first_active for run in pyramidal) > 0
    assert {run.environment for run in rigs.peg_runs(soft, 1000.0, slippery)} == {"strict"}


@pytest.mark.parametrize("stiffness", [2000.0, 20_000.0])
def test_implicitfast_creates_energy_on_a_wall_where_implicit_creates_none(
    stiffness: float,
) -> None:
    implicit = list(rigs.wall_runs(DAMPED, stiffness))
    assert {run.environment for run in implicit} == {"strict"}
    fast = rigs.wall_runs(replace(DAMPED, method="implicitfast"), stiffness)
    assert max(run.created for run in fast) > 1e-4


def test_bouncing_contact_is_active_on_a_wall_and_a_critically_damped_one_is_not() -> None:
    (bouncing,) = rigs.wall_runs(rigs.Treatment((0.02, 0.3)), 2000.0, [(0.05, 1)])
    assert bouncing.environment == "active"
    assert bouncing.first_active > 0
    (damped,) = rigs.wall_runs(rigs.Treatment((0.02, 2.0)), 2000.0, [(0.05, 1)])
    assert damped.environment == "strict"


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


def test_a_mass_set_before_leaves_no_trace_in_a_run() -> None:
    (alone,) = rigs.peg_runs(rigs.Treatment(), 1000.0, LIGHT)
    list(rigs.peg_runs(rigs.Treatment(), 1000.0, [(0.1, 0.0, 1), (0.37, 0.0, 1)]))
    (after,) = rigs.peg_runs(rigs.Treatment(), 1000.0, LIGHT)
    assert after == alone


def test_map_at_reduced_resolution_agrees_with_the_rule(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def few(treatment: rigs.Treatment, stiffness: float, *_: Any) -> Any:
        return rigs.peg_runs(treatment, stiffness, LIGHT)

    monkeypatch.setattr(contact, "peg_runs", few)
    names = (rigs.SHIPPED, "damped: 0.0005 8")
    monkeypatch.setattr(contact, "HANDS", 1)
    points = contact.points
    monkeypatch.setattr(contact, "points", lambda _: points(1))
    boundary = boundary_of(
        contact,
        tmp_path,
        4,
        lambda p: p["rig"] == "peg" or (p["rig"] == "search" and p["treatment"] in names),
    )
    rule = boundary["rule"]
    assert rule["strict"]["strict"] == rule["strict"]["cells"] > 0
    assert rule["abrupt"]["strict"] < rule["abrupt"]["cells"]
    shipped, damped = boundary["search"]
    assert shipped["active"] > 0
    assert damped["strict"] == damped["runs"]


def test_treatments_reach_the_model_whatever_was_set_before() -> None:
    model = loop_in("virtual_wall", "contact").scene.model
    exact = int(mujoco.mjtEnableBit.mjENBL_DIAGEXACT)
    safe = int(mujoco.mjtDisableBit.mjDSBL_REFSAFE)
    for treatment in [*rigs.TREATMENTS.values(), rigs.Treatment()]:
        treatment.apply(model, 0.3)
        assert set(model.geom_condim.tolist()) == {treatment.condim}
        assert bool(model.opt.enableflags & exact) == treatment.diagexact
        assert bool(model.opt.disableflags & safe) != treatment.refsafe
        assert model.opt.cone == (treatment.cone == "elliptic")
        assert tuple(model.opt.o_solref) == treatment.solref
        assert tuple(model.opt.o_solimp[:3]) == treatment.solimp
        assert model.opt.o_friction[0] == 0.3


def wall_depths(treatment: rigs.Treatment) -> Any:
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
    shipped, other = wall_depths(rigs.Treatment()), wall_depths(rigs.TREATMENTS[name])
    ratio = float(other[-1] / shipped[-1])
    said = rigs.TREATMENTS[name].static_depth
    assert 0.35 * said < ratio < 1.05 * said
