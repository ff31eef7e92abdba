"""The chart: its points, timing, orders, front, recommendation and files."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hapticbridge.cli import main
from hapticbridge.errors import StudyError
from hapticbridge.kernel.codes import Scheme
from hapticbridge.lab.chart import setting
from hapticbridge.lab.chart.chart import (
    Chart,
    Cost,
    Extent,
    Measurement,
    convergence_orders,
    interleaved_costs,
    measure_chart,
    open_workload,
    pareto_front,
)
from hapticbridge.lab.chart.output import (
    CEILING,
    DEFAULT,
    WARNING,
    draw_chart,
    prepared_files,
    recommendation,
    recommended,
    standing,
    write_chart,
)
from hapticbridge.lab.chart.score import Score, Verdict
from hapticbridge.lab.methods import METHODS


def made_up(
    cost: float,
    felt: float,
    *,
    method: str = "implicit",
    period: float = 1e-3,
    verdict: Verdict = "strict",
    spread: float = 0.0,
    contact: str = setting.SHIPPED,
    substeps: int = 1,
    iterations: int | None = None,
    limit_apart: float = 0.0,
) -> Measurement:
    """Returns a point of panel ``panel`` that costs and errs as said."""
    return Measurement(
        "panel",
        setting.Setting(METHODS[method], period, substeps, contact, iterations),
        Cost(cost, cost * (1 - spread), cost * (1 + spread), 1.0, 1.0, 1.0, 3),
        Score(jnd=felt, created=0.0, verdict=verdict),
        limit_apart=limit_apart,
    )


class FakeRun:
    """A run that takes the times that it is given, one after the other."""

    def __init__(self, *times: float, seconds: float = 1.0) -> None:
        self.seconds = seconds
        self._times = list(times)
        self.calls = 0

    @property
    def chosen(self) -> Mapping[str, str | int]:
        """Returns no choice."""
        return {}

    def run(self) -> float:
        """Returns the next of its times."""
        self.calls += 1
        return self._times[(self.calls - 1) % len(self._times)]

    def scores(self) -> Mapping[str, Score]:
        """Judges nothing."""
        return {}


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


def test_front_is_ordered_by_cost_and_leaves_out_what_has_no_error_or_no_cost() -> None:
    assert pareto_front([1.0, 2.0, 3.0, 2.0, 4.0, 1.0], [9.0, 4.0, 4.0, 5.0, 1.0, 8.0]) == [5, 1, 4]
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


def test_round_that_failed_is_lost_alone() -> None:
    never, sound, sometimes = (
        FakeRun(np.nan, np.nan, np.nan),
        FakeRun(2, 4, 2),
        FakeRun(np.nan, 8, 5),
    )
    lost, kept, some = interleaved_costs([never, sound, sometimes], 1, repeats=3)
    assert np.isnan([lost.median, lost.low, lost.high, lost.ratio]).all()
    assert (kept.median, kept.ratio) == (2, 1)
    assert (some.median, some.low, some.high) == (6.5, 5, 8)
    assert (some.ratio, some.ratio_low, some.ratio_high) == (2.25, 2, 2.5)


def test_no_further_round_begins_when_patience_is_over_but_three_are_done() -> None:
    now = iter(range(1000))
    run = FakeRun(1.0)
    costs = interleaved_costs([run], 0, repeats=9, patience=0.5, clock=lambda: float(next(now)))
    assert costs[0].repeats == run.calls == 3


def test_selection_has_every_method_at_every_step_and_no_point_twice() -> None:
    methods, periods = setting.chosen_methods(None), setting.chosen_periods(None)
    settings = setting.settings_for(methods, periods, has_contact=True)
    assert len(set(settings)) == len(settings)
    for method in METHODS.values():
        assert {s.period for s in settings if s.method is method} == set(periods)
    assert {s.contact for s in settings} == set(setting.CONTACTS)
    undivided = [s for s in settings if s.method.scheme in (Scheme.MIDPOINT, Scheme.MASSLESS)]
    assert {s.substeps for s in undivided} == {1}
    for name in ("implicit", "lossless"):
        tried = {s.period for s in settings if (s.method.name, s.contact) == (name, "damped")}
        assert tried == {1e-3, 5e-4}
    for steps, neighbour in (([2e-3, 1e-3], 2e-3), ([1e-3], 1e-3)):
        found = setting.settings_for(methods, steps, has_contact=True)
        assert {s.period for s in found if s.contact != setting.SHIPPED} == {1e-3, neighbour}
    without = setting.settings_for(methods, periods, has_contact=False)
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
        setting.chosen_periods(steps)


@pytest.fixture(scope="module")
def chart() -> Chart:
    """A good method, and one that a step of 20 ms throws out of bounds."""
    settings = [
        setting.Setting(METHODS[name], period)
        for name in ("implicit", "explicit")
        for period in (0.02, 2e-3, 1e-3)
    ]
    return measure_chart(open_workload("point_mass", Extent(0.02, 1e-3)), settings, repeats=1)


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
    assert said["panels"][0]["recommendation"].startswith("for 1 kHz: ")
    assert files.paths["png"].stat().st_size > 10_000
    assert files.paths["svg"].read_text(encoding="utf-8").lstrip().startswith("<?xml")


def test_chart_without_a_point_is_refused() -> None:
    workload = open_workload("spinning_body", Extent(4e-3, 4e-3))
    with pytest.raises(StudyError, match="no point could be simulated; first: method 'weld'"):
        measure_chart(workload, [setting.Setting(METHODS["weld"], 4e-3)], repeats=1)


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
    picture = tmp_path.with_name("picture.pdf")
    arguments += ["--plot", str(picture), "--out", str(tmp_path)]
    assert main([*arguments, "--quick"]) == 0
    printed = capsys.readouterr()
    assert picture.read_bytes().startswith(b"%PDF")
    assert "for 1 kHz: " in printed.out and "default: lossless, 1 ms (" in printed.out
    assert re.search(
        r"on the front, by cost:\n +[0-9.e-]+ s per s, [0-9.e-]+ JND: \w+", printed.out
    )
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {f"point_mass.{ending}" for ending in ("png", "svg", "csv", "json")}


@pytest.mark.parametrize(
    "option", [["--methods", "implicit"], ["--steps", "1"], ["--engines", "all"]]
)
def test_chart_of_rates_refuses_what_it_would_not_heed(
    option: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["chart", "slow_scene", *option, "--out", str(tmp_path)]) == 2
    assert "it takes neither --methods nor" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_table_says_what_contacts_and_solver_really_were() -> None:
    workload = open_workload("rod_impact", Extent(4e-3, 1e-3))
    own = METHODS["implicit"].with_contact("scene")
    settings = [
        setting.Setting(own, 1e-3, contact=contact, iterations=iterations)
        for contact, iterations in (
            ("as shipped", None),
            ("damped", None),
            ("soft", None),
            ("pyramidal cone", 5),
        )
    ]
    settings.append(setting.Setting(METHODS["implicit"], 1e-3))
    chosen = [each.chosen for each in measure_chart(workload, settings, repeats=1).measurements]
    given = ["0.002 1", "0.0005 8", "0.02 1", "0.002 1", "rigid"]
    assert [each["solref"] for each in chosen] == given
    assert [each["cone"] for each in chosen] == ["elliptic"] * 3 + ["pyramidal", "elliptic"]
    assert [each["solver_iterations"] for each in chosen] == [100, 100, 100, 5, 100]


def test_most_accurate_sound_point_is_recommended_among_costs_that_no_user_notices() -> None:
    cheap = made_up(0.010, 0.9)
    better = made_up(0.019, 0.3, method="lossless")
    dear = made_up(0.030, 0.1, method="compensated")
    assert recommended([cheap, better, dear]) is better
    assert recommended([cheap, dear]) is cheap
    # where the spreads of two costs meet within that, they are alike whichever is disturbed
    disturbed = made_up(0.022, 0.1, method="compensated", spread=0.1)
    assert recommended([cheap, better, disturbed]) is disturbed


def test_recommendation_says_if_the_product_does_it_by_itself_and_else_how() -> None:
    default = made_up(0.010, 0.5, method="lossless")
    assert default.setting == DEFAULT
    # nobody feels a tenth of a just noticeable difference
    text = recommendation([default, made_up(0.011, 0.41)])
    assert text.startswith("for 1 kHz: lossless, 1 ms (0.5 JND, 10 µs a tick, 1 % of a core); the ")
    assert "the default of 'hapticbridge run'" in text
    text = recommendation([default, made_up(0.012, 0.2, substeps=2)])
    assert "; --method implicit --substeps 2" in text
    slower = replace(default, setting=replace(default.setting, scene_ticks=10))
    assert "the default of 'hapticbridge run' with --scene-rate 100" in recommendation([slower])
    unfit = made_up(0.010, 0.1, method="lossless", verdict="active")
    points = [unfit, made_up(0.012, 0.2)]
    assert "; --method implicit" in recommendation(points)
    assert "default: lossless, 1 ms (0.1 JND, 10 µs a tick, 1 % of a core): its env" in standing(
        points
    )


def test_page_says_who_is_ahead_of_the_default_and_with_which_hazard() -> None:
    own = [
        made_up(1e-2 * (1e-3 / period), 0.4 * (1e3 * period) ** 2, method="lossless", period=period)
        for period in (2e-3, 1e-3, 5e-4)
    ]
    default = "default: lossless, 1 ms (0.4 JND, 10 µs a tick, 1 % of a core); "
    assert standing(own) == f"{default}on the front"
    assert standing(own[:1]) == ""
    ahead = made_up(0.005, 0.2, method="explicit", verdict="within slack")
    text = standing([*own, ahead])
    assert text.startswith(f"{default}ahead of it: explicit, 1 ms (0.2 JND, 5 µs a tick, 0.5 %")
    assert text.endswith(f", but {METHODS['explicit'].hazard}") and METHODS["explicit"].hazard
    # what is cheaper and worse, or dearer and better, or not passive, or slower is not ahead
    others = [
        made_up(0.005, 0.5),
        made_up(0.02, 0.1),
        made_up(0.005, 0.1, verdict="active"),
        made_up(0.005, 0.1, period=2e-3),
    ]
    assert standing([*own, *others]).endswith("on the front")


def test_only_passive_points_are_round_and_of_their_methods_colour(chart: Chart) -> None:
    panel = chart.workload.panels[0]
    verdicts: tuple[Verdict, ...] = ("strict", "within slack", "active", "diverged")
    points = tuple(
        replace(made_up(0.01, 0.5, period=1e-3 / (1 + k), verdict=verdict), panel=panel.key)
        for k, verdict in enumerate(verdicts)
    )
    axes = draw_chart(replace(chart, measurements=points)).axes[0]
    found = {
        (str(line.get_marker()), str(line.get_color()))
        for line in axes.lines
        if np.size(line.get_xdata()) == 1 and line.get_marker() not in {"*", "None"}
    }
    red = {mark for mark, colour in found if colour == WARNING}
    assert red == {"X", "v"}
    assert {mark for mark, colour in found if colour != WARNING} == {"o"}


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
    text = recommendation([flawed])  # type: ignore[list-item]
    assert text.startswith("for 1 kHz: none; nearest ")
    assert said in text
    good = made_up(0.3, 0.9)
    assert recommended([flawed, good]) is good  # type: ignore[list-item]


def test_contacts_that_are_passive_in_this_motion_alone_are_not_recommended() -> None:
    usual = made_up(0.03, 0.2, method="lossless")
    own = setting.Setting(METHODS["implicit"].with_contact("scene"), 1e-3)
    cheap = replace(made_up(0.01, 0.1), setting=own)
    assert recommended([cheap, usual]) is usual
    assert "MuJoCo's contacts may create energy in another motion" in recommendation([cheap])


def test_picture_says_why_a_cheaper_method_is_passed_over(chart: Chart) -> None:
    good, kicks = made_up(0.02, 0.5), made_up(0.01, 0.4, method="explicit")
    panel = chart.workload.panels[0]
    points = tuple(replace(each, panel=panel.key) for each in (good, kicks))
    axes = draw_chart(replace(chart, measurements=points)).axes[0]
    legend = axes.get_legend()
    assert legend is not None
    words = " ".join(" ".join(text.get_text().split()) for text in legend.get_texts())
    assert "recommended for 1 kHz: implicit" in words
    assert "not explicit: it may kick on a real device" in words
    assert "not implicit" not in words


def test_every_point_stands_at_its_cost_and_error_in_the_picture(chart: Chart) -> None:
    panel = chart.workload.panels[0]
    good, wild = made_up(0.02, 0.5), made_up(0.04, np.inf, period=2e-3, verdict="diverged")
    points = tuple(replace(each, panel=panel.key) for each in (good, wild))
    axes = draw_chart(replace(chart, measurements=points)).axes[0]
    marks = {
        str(line.get_marker()): tuple(np.ravel(line.get_xydata()).tolist())
        for line in axes.lines
        if np.size(line.get_xdata()) == 1
    }
    assert marks["o"] == marks["*"] == (0.02, 0.5)
    cost, error = marks["v"]
    assert (cost, error) == (0.04, CEILING)  # beyond all errors, and on the picture
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    assert left < cost < right and low < error < high


def test_error_that_grows_at_a_smaller_step_is_called_luck() -> None:
    lucky, finer = made_up(0.01, 0.2), made_up(0.02, 3.0, period=5e-4)
    assert recommended([lucky, finer]) is None
    assert "it is luck" in recommendation([lucky, finer])
    assert recommended([lucky, made_up(0.02, 0.4, period=5e-4)]) is lucky
    # another method's error at a smaller step says nothing of this one
    assert recommended([lucky, made_up(0.02, 3.0, period=5e-4, method="lossless")]) is lucky


def test_solver_that_is_cut_short_is_not_recommended() -> None:
    short = made_up(0.01, 0.2, iterations=1)
    assert recommended([short]) is None
    assert "its solver is cut short" in recommendation([short])
    assert recommended([short, made_up(0.02, 0.3)]) is not short


def test_slower_than_a_kilohertz_is_never_recommended() -> None:
    slow = made_up(0.001, 0.1, period=2e-3)
    assert recommended([slow]) is None
    assert "nothing was tried that runs at this rate" in recommendation([slow])
    assert recommended([slow, made_up(0.1, 0.5)]) is not slow


def test_setting_that_no_other_step_bears_out_is_recommended_last_and_said_to_be_luck() -> None:
    once = made_up(0.010, 0.1, contact="damped")
    twice = [
        made_up(0.012, 0.8, method="lossless"),
        made_up(0.02, 0.4, method="lossless", period=5e-4),
    ]
    assert recommended([once, *twice]) is twice[0]
    finer = made_up(0.02, 0.2, contact="damped", period=5e-4)
    assert recommended([once, finer, *twice]) is once
    assert "may be luck" not in recommendation([once, finer, *twice])
    # nothing else was tried: it is said
    assert recommended([once]) is once
    assert "no other time step bears this out, so it may be luck" in recommendation([once])
    # and what another step contradicts is not borne out by it
    coarser = made_up(0.005, 4.0, contact="damped", period=2e-3)
    assert recommended([once, coarser, *twice]) is twice[0]


def test_point_nearer_to_its_own_limit_than_that_is_to_others_is_not_comparable() -> None:
    apart = made_up(0.010, 0.02, method="lossless", limit_apart=0.34)
    shared = made_up(0.012, 0.3, limit_apart=0.004)
    assert not apart.is_comparable
    assert shared.is_comparable
    assert recommended([apart, shared]) is shared
    text = recommendation([apart])
    assert "its own limit lies 0.34 JND from that of rigid contacts" in text
    far = made_up(0.010, 0.5, method="lossless", limit_apart=0.34)
    assert far.is_comparable


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

    assert words(0.65, 1.8, 3.4) == ""  # 'implicit' on the point mass at quick steps
    assert words(0.1, 0.4, 1.6) == "order 1.0"
    assert words(0.1, 0.4, 1.4) == "order 1.0"  # 0.1 of a power off
    assert words(0.1, 0.4, 1.3) == ""
    assert words(0.08, 0.08, 0.084) == "level"
    assert words(0.08, 0.08, 0.3) == ""


def test_no_order_is_taken_from_errors_that_a_reference_may_have_itself() -> None:
    points = [made_up(1.0, 1e8 * p**4, period=p) for p in (4e-3, 2e-3, 1e-3)]
    assert convergence_orders(points)["implicit"].power == pytest.approx(4.0)
    unresolved = [made_up(1.0, 2e-6, period=p) for p in (5e-4, 2.5e-4)]
    assert convergence_orders([*points, *unresolved])["implicit"].power == pytest.approx(4.0)
    assert not convergence_orders([*points[:2], *unresolved])
