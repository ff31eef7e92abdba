"""How the errors of a chart go with the time step, and what a planted mistake does to them."""

from __future__ import annotations

from functools import lru_cache

import mujoco
import numpy as np
import pytest
from chart_cases import made_up

from hapticbridge.lab.chart import contact_bodies, free_bodies
from hapticbridge.lab.chart.catalogue import Extent, open_workload
from hapticbridge.lab.chart.chart import convergence_orders, measure_chart
from hapticbridge.lab.chart.peg import COUPLING as PEG_COUPLING
from hapticbridge.lab.chart.peg import PegInHole
from hapticbridge.lab.chart.scene_run import COUPLING, OwnReferences
from hapticbridge.lab.chart.setting import Setting
from hapticbridge.lab.chart.workload import Score, Workload
from hapticbridge.lab.maps.base import set_tool_mass
from hapticbridge.lab.methods import METHODS
from hapticbridge.scene import Scene, load_scene

GRID = 4e-3
FINE = (5e-4, 2.5e-4, 1.25e-4)


@lru_cache
def driven() -> Workload:
    """Returns the driven mass, made once."""
    return open_workload("point_mass", Extent(GRID, FINE[-1]))


@lru_cache
def spinning() -> Workload:
    """Returns the spinning body, made once."""
    return open_workload("spinning_body", Extent(GRID, FINE[-1]))


def score(workload: Workload, method: str, period: float) -> Score:
    """Returns the score in the first panel."""
    run = workload.run(Setting(METHODS[method], period))
    return run.scores()[workload.panels[0].key]


def order(errors: list[float], periods: tuple[float, ...] = FINE) -> float:
    """Returns the power of the period that the errors go with."""
    return float(np.polyfit(np.log(periods), np.log(errors), 1)[0])


def test_order_is_the_slope_at_the_three_smallest_steps() -> None:
    periods = (4e-3, 1e-3, 5e-4, 2.5e-4)
    points = [made_up(1.0, 1e6 * p**2, period=p) for p in periods[1:]]
    points += [made_up(1.0, 7.0, period=periods[0]), made_up(1.0, 3.0, period=2.5e-4, substeps=2)]
    order = convergence_orders(points)["implicit"]
    assert order.power == pytest.approx(2.0)
    assert (order.finest, order.coarsest) == (2.5e-4, 1e-3)
    assert order.words == "order 2.0"
    assert not convergence_orders(points[:2])


def test_order_that_the_next_step_contradicts_is_not_told() -> None:
    def words(*errors: float) -> str:
        steps = (2.5e-4, 1e-3, 4e-3)
        points = [made_up(1.0, e, period=p) for e, p in zip(errors, steps, strict=True)]
        return convergence_orders(points)["implicit"].words

    assert words(0.65, 1.8, 3.4) == "order ?"  # 'implicit' on the point mass at quick steps
    assert words(0.1, 0.4, 1.6) == "order 1.0"
    assert words(0.1, 0.4, 1.4) == "order 1.0"  # 0.1 of a power off
    assert words(0.1, 0.4, 1.3) == "order ?"
    assert words(0.08, 0.08, 0.084) == "level"
    assert words(0.08, 0.08, 0.3) == "order ?"


def test_no_order_is_taken_from_errors_that_a_reference_may_have_itself() -> None:
    points = [made_up(1.0, 1e8 * p**4, period=p) for p in (4e-3, 2e-3, 1e-3)]
    assert convergence_orders(points)["implicit"].power == pytest.approx(4.0)
    unresolved = [made_up(1.0, 2e-6, period=p) for p in (5e-4, 2.5e-4)]
    assert convergence_orders([*points, *unresolved])["implicit"].power == pytest.approx(4.0)
    assert not convergence_orders([*points[:2], *unresolved])


@pytest.mark.parametrize(
    ("method", "expected"),
    [("implicit", 1), ("compensated", 1), ("explicit", 1), ("implicitfast", 1), ("lossless", 2)],
)
def test_place_of_a_driven_mass_converges_with_the_order_of_its_method(
    method: str, expected: int
) -> None:
    errors = [score(driven(), method, period).position_peak for period in FINE]
    assert order(errors) == pytest.approx(expected, abs=0.12)


def test_rk4_turns_a_free_body_with_fourth_order_and_euler_with_first() -> None:
    periods = (4e-3, 2e-3, 1e-3)
    # the energy of a step is one order better than the motion; five is what rk4 leaves of four
    rk4 = [score(spinning(), "explicit:rk4", period).energy for period in periods]
    assert 3.8 < order(rk4, periods) < 5.2
    # the motion itself, above what the reference errs by
    periods = (8e-3, 4e-3, 2e-3)
    workload = open_workload("spinning_body", Extent(periods[0], periods[-1]))
    found = [score(workload, "explicit:rk4", period) for period in periods]
    assert order([each.angle_peak for each in found], periods) == pytest.approx(4, abs=0.3)
    assert order([each.jnd for each in found], periods) == pytest.approx(4, abs=0.3)
    euler = [score(spinning(), "explicit", period).angle_peak for period in FINE]
    assert order(euler) == pytest.approx(1, abs=0.05)
    lossless = [score(spinning(), "lossless", period).angle_peak for period in FINE]
    assert order(lossless) == pytest.approx(2, abs=0.05)


def test_energy_alone_would_not_tell_a_wrong_spin() -> None:
    # implicitfast loses energy and Euler creates it, the error of the angle is the same
    lossy, active = (score(spinning(), name, 1e-3) for name in ("implicitfast", "explicit"))
    assert lossy.verdict == "strict"
    assert active.verdict == "active"
    assert lossy.jnd == pytest.approx(active.jnd, rel=0.02)


