"""What reads a recording of several hands: plots, pages, films, tables, repair."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from two_hands import BAR, TONGS, two_handed

import hapticbridge as hb
from hapticbridge.cli.main import main
from hapticbridge.confinement import ForeignSceneError
from hapticbridge.film import Shot, still
from hapticbridge.recording.reader import open_hands, read_hands
from hapticbridge.recording.recorder import salvage
from hapticbridge.report.evidence import Evidence, draw_recording


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bar") / "run.mcap"
    hands = [hb.Grasp("left"), hb.Grasp("right", "simulated:damping=3")]
    with hb.Bridge(two_handed(BAR), hands, clock=hb.SimulatedClock(), recording=path) as bridge:
        bridge.run(0.6)
    return path


@pytest.fixture(scope="module")
def tongs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tongs") / "run.mcap"
    grasp = hb.Grasp("left", grip_axis=hb.GripAxis("hinge", 10.0))
    scene = two_handed(TONGS, ("left", "joint:hinge"))
    with hb.Bridge(scene, [grasp], clock=hb.SimulatedClock(), recording=path) as bridge:
        bridge.run(0.6)
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
    assert "takes one with --hand" in " ".join(capsys.readouterr().err.split())


def test_a_cut_recording_of_two_hands_is_repaired(bar: Path, tmp_path: Path) -> None:
    cut, whole = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    data = bar.read_bytes()
    cut.write_bytes(data[: int(0.7 * len(data))])
    first = hb.repair(cut, whole)
    hands = read_hands(whole)
    assert first.hands == len(hands) == 2
    for mended, original in zip(hands, read_hands(bar), strict=True):
        assert mended.ticks.tobytes() == original.ticks[: mended.ticks.size].tobytes()
    assert hb.audit(whole, in_process=True).verdict == "passive"


def test_records_of_a_recorder_that_died_are_added_for_both_hands(
    bar: Path, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    data = bar.read_bytes()
    cut.write_bytes(data[: int(0.7 * len(data))])
    whole = read_hands(bar)
    rows = np.stack([hand.ticks for hand in whole], axis=1).ravel()
    assert "all 1200 records are there" in salvage(cut, rows[1:], whole[0].events)
    for mended, original in zip(read_hands(cut), whole, strict=True):
        assert mended.ticks.tobytes() == original.ticks.tobytes()
