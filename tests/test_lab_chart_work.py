"""Cost against work: the scenes that grow, their timing and the exponents."""

from __future__ import annotations

import re
from dataclasses import astuple, replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from hapticbridge.cli import main
from hapticbridge.errors import StudyError
from hapticbridge.lab.chart import work


def test_floating_bodies_are_as_many_as_asked_and_touch_nothing() -> None:
    for number in (1, 7):
        scene = work.floating(number)
        assert scene.model.nv == 6 * number
        assert scene.data.ncon == 0


def test_plate_stands_on_as_many_contacts_as_it_has_feet() -> None:
    families = tuple(family for family in work.FAMILIES if family.name == "contacts")
    chart = work.measure_work(families, most=30, rounds=1)
    for variant in work.METHOD_VARIANTS:
        assert [p.contacts for p in chart.points_of(families[0], variant)] == [1, 3, 10, 30]
    assert {point.freedoms for point in chart.points} == {6}


def test_mesh_has_as_many_triangles_as_asked() -> None:
    for number in (12, 100, 1000):
        assert len(ConvexHull(work.sphere(number // 2 + 2)).simplices) == number
    scene = work.mesh_ball(100)
    assert scene.model.nmeshvert == 52


def test_boxes_at_rest_sleep_where_they_may_and_only_there() -> None:
    families = tuple(family for family in work.FAMILIES if family.name == "resting")
    chart = work.measure_work(families, most=3, rounds=1)
    contacts = {(p.variant, p.size): p.contacts for p in chart.points}
    assert len(families[0].variants) == 4
    for variant in families[0].variants:
        awake = 0 if variant.sleeps else 12
        assert contacts[variant.name, 3] == awake
    scene = work.resting(2)
    assert scene.model.opt.enableflags & 64 == 0


def test_substeps_divide_the_tick_and_the_paragraph_names_every_slope() -> None:
    families = tuple(family for family in work.FAMILIES if family.name == "substeps")
    chart = work.measure_work(families, most=4, rounds=1)
    assert [point.contacts for point in chart.points] == [10, 10, 10]
    scene = families[0].build(4)
    work.tick_times(scene, work.USUAL, lambda: 0, 4)
    assert scene.model.opt.timestep == pytest.approx(work.PERIOD / 4)
    assert re.search(r"Substeps, bridge: .* for 4, as n\^[0-9.]+ from 1 on", work.paragraph(chart))


def test_whole_loops_are_timed_with_hands_recording_and_view() -> None:
    loops = work.measure_loops(rounds=1, ticks=100)
    assert [each.name for each in loops] == list(work.LOOPS)
    assert all(0 < each.low <= each.median <= each.high < 0.01 for each in loops)
    chart = work.WorkChart((), "a machine", loops)
    assert "Whole loop, two hands: " in work.paragraph(chart)


@pytest.mark.parametrize("build", [work.floating, work.plate, work.mesh_ball, work.resting])
def test_scene_of_nothing_or_of_too_much_is_refused(build: object) -> None:
    for number in (-1, 10**9):
        with pytest.raises(StudyError, match=r"the scene has .* parts; it must have 1 to"):
            build(number)  # type: ignore[operator]


def test_exponent_is_the_slope_at_the_larger_sizes() -> None:
    sizes = np.array([1.0, 10.0, 30.0, 100.0])
    # what every tick costs hides the growth at small sizes
    steep = work.growth_of(sizes, 1e-9 * sizes**2 + 1e-12)
    assert steep is not None
    assert steep.exponent == pytest.approx(2.0, abs=0.01)
    even = work.growth_of(sizes, np.array([50.0, 10.0, 30.0, 100.0]))
    assert even is not None
    assert astuple(even) == pytest.approx((1.0, 1.0, 1.0, 10.0))
    assert work.growth_of(sizes[:1], sizes[:1]) is None
    assert work.growth_of(np.zeros(0), np.zeros(0)) is None


def test_growth_that_is_no_power_shows_in_the_range_of_its_exponent() -> None:
    bent = work.growth_of(np.array([10.0, 30.0, 90.0]), np.array([1.0, 3.0, 27.0]))
    assert bent is not None
    assert [bent.low, bent.high] == pytest.approx([1.0, 2.0])
    assert bent.low < bent.exponent < bent.high


def test_rate_is_what_half_a_period_leaves_at_the_99th_percentile() -> None:
    ticks = count()
    families = tuple(family for family in work.FAMILIES if family.name == "bodies")
    # a clock that goes on by 1 µs a call: every tick takes one
    chart = work.measure_work(families, most=1, rounds=1, clock=lambda: 1000 * next(ticks))
    point = chart.points[0]
    assert point.time.median == pytest.approx(1e-6)
    assert point.rate == pytest.approx(0.5 / 1e-6)


def test_fixed_cost_beyond_mujocos_step_is_told_from_what_grows() -> None:
    families = tuple(family for family in work.FAMILIES if family.name == "bodies")
    ticks = count()
    chart = work.measure_work(families, most=2, rounds=1, clock=lambda: next(ticks))
    times = {
        (work.ALONE.name, 1): 2e-6,
        (work.ALONE.name, 2): 10e-6,
        (work.USUAL.name, 1): 3e-6,
        (work.USUAL.name, 2): 12e-6,
    }
    points = tuple(
        replace(point, time=replace(point.time, median=times[point.variant, point.size]))
        for point in chart.points
        if point.variant in {work.ALONE.name, work.USUAL.name}
    )
    told = work.paragraph(work.WorkChart(points, "a machine"))
    extra = "1 µs for 1 (1.50 times the step) and 2 µs for 2 (1.20 times the step)"
    assert told.count("; beyond MuJoCo's step alone ") == 1
    assert f"; beyond MuJoCo's step alone {extra}" in told


@pytest.mark.parametrize(
    "option", [["--methods", "implicit"], ["--steps", "1"], ["--engines", "all"]]
)
def test_work_refuses_what_it_would_not_heed(
    option: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["chart", "work", *option, "--out", str(tmp_path)]) == 2
    assert "it takes neither --methods nor" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
