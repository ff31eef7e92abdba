"""The chart: its points, its timing, its front and what it recommends, its files."""

from __future__ import annotations

import csv
import json
import os
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from chart_cases import FakeRun, made_up

from hapticbridge.cli import main
from hapticbridge.errors import StudyError
from hapticbridge.kernel.scheme import DIRECT, LOSSLESS
from hapticbridge.rendering import METHODS
from hapticbridge.study.chart import (
    Chart,
    Extent,
    chosen_methods,
    chosen_periods,
    measure_chart,
    open_workload,
    prepared_files,
    settings_for,
    write_chart,
)
from hapticbridge.study.chart.convergence import convergence_orders
from hapticbridge.study.chart.drawing import draw_chart
from hapticbridge.study.chart.front import pareto_front
from hapticbridge.study.chart.measurement import Measurement
from hapticbridge.study.chart.page import chart_page
from hapticbridge.study.chart.recommendation import recommendation, recommended
from hapticbridge.study.chart.setting import CONTACTS, SHIPPED, Setting
from hapticbridge.study.chart.timing import interleaved_costs, one_core


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


def test_cheapest_sound_point_is_recommended_and_the_more_accurate_of_equal_costs() -> None:
    cheap = made_up(0.010, 0.9, spread=0.1)
    better = made_up(0.0105, 0.3, method="lossless")
    dear = made_up(0.020, 0.1)
    assert recommended([cheap, better, dear]) is better
    assert recommended([cheap, dear]) is cheap


def test_points_whose_spreads_meet_cost_alike_whichever_is_disturbed() -> None:
    calm, disturbed = made_up(0.0100, 0.9), made_up(0.0110, 0.3, method="lossless", spread=0.1)
    assert recommended([calm, disturbed]) is disturbed
    apart = made_up(0.0110, 0.3, method="lossless", spread=0.05)
    assert recommended([calm, apart]) is calm


def test_better_point_that_is_not_taken_is_named_with_the_reason() -> None:
    best = made_up(0.010, 0.6)
    kicks = made_up(0.009, 0.2, method="explicit")
    text = recommendation([best, kicks], "a machine")
    assert "use implicit, 1 ms" in text
    assert "explicit, 1 ms would cost no more and err less (0.2 JND), but it may kick" in text
    for no_better in (
        made_up(0.020, 0.2, method="explicit"),
        made_up(0.009, 0.595, method="explicit"),
        made_up(0.009, 0.7, method="explicit"),
        made_up(0.009, 0.2, method="explicit", period=4e-3),
    ):
        assert "explicit" not in recommendation([best, no_better], "a machine")
    other_law = made_up(0.001, 0.0, method="direct")
    assert "direct" not in recommendation([best, other_law], "a machine")


def test_recommendation_says_where_its_error_is_not_counted_from_the_truth() -> None:
    point = made_up(0.01, 0.2)
    assert "not from the truth" in recommendation([point], "a machine", is_truth=False)
    assert "not from the truth" not in recommendation([point], "a machine", is_truth=True)


def test_usual_contact_is_recommended_where_errors_are_alike() -> None:
    odd = made_up(0.0100, 0.300, contact="2 steps", spread=0.1)
    usual = made_up(0.0101, 0.301)
    assert recommended([odd, usual]) is usual


@pytest.mark.parametrize(
    ("flawed", "said"),
    [
        (made_up(0.01, 1.5), "its error is 1.5 JND"),
        (made_up(0.01, 0.5, verdict="active"), "its environment is active"),
        (made_up(0.01, 0.5, verdict="lost contact"), "its environment is lost contact"),
        (made_up(0.6, 0.5), "it takes 60 % of a core"),
        (made_up(0.01, 0.5, method="explicit"), "it may kick on a real device"),
    ],
)
def test_flawed_point_is_not_recommended_but_named_with_its_flaw(flawed: object, said: str) -> None:
    assert recommended([flawed]) is None  # type: ignore[list-item]
    text = recommendation([flawed], "a machine")  # type: ignore[list-item]
    assert "no point does it all" in text
    assert said in text
    good = made_up(0.3, 0.9)
    assert recommended([flawed, good]) is good  # type: ignore[list-item]


def test_error_that_grows_at_a_smaller_step_is_called_luck() -> None:
    lucky, finer = made_up(0.01, 0.2), made_up(0.02, 3.0, period=5e-4)
    assert recommended([lucky, finer]) is None
    assert "it is luck" in recommendation([lucky, finer], "a machine")
    assert recommended([lucky, made_up(0.02, 0.4, period=5e-4)]) is lucky
    # another method's error at a smaller step says nothing of this one
    assert recommended([lucky, made_up(0.02, 3.0, period=5e-4, method="lossless")]) is lucky


