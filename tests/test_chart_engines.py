"""Other engines on a chart: the same judge finds a planted mistake in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import pytest

from hapticbridge.errors import StudyError
from hapticbridge.rendering import METHODS
from hapticbridge.study.chart import Extent, measure_chart, open_workload, peer_settings
from hapticbridge.study.chart import chart as chart_module
from hapticbridge.study.chart.engine_run import EngineRun
from hapticbridge.study.chart.setting import Setting
from hapticbridge.study.chart.workload import Workload
from hapticbridge.study.engines.base import Engine, Simulation
from hapticbridge.study.engines.base import Setting as EngineSetting
from hapticbridge.study.engines.library import open_engine
from hapticbridge.study.engines.task import Task

GRID, FINE = 4e-3, 1e-3


@lru_cache
def workload(name: str) -> Workload:
    """Returns a workload, made once."""
    return open_workload(name, Extent(GRID, FINE))


class Altered:
    """MuJoCo as a peer, with a mistake planted into its task."""

    name = "altered"
    version = "0"
    settings: Mapping[str, EngineSetting] = {}

    def __init__(self, factor: float) -> None:
        self._inner, self._factor = open_engine("mujoco"), factor

    def open(self, task: Task, timestep: float) -> Simulation:
        """Opens the task with another mass."""
        body = replace(task.body, mass=self._factor * task.body.mass)
        return self._inner.open(replace(task, body=body), timestep)


def score(engine: Engine, name: str, period: float) -> float:
    """Returns the error in JND in the first panel."""
    run = EngineRun(engine, workload(name).peer_work(), Setting(METHODS["explicit"], period))
    return run.scores()[workload(name).panels[0].key].felt


def test_mujoco_as_a_peer_errs_as_the_held_method_of_the_bridge_does() -> None:
    setting = Setting(METHODS["explicit"], FINE)
    own = workload("point_mass").run(setting).scores()["driven"]
    assert score(open_engine("mujoco"), "point_mass", FINE) == pytest.approx(own.felt, rel=1e-6)


def test_engine_with_a_wrong_mass_shows_as_a_worse_point() -> None:
    assert score(Altered(1.0), "point_mass", FINE) < 0.3
    assert score(Altered(1.2), "point_mass", FINE) > 1
    assert score(Altered(0.8), "point_mass", FINE) > 1


def test_engine_that_throws_the_tool_away_has_diverged_and_is_timed_as_far_as_it_came() -> None:
    # a mass far below what a held force can carry: m > (T/2)(K T/2 + B)
    run = EngineRun(
        Altered(1e-3), workload("point_mass").peer_work(), Setting(METHODS["explicit"], FINE)
    )
    found = run.scores()["driven"]
    assert found.verdict == "diverged"
    assert run.seconds < 0.5
    assert run.go() > 0


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
    assert point.score.verdict == "not metered"
    assert point.score.felt < 0.5
    assert not point.is_sound
    assert "implicitfast" in str(point.chosen["engine_settings"])
    assert "documentation" in str(point.chosen["engine_settings"])


def test_workloads_that_other_engines_cannot_be_given_are_left_out_with_a_sentence() -> None:
    settings = [Setting(METHODS["implicit"], FINE), *peer_settings(["mujoco"], [FINE])]
    chart = measure_chart(workload("rod_impact"), settings, repeats=1)
    assert chart.skipped == {
        "mujoco": "a rod that moves in a plane is not described to other engines"
    }
    assert len(chart.measurements) == 1


def test_engine_that_is_not_installed_is_left_out_with_a_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def missing(name: str) -> Engine:
        raise StudyError(f"engine '{name}' is not installed")

    monkeypatch.setattr(chart_module, "open_engine", missing)
    settings = [Setting(METHODS["implicit"], FINE), *peer_settings(["gone"], [FINE])]
    chart = measure_chart(workload("point_mass"), settings, repeats=1)
    assert chart.skipped == {"gone": "engine 'gone' is not installed"}


def test_engines_are_not_divided_into_substeps() -> None:
    work = workload("point_mass").peer_work()
    setting = Setting(METHODS["explicit"], FINE, substeps=2)
    with pytest.raises(StudyError, match="not divided into substeps"):
        EngineRun(open_engine("mujoco"), work, setting)


class Broken(Altered):
    """An engine whose library raises what this project does not know."""

    name = "broken"

    def open(self, task: Task, timestep: float) -> Simulation:
        """Fails at 1 ms, as a solver that finds no step."""
        if timestep == FINE:
            raise RuntimeError("no convergence")
        return super().open(task, timestep)


def test_engine_that_fails_at_one_step_is_named_and_ends_no_chart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(chart_module, "open_engine", lambda _name: Broken(1.0))
    settings = peer_settings(["broken"], [GRID, FINE])
    chart = measure_chart(workload("point_mass"), settings, repeats=1)
    said = "engine 'broken' failed at 1 ms: RuntimeError: no convergence"
    assert chart.skipped == {"broken": said}
    assert [each.setting.period for each in chart.measurements] == [GRID]
