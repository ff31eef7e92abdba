"""Readers of a recording of several hands: plots, pages, films, tables, repair, comparisons."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from two_hands import BAR, TONGS, two_handed

import hapticbridge as hb
from hapticbridge.cli.main import main
from hapticbridge.confinement import ForeignSceneError
from hapticbridge.recording.reader import open_hands, read_hands
from hapticbridge.recording.recorder import salvage
from hapticbridge.replay.film import Shot, still
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.plots import draw_recording
from hapticbridge.run.description import requested_of
from hapticbridge.tools.compare import compare
from hapticbridge.whatif import what_if


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bar_run(tmp_path_factory.mktemp("bar") / "run.mcap", 0.3)


@pytest.fixture(scope="module")
def long_bar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # so long that a recorder which writes nothing for its whole time has a full chunk
    return bar_run(tmp_path_factory.mktemp("long") / "run.mcap", 2.0)


def bar_run(path: Path, seconds: float) -> Path:
    """Records two hands on a bar; returns the path."""
    hands = [hb.Grasp("left"), hb.Grasp("right", "simulated:damping=3")]
    with hb.Bridge(two_handed(BAR), hands, clock=hb.SimulatedClock(), recording=path) as bridge:
        bridge.run(seconds)
    return path


@pytest.fixture(scope="module")
def tongs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tongs") / "run.mcap"
    grasp = hb.Grasp("left", grip_axis=hb.GripAxis("hinge", 10.0))
    scene = two_handed(TONGS, ("left", "joint:hinge"))
    with hb.Bridge(scene, [grasp], clock=hb.SimulatedClock(), recording=path) as bridge:
        bridge.run(0.3)
    return path


def test_a_plot_has_a_column_per_hand(bar: Path, tongs: Path) -> None:
    for path in (bar, tongs):
        figure = draw_recording(*read_hands(path))
        assert len(figure.axes) == 6
        heads = [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]
        grips = [each.meta["grip"] for each in open_hands(path)]
        assert [head.partition(": K")[0] for head in heads] == grips
    labels = {axes.get_ylabel() for axes in figure.axes}
    assert "displacement of the joint (m or rad)" in labels


def test_the_evidence_of_each_hand_is_what_the_audit_judges(bar: Path) -> None:
    hands = read_hands(bar)
    found = Evidence.of_hands(hands)
    report = hb.audit(bar, in_process=True)
    for evidence, hand in zip(found, hands, strict=True):
        assert evidence.created == pytest.approx(hand.ticks["environment_energy"], abs=1e-12)
        assert evidence.allowed[-1] == pytest.approx(report.energies["slack"], rel=1e-9)
    # without the other's work the scene would have got energy from nowhere
    alone = Evidence.of(hands[0])
    assert alone is not None
    assert np.abs(alone.created - found[0].created).max() > 1e-7


def test_the_audit_draws_and_writes_a_page_of_all_hands(
    bar: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, plot = tmp_path / "run.html", tmp_path / "run.png"
    assert main(["audit", str(bar), "--report", str(page), "--plot", str(plot)]) == 0
    text = page.read_text(encoding="utf-8")
    assert "Hand at left" in text
    assert "Hand at right" in text
    assert plot.stat().st_size > 20_000
    capsys.readouterr()


def test_a_picture_shows_every_handle(bar: Path, tongs: Path) -> None:
    for path in (bar, tongs):
        try:
            drawn = still(path, Shot(width=64, height=48))
        except ForeignSceneError:
            pytest.skip("the child cannot read this installation")
        assert drawn.startswith(b"\x89PNG")


def test_a_table_has_the_hand_that_is_named(
    bar: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "right.csv"
    run = ["export", str(bar), "--format", "csv", "--out", str(table)]
    assert main([*run, "--hand", "right"]) == 0
    force = np.genfromtxt(table, delimiter=",", names=True)["wrench_on_tool_fx"]
    expected = hb.read_recording(bar, hand=1).ticks["wrench_on_tool"][:, 0]
    assert force.tolist() == expected.tolist()
    capsys.readouterr()
    assert main([*run, "--hand", "middle", "--overwrite"]) == 2
    assert "has no hand at 'middle'; its hands hold 'left', 'right'" in capsys.readouterr().err
    assert main([*run, "--overwrite"]) == 2
    assert "takes one with --hand for a table" in " ".join(capsys.readouterr().err.split())


def test_a_cut_recording_of_two_hands_is_repaired(long_bar: Path, tmp_path: Path) -> None:
    cut, whole = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    data = long_bar.read_bytes()
    cut.write_bytes(data[: int(0.97 * len(data))])
    first = hb.repair(cut, whole)
    hands = read_hands(whole)
    assert first.hands == len(hands) == 2
    for mended, original in zip(hands, read_hands(long_bar), strict=True):
        assert 0 < mended.ticks.size < original.ticks.size
        assert mended.ticks.tobytes() == original.ticks[: mended.ticks.size].tobytes()
    report = hb.audit(whole, in_process=True)
    assert report.verdict == "passive", report.reason


def test_records_of_a_recorder_that_died_are_added_for_both_hands(
    long_bar: Path, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    data = long_bar.read_bytes()
    cut.write_bytes(data[: int(0.97 * len(data))])
    whole = read_hands(long_bar)
    rows = np.stack([hand.ticks for hand in whole], axis=1).ravel()
    assert "all 4000 records are there" in salvage(cut, rows[1:], whole[0].events)
    for mended, original in zip(read_hands(cut), whole, strict=True):
        assert mended.ticks.tobytes() == original.ticks.tobytes()


@pytest.mark.parametrize("name", ["bar", "tongs"])
def test_nothing_changed_is_the_recorded_run_again_for_every_hand(
    name: str, request: pytest.FixtureRequest
) -> None:
    path = request.getfixturevalue(name)
    found = what_if(path, {}, in_process=True)
    assert [run.name for run in found.runs] == ["recorded", "prescribed", "closed loop"]
    before, after, closed = found.runs
    for hand, again, yielding in zip(
        before.recordings, after.recordings, closed.recordings, strict=True
    ):
        assert hand.ticks.tobytes() == again.ticks.tobytes()
        assert hand.ticks.tobytes() != yielding.ticks.tobytes()
    assert any("the recorded one in every bit" in note for note in found.notes)
    assert 0.0 < found.hand_error < 1e-4
    grips = [each.meta["grip"] for each in before.recordings]
    assert {f"force on hand at '{grip}'" for grip in grips} <= set(before.peaks)


def test_a_gain_is_changed_in_every_hand_or_in_one(bar: Path, tongs: Path) -> None:
    def couplings(path: Path, changes: dict[str, float]) -> list[tuple[float, float]]:
        run = what_if(path, changes, in_process=True).runs[1]
        couplings = [requested_of(each.meta) for each in run.recordings]
        return [(each.stiffness, each.damping) for each in couplings]

    # b = 2 and 3 N s/m: a quarter of it is B
    assert couplings(bar, {"stiffness": 500.0}) == [(500.0, 0.5), (500.0, 0.75)]
    one = couplings(bar, {"stiffness": 500.0, "right:stiffness": 900.0})
    assert one == [(500.0, 0.5), (900.0, 0.75)]
    # a joint has other units, so a gain of all hands leaves it
    assert couplings(tongs, {"stiffness": 500.0})[1] == (24.0, 0.005)
    assert couplings(tongs, {"joint:hinge:stiffness": 9.0}) == [(2400.0, 0.5), (9.0, 0.005)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("middle:stiffness=9", "'middle:stiffness' cannot be changed; write GRIP:NAME"),
        ("left:rate=500", "'left:rate' cannot be changed"),
        ("method=lossless", "method 'lossless' has one hand"),
    ],
)
def test_a_what_if_that_several_hands_cannot_have_is_refused(
    change: str, message: str, bar: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["audit", str(bar), "--in-process", "--what-if", change]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_the_command_asks_what_if_and_draws_every_hand(
    bar: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, plot = tmp_path / "if.html", tmp_path / "if.png"
    run = ["audit", str(bar), "--in-process", "--what-if", "left:damping=0.2", "--plot", str(plot)]
    assert main([*run, "--report", str(page)]) == 0
    printed = capsys.readouterr().out
    assert "damping at 'left': 0.5 N s/m -> 0.2 N s/m" in printed
    assert "peak force on hand" in printed
    assert "at 'right'" in printed  # a narrow table breaks the line before
    assert "K, B as set at &#39;right&#39;" in page.read_text(encoding="utf-8")
    assert plot.stat().st_size > 20_000


def test_the_trip_of_a_hand_is_repeated(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    limits = hb.Limits(force=10.0, torque=0.5, stretch=2e-6)
    hands = [hb.Grasp("left"), hb.Grasp("right", limits=limits)]
    with (
        pytest.raises(hb.SafetyTrip, match="hand at 'right'"),
        hb.Bridge(two_handed(BAR), hands, clock=hb.SimulatedClock(), recording=path) as bridge,
    ):
        bridge.run(0.3)
    recorded, again, _ = what_if(path, {}, in_process=True).runs
    assert "hand at 'right': the tool is farther" in str(recorded.report.trip)
    assert again.report.trip == recorded.report.trip


def test_runs_of_several_hands_are_compared_hand_by_hand(bar: Path, tmp_path: Path) -> None:
    assert compare(bar, bar).is_same
    other = tmp_path / "other.mcap"
    hands = [hb.Grasp("left"), hb.Grasp("right", "simulated:damping=3,hand_mass=3")]
    with hb.Bridge(two_handed(BAR), hands, clock=hb.SimulatedClock(), recording=other) as bridge:
        bridge.run(0.3)
    found = compare(bar, other)
    assert found.first is not None
    assert found.first.column.endswith("of 'right'")  # the other hand feels it one tick later
    assert {each.column.partition(" of ")[2] for each in found.largest} == {"", "'right'"}
    assert not found.decisive
    alone = tmp_path / "alone.mcap"
    with hb.Bridge(
        two_handed_alone(), "simulated", clock=hb.SimulatedClock(), recording=alone
    ) as bridge:
        bridge.run(0.1)
    assert compare(bar, alone).decisive["hands"] == ("2", "1")


def two_handed_alone() -> hb.Scene:
    return hb.load_scene(mujoco.MjSpec.from_string(BAR), "left")