def test_solver_that_is_cut_short_is_not_recommended() -> None:
    short = made_up(0.01, 0.2, iterations=1)
    assert recommended([short]) is None
    assert "its solver is cut short" in recommendation([short], "a machine")
    assert recommended([short, made_up(0.02, 0.3)]) is not short


def test_slower_than_a_kilohertz_is_never_recommended() -> None:
    slow = made_up(0.001, 0.1, period=2e-3)
    assert recommended([slow]) is None
    assert "nothing was tried that runs at this rate" in recommendation([slow], "a machine")
    assert recommended([slow, made_up(0.1, 0.5)]) is not slow


def test_recommendation_says_machine_setting_and_numbers() -> None:
    text = recommendation([made_up(0.012, 0.25, method="lossless")], "a machine")
    assert text.startswith("For 1 kHz on this machine (a machine) and an error below one JND, use")
    assert "lossless, 1 ms" in text
    assert "0.25 JND at 12 µs a tick, 1.2 % of a core" in text


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


def test_setting_that_no_other_step_bears_out_is_recommended_last_and_said_to_be_luck() -> None:
    once = made_up(0.010, 0.1, contact="damped")
    twice = [
        made_up(0.012, 0.8, method="lossless"),
        made_up(0.02, 0.4, method="lossless", period=5e-4),
    ]
    assert recommended([once, *twice]) is twice[0]
    finer = made_up(0.02, 0.2, contact="damped", period=5e-4)
    assert recommended([once, finer, *twice]) is once
    assert "may be luck" not in recommendation([once, finer, *twice], "a machine")
    # nothing else was tried: it is said
    assert recommended([once]) is once
    assert "No other time step bears this out, so it may be luck" in recommendation([once], "m")
    # and what another step contradicts is not borne out by it
    coarser = made_up(0.005, 4.0, contact="damped", period=2e-3)
    assert recommended([once, coarser, *twice]) is twice[0]


def test_point_nearer_to_its_own_limit_than_that_is_to_others_is_not_comparable() -> None:
    apart = made_up(0.010, 0.02, method="lossless", limit_apart=0.34)
    shared = made_up(0.012, 0.3, limit_apart=0.004)
    assert not apart.is_comparable
    assert shared.is_comparable
    assert recommended([apart, shared]) is shared
    text = recommendation([apart], "a machine")
    assert "its own limit lies 0.34 JND from what most methods converge to" in text
    far = made_up(0.010, 0.5, method="lossless", limit_apart=0.34)
    assert far.is_comparable


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


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the system pins no threads")
def test_pinning_is_undone() -> None:
    before = os.sched_getaffinity(0)
    with one_core() as core:
        assert os.sched_getaffinity(0) == {core}
    assert os.sched_getaffinity(0) == before


def test_selection_has_every_method_at_every_step_and_no_point_twice() -> None:
    methods, periods = chosen_methods(None), chosen_periods(None)
    settings = settings_for(methods, periods, has_contact=True)
    assert len(set(settings)) == len(settings)
    for method in METHODS.values():
        assert {s.period for s in settings if s.method is method} == set(periods)
    assert {s.contact for s in settings} == set(CONTACTS)
    undivided = [s for s in settings if s.method.scheme in (LOSSLESS, DIRECT)]
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
    """A small chart: one good method, and one that a step of 20 ms throws out of bounds."""
    workload = open_workload("point_mass", Extent(0.02, 1e-3))
    settings = [
        Setting(METHODS[name], period)
        for name in ("implicit", "explicit")
        for period in (0.02, 2e-3, 1e-3)
    ]
    return measure_chart(workload, settings, repeats=1)


def test_diverged_point_stays_on_the_chart(chart: Chart) -> None:
    verdicts = {each.setting.label: each.score.verdict for each in chart.measurements}
    assert verdicts["explicit, 20 ms"] in ("diverged", "active")
    assert len(verdicts) == 6
    assert "explicit, 20 ms" not in {
        each.setting.label for each in chart.front(chart.workload.panels[0])
    }


def test_files_hold_every_setting_and_the_page_needs_nothing_else(
    chart: Chart, tmp_path: Path
) -> None:
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


