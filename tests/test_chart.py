"""The chart: its points, its timing, its front and what it recommends, its files."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chart_cases import FakeRun, small_chart

from hapticbridge.cli import main
from hapticbridge.errors import StudyError
from hapticbridge.kernel.codes import Scheme
from hapticbridge.lab.chart.catalogue import Extent, open_workload
from hapticbridge.lab.chart.chart import Chart, interleaved_costs, measure_chart, pareto_front
from hapticbridge.lab.chart.output import prepared_files, write_chart
from hapticbridge.lab.chart.setting import (
    CONTACTS,
    SHIPPED,
    Setting,
    chosen_methods,
    chosen_periods,
    settings_for,
)
from hapticbridge.lab.methods import METHODS


def test_front_is_what_no_other_point_beats() -> None:
    costs = [1.0, 2.0, 3.0, 2.0, 4.0, 1.0]
    errors = [9.0, 4.0, 4.0, 5.0, 1.0, 8.0]
    assert pareto_front(costs, errors) == [5, 1, 4]


def test_front_of_random_points_beats_all_others_and_itself_never() -> None:
    generator = np.random.default_rng(5)
    points = generator.integers(0, 12, (200, 2)).astype(float)
    front = pareto_front(points[:, 0].tolist(), points[:, 1].tolist())

    def beats(a: int, b: int) -> bool:
        return bool((points[a] <= points[b]).all() and (points[a] < points[b]).any())

    assert not any(beats(a, b) for a in front for b in front)
    same = {tuple(points[i]) for i in front}
    for b in set(range(200)) - set(front):
        assert tuple(points[b]) in same or any(beats(a, b) for a in front)


def test_front_leaves_out_what_has_no_error_or_no_cost() -> None:
    assert pareto_front([1.0, 2.0, np.nan], [np.inf, 3.0, 1.0]) == [1]
    assert pareto_front([], []) == []


def test_costs_are_medians_per_simulated_second_and_ratios_are_taken_within_a_round() -> None:
    # every round is slower by a factor, as on a machine whose clock goes down
    slow = FakeRun(2.0, 4.0, 20.0, seconds=2.0)
    fast = FakeRun(1.0, 2.0, 10.0, seconds=2.0)
    costs = interleaved_costs([slow, fast], 1, repeats=3)
    assert (costs[0].low, costs[0].median, costs[0].high) == (1.0, 2.0, 10.0)
    assert (costs[0].ratio_low, costs[0].ratio, costs[0].ratio_high) == (2.0, 2.0, 2.0)
    assert costs[1].ratio == 1.0
    assert costs[0].repeats == 3


def test_no_further_round_begins_when_patience_is_over_but_three_are_done() -> None:
    now = iter(range(1000))
    run = FakeRun(1.0)
    costs = interleaved_costs([run], 0, repeats=9, patience=0.5, clock=lambda: float(next(now)))
    assert costs[0].repeats == run.calls == 3


def test_selection_has_every_method_at_every_step_and_no_point_twice() -> None:
    methods, periods = chosen_methods(None), chosen_periods(None)
    settings = settings_for(methods, periods, has_contact=True)
    assert len(set(settings)) == len(settings)
    for method in METHODS.values():
        assert {s.period for s in settings if s.method is method} == set(periods)
    assert {s.contact for s in settings} == set(CONTACTS)
    undivided = [s for s in settings if s.method.scheme in (Scheme.MIDPOINT, Scheme.MASSLESS)]
    assert {s.substeps for s in undivided} == {1}
    for name in ("implicit", "lossless"):
        tried = {s.period for s in settings if (s.method.name, s.contact) == (name, "damped")}
        assert tried == {1e-3, 5e-4}
    for steps, neighbour in (([2e-3, 1e-3], 2e-3), ([1e-3], 1e-3)):
        found = settings_for(methods, steps, has_contact=True)
        assert {s.period for s in found if s.contact != SHIPPED} == {1e-3, neighbour}
    without = settings_for(methods, periods, has_contact=False)
    assert {(s.contact, s.iterations) for s in without} == {("as shipped", None)}


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        ([1.0, 0.3], "step 0.3 ms does not divide 1 ms"),
        ([0.001], "must be between 0.02 and 20"),
        ([float("nan")], "must be between 0.02 and 20"),
        ([], "steps is empty"),
    ],
)
def test_bad_steps_are_refused_in_a_sentence(steps: list[float], said: str) -> None:
    with pytest.raises(StudyError, match=said):
        chosen_periods(steps)


@pytest.fixture(scope="module")
def chart() -> Chart:
    """A chart on which one point has diverged."""
    return small_chart()


def test_diverged_point_stays_on_the_chart(chart: Chart) -> None:
    verdicts = {each.setting.label: each.score.verdict for each in chart.measurements}
    assert verdicts["explicit, 20 ms"] in ("diverged", "active")
    assert len(verdicts) == 6
    assert "explicit, 20 ms" not in {
        each.setting.label for each in chart.front(chart.workload.panels[0])
    }


def test_point_that_cannot_be_compared_is_not_on_the_front(chart: Chart) -> None:
    (panel,) = chart.workload.panels
    best = chart.front(panel)[-1]
    apart = [
        replace(each, limit_apart=1e9) if each is best else each for each in chart.measurements
    ]
    front = replace(chart, measurements=tuple(apart)).front(panel)
    assert best.setting not in [each.setting for each in front]


def test_files_hold_every_setting(chart: Chart, tmp_path: Path) -> None:
    files = write_chart(chart, prepared_files(tmp_path / "new", "point_mass"))
    with files.paths["csv"].open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    assert len(rows) == 6
    assert {row["method"] for row in rows} == {"implicit", "explicit"}
    assert {float(row["period_s"]) for row in rows} == {0.02, 2e-3, 1e-3}
    assert {row["solver_iterations"] for row in rows} == {"100"}
    assert all(row["machine"] and float(row["cost_median"]) > 0 for row in rows)
    said = json.loads(files.paths["json"].read_text(encoding="utf-8"))
    assert said["panels"][0]["reference_is_truth"] is True
    assert said["panels"][0]["recommendation"].startswith("For 1 kHz")
    assert files.paths["png"].stat().st_size > 10_000
    assert files.paths["svg"].read_text(encoding="utf-8").lstrip().startswith("<?xml")


def test_chart_without_a_point_is_refused() -> None:
    workload = open_workload("spinning_body", Extent(4e-3, 4e-3))
    with pytest.raises(StudyError, match="no point could be simulated; first: method 'weld'"):
        measure_chart(workload, [Setting(METHODS["weld"], 4e-3)], repeats=1)


def test_hand_path_beside_a_scene_is_never_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, hand_path = tmp_path / "mine.xml", tmp_path / "mine.csv"
    scene.write_text(
        '<mujoco><worldbody><body><freejoint/><geom size=".02" mass=".1"/>'
        '<site name="grip"/></body></worldbody></mujoco>',
        encoding="utf-8",
    )
    hand_path.write_text("t,x,y,z\n0,0,0,0\n0.2,0,0,0.01\n", encoding="utf-8")
    before = hand_path.read_bytes()
    arguments = ["chart", str(scene), "--methods", "implicit", "--steps", "4", "--quick", "--out"]
    assert main([*arguments, str(tmp_path)]) == 2
    assert "would be overwritten; name another folder" in capsys.readouterr().err
    assert hand_path.read_bytes() == before
    assert main([*arguments, str(tmp_path / "charts")]) == 0
    assert (tmp_path / "charts" / "mine.csv").exists()


def test_command_draws_a_chart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["chart", "point_mass", "--methods", "implicit", "lossless", "--steps", "4", "1"]
    assert main([*arguments, "--quick", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr()
    assert "For 1 kHz on this machine" in printed.out
    assert re.search(
        r"on the front, by cost:\n +[0-9.e-]+ s per s, [0-9.e-]+ JND: \w+", printed.out
    )
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {f"point_mass.{ending}" for ending in ("png", "svg", "csv", "json")}


def test_table_says_what_contacts_and_solver_really_were() -> None:
    workload = open_workload("rod_impact", Extent(4e-3, 1e-3))
    settings = [
        Setting(METHODS["implicit"], 1e-3, contact=contact, iterations=iterations)
        for contact, iterations in (
            ("as shipped", None),
            ("damped", None),
            ("soft", None),
            ("direct", None),
            ("pyramidal cone", 5),
        )
    ]
    chosen = [each.chosen for each in measure_chart(workload, settings, repeats=1).measurements]
    given = ["0.002 1", "0.0005 8", "0.02 1", "-1e+06 -2000", "0.002 1"]
    assert [each["solref"] for each in chosen] == given
    assert [each["cone"] for each in chosen] == ["elliptic"] * 4 + ["pyramidal"]
    assert [each["solver_iterations"] for each in chosen] == [100, 100, 100, 100, 5]