def test_wrong_mass_shows_as_a_worse_point(monkeypatch: pytest.MonkeyPatch) -> None:
    right = score(driven(), "explicit", 5e-4)

    def heavier(name: str) -> Scene:
        scene = load_scene(name)
        set_tool_mass(scene.model, "tool", 1.1 * free_bodies.DRIVEN_MASS)
        mujoco.mj_setConst(scene.model, scene.data)
        return scene

    monkeypatch.setattr(free_bodies, "load_scene", heavier)
    wrong = score(free_bodies.DrivenMass(COUPLING, GRID, FINE[-1]), "explicit", 5e-4)
    assert wrong.jnd > 5 * right.jnd
    assert wrong.jnd > 1


def test_coupling_that_would_turn_the_spinning_body_is_refused() -> None:
    with pytest.raises(Exception, match="free to turn"):
        free_bodies.SpinningBody(COUPLING, GRID, FINE[-1])


def test_methods_without_dynamics_of_the_tool_can_neither_spin_nor_fall() -> None:
    falling = contact_bodies.RodImpact(contact_bodies.ROD_COUPLING, GRID)
    for name in ("weld", "direct"):
        with pytest.raises(Exception, match="lets no tool turn"):
            spinning().run(Setting(METHODS[name], 1e-3))
        with pytest.raises(Exception, match="lets no tool fall"):
            falling.run(Setting(METHODS[name], 1e-3))


def test_rod_that_meets_a_damped_contact_is_nearer_to_an_impact_without_rebound() -> None:
    workload = contact_bodies.RodImpact(contact_bodies.ROD_COUPLING, GRID)
    key = workload.panels[0].key
    shipped = workload.run(Setting(METHODS["implicit"], 1e-3)).scores()[key]
    damped = workload.run(Setting(METHODS["implicit"], 1e-3, contact="damped")).scores()[key]
    assert damped.jnd < shipped.jnd / 2


@lru_cache
def peg() -> PegInHole:
    """Returns the peg, with a reference that is quick rather than fine."""
    return PegInHole(PEG_COUPLING, GRID, 1e-3, refinement=4)


def test_settled_peg_is_nearer_to_the_rigid_one_the_stiffer_its_contacts() -> None:
    stiff, soft = (
        peg().run(Setting(METHODS["implicit"], 1e-3, contact=contact)).scores()["settled"]
        for contact in ("2 steps", "soft")
    )
    assert stiff.position_peak < 2e-5
    assert stiff.jnd < 0.2
    assert abs(stiff.stiffness) < 0.02
    assert soft.position_peak > 10 * stiff.position_peak
    assert soft.jnd > 1


def test_peg_that_never_reaches_its_hole_has_lost_contact() -> None:
    run = peg().run(Setting(METHODS["explicit:implicitfast"], 4e-3))
    assert run.scores()["settled"].verdict in ("lost contact", "diverged")


def test_methods_agree_on_where_the_moving_peg_goes_in_the_limit() -> None:
    for name in ("implicit", "explicit", "weld"):
        peg().run(Setting(METHODS[name], 2e-3)).scores()
    references = peg().references
    assert isinstance(references, OwnReferences)
    apart = references.disagreement()
    assert apart["explicit"] < 0.3
    assert apart["implicit"] < 0.3
    assert apart["weld"] > 3  # another stiffness than was asked for: converged, and not to the same


def test_measured_points_carry_how_far_the_limit_of_their_method_lies() -> None:
    workload = PegInHole(PEG_COUPLING, GRID, GRID, refinement=2)
    settings = [Setting(METHODS[name], GRID) for name in ("implicit", "weld")]
    found = measure_chart(workload, settings, repeats=1)
    apart = {
        (each.panel, each.setting.method.name): each.limit_apart for each in found.measurements
    }
    assert apart["moving", "implicit"] == 0.0
    assert apart["moving", "weld"] > 3
    # the settled peg is compared with one truth
    assert apart["settled", "weld"] == apart["settled", "implicit"] == 0.0
    assert "implicit, in JND: weld" in found.notes[0]


def test_central_limit_is_one_of_the_coupling_that_was_asked_for() -> None:
    workload = PegInHole(PEG_COUPLING, GRID, 4e-3, refinement=2)
    for name in ("weld", "direct", "implicit"):
        workload.run(Setting(METHODS[name], GRID)).scores()
    assert workload.references is not None
    apart = workload.references.disagreement()
    assert apart["implicit"] == 0.0
    assert min(apart["weld"], apart["direct"]) > 3


@pytest.mark.parametrize("method", ["implicit", "compensated", "implicitfast", "explicit"])
def test_sliding_block_converges_to_the_closed_form(method: str) -> None:
    workload = open_workload("sliding_block", Extent(GRID, FINE[-1]))
    coarse, fine = (score(workload, method, period) for period in (1e-3, 2.5e-4))
    assert fine.jnd < coarse.jnd / 2
    assert fine.position_peak < 3e-5
    assert fine.verdict == "strict"


def test_reference_of_a_scene_is_said_to_be_no_truth() -> None:
    workload = open_workload("virtual_wall", Extent(GRID, 1e-3))
    assert not workload.panels[0].is_truth
    found = [score(workload, "implicit", period).jnd for period in (4e-3, 1e-3)]
    assert found[1] < found[0]
    with pytest.raises(Exception, match="no reference that is true for every engine"):
        workload.peer_work()