class Page(HTMLParser):
    """Reads a page: which elements it has, and whether each is closed in its turn."""

    VOID = ("meta", "br", "link", "img", "input")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert not self._open, f"never closed: {self._open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes an element."""
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes an element without content."""
        self.found.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        """Checks that the innermost open element is the one that ends."""
        assert self._open.pop() == tag


def check_page(text: str, *, spots: int) -> Page:
    """Checks that a page is well formed, asks for nothing, and tells of every point."""
    page = Page(text)
    assert text.startswith("<!doctype html>")
    assert not re.search(r"https?://|@import|url\(|fetch\(|XMLHttp|WebSocket", text)
    asking = {"src", "href", "srcset", "data", "action", "poster", "xlink:href"}
    assert not [tag for tag, named in page.found if asking & set(named) or tag == "link"]
    told = [named["data-told"] for _, named in page.found if named.get("class") == "spot"]
    assert len(told) == spots
    assert all((each and "JND" in each) or "diverged" in str(each) for each in told)
    names = {named.get("data-name") for _, named in page.found} - {None}
    assert {named["data-of"] for _, named in page.found if named.get("class") == "spot"} == names
    assert not [named for _, named in page.found if "nan" in " ".join(map(str, named.values()))]
    assert len(text) < 100_000
    return page


def test_page_is_well_formed_and_asks_for_no_other_file(chart: Chart) -> None:
    check_page(chart_page(chart), spots=6)


def test_page_without_a_front_or_with_points_that_are_not_comparable_is_well_formed(
    chart: Chart,
) -> None:
    created = [
        replace(each, score=replace(each.score, verdict="active")) for each in chart.measurements
    ]
    page = chart_page(replace(chart, measurements=tuple(created)))
    check_page(page, spots=6)
    assert "Nothing is on the front" in page
    apart = [replace(each, limit_apart=1e9) for each in chart.measurements]
    pale = check_page(chart_page(replace(chart, measurements=tuple(apart))), spots=6)
    marked = [named for _, named in pale.found if named.get("class") == "spot"]
    finite = sum(np.isfinite(each.score.felt) for each in chart.measurements)
    assert sum(named.get("opacity") == ".2" for named in marked) == finite
    assert draw_chart(replace(chart, measurements=tuple(apart))).axes


def test_picture_says_what_its_words_and_pale_points_mean(chart: Chart) -> None:
    def words(*points: Measurement) -> str:
        labelled = tuple(replace(each, panel=chart.workload.panels[0].key) for each in points)
        figure = draw_chart(replace(chart, measurements=labelled))
        legend = figure.axes[0].get_legend()
        assert legend is not None
        return " ".join(text.get_text() for text in legend.get_texts())

    steps = (2.5e-4, 5e-4, 1e-3)
    plain = words(*(made_up(1.0, p, period=p) for p in steps))
    assert "implicit (order 1.0)" in plain
    for told in ("not settled", "gain nothing", "not comparable", "lower edge"):
        assert told not in plain
    assert "smaller steps gain nothing" in words(*(made_up(1.0, 0.1, period=p) for p in steps))
    assert "not settled" in words(*(made_up(1.0, p**p, period=p) for p in (0.1, 0.4, 1.6)))
    apart = words(made_up(1.0, 0.1, limit_apart=0.34))
    assert "implicit (limit 0.34 off)" in apart
    assert "not comparable" in apart
    assert "at the lower edge: 0.0001 JND or less" in words(made_up(1.0, 1e-6))


def test_chart_without_a_point_is_refused() -> None:
    workload = open_workload("spinning_body", Extent(4e-3, 4e-3))
    with pytest.raises(StudyError, match="no point could be simulated; first: method 'weld'"):
        measure_chart(workload, [Setting(METHODS["weld"], 4e-3)], repeats=1)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere"], "no scene"),
        (["point_mass", "--steps", "1", "0.3"], "does not divide"),
        (["point_mass", "--methods", "magic"], "no method is called 'magic'"),
        (["point_mass", "--engines", "all", "mujoco"], "give it alone"),
    ],
)
def test_bad_input_at_the_command_line_is_one_sentence(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["chart", *arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.strip().splitlines()) == 1


def test_folder_that_is_a_file_is_refused_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = tmp_path / "file"
    taken.write_text("", encoding="utf-8")
    assert main(["chart", "point_mass", "--out", str(taken)]) == 2
    assert "is a file; name a folder" in capsys.readouterr().err


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
    assert names == {f"point_mass.{ending}" for ending in ("png", "svg", "csv", "json", "html")}


def test_table_says_what_contacts_and_solver_really_were() -> None:
    workload = open_workload("rod_impact", Extent(4e-3, 1e-3))
    settings = [
        Setting(METHODS["implicit"], 1e-3, contact=contact, iterations=iterations)
        for contact, iterations in (
            ("as shipped", None),
            ("damped", None),
            ("soft", None),
            ("pyramidal cone", 5),
        )
    ]
    chosen = [each.chosen for each in measure_chart(workload, settings, repeats=1).measurements]
    assert [each["solref"] for each in chosen] == ["0.002 1", "0.0005 8", "0.02 1", "0.002 1"]
    assert [each["cone"] for each in chosen] == ["elliptic"] * 3 + ["pyramidal"]
    assert [each["solver_iterations"] for each in chosen] == [100, 100, 100, 5]
