"""Other engines on a chart: the same judge finds a planted mistake in them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import count

import numpy as np
import pytest
from engine_tasks import HERE

from hapticbridge.errors import StudyError
from hapticbridge.kernel.pose import Vector
from hapticbridge.lab.chart import chart as chart_module
from hapticbridge.lab.chart import contact_bodies
from hapticbridge.lab.chart.chart import Chart, Extent, measure_chart, open_workload
from hapticbridge.lab.chart.engine_run import EngineRun, Meter, peer_settings
from hapticbridge.lab.chart.output import summary_of
from hapticbridge.lab.chart.peg import JammedPeg
from hapticbridge.lab.chart.scene_run import Workload
from hapticbridge.lab.chart.score import PeerWork
from hapticbridge.lab.chart.setting import OWN, Setting
from hapticbridge.lab.engines import mujoco as mujoco_engine
from hapticbridge.lab.engines.base import (
    Body,
    Engine,
    FreeBody,
    Pose,
    Simulation,
    Task,
    composed,
    open_engine,
)
from hapticbridge.lab.methods import METHODS

GRID, FINE = 4e-3, 1e-3


@lru_cache
def workload(name: str) -> Workload:
    """Returns a workload, made once."""
    return open_workload(name, Extent(GRID, FINE))


def altered(
    factor: float = 1.0,
    friction: float = 1.0,
    *,
    fails_at: int | None = None,
    error: type[Exception] = RuntimeError,
) -> Engine:
    """Returns MuJoCo as a peer, with mistakes planted into its task and its steps.

    Args:
        factor: Of the mass.
        friction: Factor of the friction.
        fails_at: Step in which it raises, at the finer timestep only; never, if None.
        error: What it raises.
    """
    inner = open_engine("mujoco")

    def opened(task: Task, timestep: float) -> Simulation:
        body = replace(
            task.body, mass=factor * task.body.mass, friction=friction * task.body.friction
        )
        simulation = inner.open(replace(task, body=body), timestep)
        advance, steps = simulation.advance, count(1)

        def failing(force: Vector, torque: Vector) -> None:
            if next(steps) == fails_at and timestep < GRID:
                raise error("no\nconvergence")
            advance(force, torque)

        simulation.advance = failing  # type: ignore[method-assign]
        return simulation

    return Engine("altered", "0", {}, opened)


def score(engine: Engine, name: str, period: float) -> float:
    """Returns the error in JND in the first panel."""
    run = EngineRun(engine, workload(name).peer_work(), Setting(METHODS["explicit"], period))
    return run.scores()[workload(name).panels[0].key].jnd


def test_mujoco_as_a_peer_errs_as_the_held_method_of_the_bridge_does() -> None:
    setting = Setting(METHODS["explicit"], FINE)
    own = workload("point_mass").run(setting).scores()["driven"]
    assert score(open_engine("mujoco"), "point_mass", FINE) == pytest.approx(own.jnd, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "least", "mistake", "most"),
    [
        ("point_mass", 0.3, altered(1.2), 1.0),
        ("point_mass", 0.3, altered(0.8), 1.0),
        ("sliding_block", 0.3, altered(friction=1.2), 2.0),
        ("sliding_block", 0.3, altered(friction=0.8), 2.0),
        # as the bridge's own: contacts of two steps throw the rod back by a fifth; with the
        # inertia left as it is, or all would fall alike
        ("rod_impact", 6.0, altered(0.5), 7.0),
    ],
)
def test_engine_with_a_wrong_mass_or_friction_shows_as_a_worse_point(
    name: str, least: float, mistake: Engine, most: float
) -> None:
    assert score(open_engine("mujoco"), name, FINE) < least
    assert score(mistake, name, FINE) > most


@pytest.mark.parametrize("name", [name for name in HERE.available if name != "mujoco"])
def test_peg_that_leans_and_rod_that_taps_touch_and_rest_in_every_engine(name: str) -> None:
    engine = HERE.available[name]
    work = workload("peg_in_hole").peer_work()
    run = EngineRun(engine, work, Setting(METHODS["explicit"], FINE))
    settled = run.scores()["settled"]
    # a verdict on its energy: it touches at the end of every hold
    assert settled.verdict in ("strict", "within slack", "active")
    # 31 µm where PhysX keeps the contacts of the upright peg; Drake's compliant ones give way, and
    # those of MuJoCo Warp come and go
    apart = {"mujoco_warp": 30e-6, "drake_point": 20e-6, "drake_hydroelastic": 20e-6}
    assert settled.position_peak < apart.get(name, 5e-6)
    rod = EngineRun(engine, workload("rod_impact").peer_work(), Setting(METHODS["explicit"], FINE))
    assert rod.scores()["impact"].verdict in ("strict", "within slack", "active")


def test_meter_of_a_peer_reads_as_the_ledger_of_the_bridge(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # with the impedance of the scene, MuJoCo as a peer is the bridge's own held force
    monkeypatch.setattr(mujoco_engine, "IMPEDANCE", (0.9, 0.95, 0.001, 0.5, 2.0))
    jam = JammedPeg(mass=0.1, friction=0.0, stiffness=6000.0, hand=0)
    held = METHODS["explicit:implicitfast"]
    own, peer = (jam.take(Setting(held, FINE, engine=name)) for name in (OWN, "mujoco"))
    energies = [take.records["environment_energy"] for take in (own, peer)]
    assert np.abs(energies[0]).max() > 1e-3
    assert energies[1] == pytest.approx(energies[0], abs=5e-5)
    assert peer.meter.slack_share == pytest.approx(own.meter.slack_share, rel=1e-3)
    assert (own.environment, peer.environment) == ("within slack", "within slack")
    # the contacts create nothing here: it is the held force that does
    assert peer.engine.verdict == "strict"


def test_meter_of_a_peer_counts_the_energy_of_every_body() -> None:
    period, steps, gravity = 1e-3, 100, 9.81
    other = FreeBody(Body(0.5, (1e-3,) * 3), Pose((1.0, 0.0, 0.0)))
    task = Task("fall", Body(0.3, (1e-3,) * 3), gravity=(0.0, 0.0, -gravity), others=(other,))
    simulation = open_engine("mujoco").open(task, period)
    meter = Meter(simulation, task, period, simulation.wrench)
    for _ in range(steps):
        simulation.advance((0.0,) * 3, (0.0,) * 3)
        meter.close_step()
    # the new velocity moves a body by g T²/2 too far in each step
    lost = -0.5 * (0.3 + 0.5) * gravity**2 * period**2 * steps
    assert meter.energy == pytest.approx(lost, rel=1e-9)


def test_spinning_body_spins_in_another_engine_too() -> None:
    felt = score(open_engine("mujoco"), "spinning_body", FINE)
    assert 20 < felt < 50  # Euler's first order at 1 ms, as the bridge's own held methods
    assert score(open_engine("mujoco"), "spinning_body", GRID) > 2 * felt


def test_peers_are_points_at_every_step_and_only_where_the_reference_is_true() -> None:
    settings = peer_settings(["mujoco"], [GRID, FINE])
    assert [(each.engine, each.period) for each in settings] == [("mujoco", GRID), ("mujoco", FINE)]
    assert settings[0].label == "mujoco, held force, 4 ms"
    chart = measure_chart(workload("peg_in_hole"), settings[1:], repeats=1)
    assert {each.panel for each in chart.measurements} == {"settled"}
    (point,) = chart.measurements
    assert point.score.verdict == "within slack"  # a held force creates energy
    assert point.score.jnd < 0.5
    assert "implicitfast" in str(point.chosen["engine_settings"])
    assert "documentation" in str(point.chosen["engine_settings"])


def test_workloads_that_other_engines_cannot_be_given_are_left_out_with_a_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuses() -> PeerWork:
        raise StudyError("it has tendons")

    monkeypatch.setattr(workload("point_mass"), "peer_work", refuses)
    settings = [Setting(METHODS["implicit"], FINE), *peer_settings(["mujoco"], [FINE])]
    chart = measure_chart(workload("point_mass"), settings, repeats=1)
    assert chart.skipped == {"mujoco": "it has tendons"}
    assert len(chart.measurements) == 1


def test_free_rod_begins_where_the_rod_of_the_plane_does() -> None:
    scene = contact_bodies.rod_scene()
    for angle in contact_bodies.ANGLES:
        contact_bodies.falls_at(angle)(scene)
        task = contact_bodies.free_fall(angle)
        tip = composed(task.start, task.body.shapes[0].pose)
        assert tip.position == pytest.approx(scene.data.geom("tip").xpos, abs=1e-12)
        assert composed(task.start, task.grip).position == pytest.approx(
            scene.data.site("grip").xpos, abs=1e-12
        )
        assert task.start_velocity.linear == (contact_bodies.SLIDE, 0.0, -contact_bodies.APPROACH)
        # about the axis that the plane's rod turns about, the moments are the same
        assert task.body.inertia[1] == pytest.approx(scene.model.body("rod").inertia[1])


def test_engines_are_not_divided_into_substeps() -> None:
    work = workload("point_mass").peer_work()
    setting = Setting(METHODS["explicit"], FINE, substeps=2)
    with pytest.raises(StudyError, match="not divided into substeps"):
        EngineRun(open_engine("mujoco"), work, setting)


def chart_with(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> Chart:
    """Returns a chart of the bridge and of an engine, at two steps each."""
    monkeypatch.setattr(chart_module, "open_engine", lambda _name: engine)
    settings = [
        *(Setting(METHODS["implicit"], period) for period in (GRID, FINE)),
        *peer_settings([engine.name], [GRID, FINE]),
    ]
    return measure_chart(workload("point_mass"), settings, repeats=1)


@pytest.mark.parametrize("error", [RuntimeError, StudyError])
def test_engine_that_fails_on_the_way_is_a_mark_with_its_reason(
    monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    engine = altered(fails_at=301, error=error)
    chart = chart_with(engine, monkeypatch)
    assert chart.skipped == {}
    whole, broken = (each for each in chart.measurements if each.setting.engine == "altered")
    assert (whole.setting.period, whole.score.verdict, whole.score.reason) == (
        GRID,
        "within slack",
        "",
    )
    assert broken.score.verdict == "failed"
    said = f"raised {error.__name__}: no convergence after 0.3 s"
    assert broken.score.reason == said
    assert broken.cost.median > 0  # of the 300 steps that it came
    point = next(p for p in summary_of(chart)["points"] if p["error_verdict"] == "failed")
    assert point["error_reason"] == said
    assert point["error_jnd"] is None


def test_engine_that_fails_while_it_is_timed_loses_those_rounds_alone() -> None:
    setting = Setting(METHODS["explicit"], FINE)
    run = EngineRun(altered(), workload("point_mass").peer_work(), setting)
    run.scores()
    assert run.run() > 0
    run.engine = altered(fails_at=10)
    assert np.isnan(run.run())


def test_engine_that_throws_the_tool_away_has_diverged_and_is_timed_as_far_as_it_came(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # a mass far below what a held force can carry: m > (T/2)(K T/2 + B)
    chart = chart_with(altered(1e-3), monkeypatch)
    found = [each for each in chart.measurements if each.setting.engine == "altered"]
    assert [each.score.verdict for each in found] == ["diverged", "diverged"]
    assert all(each.score.reason.startswith("the tool was 10 m away after 0.") for each in found)
    assert all(each.cost.median > 0 for each in found)
