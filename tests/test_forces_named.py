"""Owners of printed and drawn forces, in a run where hand and tool differ more than threefold."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
from audit_cases import recorded
from numpy.typing import NDArray

from hapticbridge.audit import audit
from hapticbridge.recording import Recording, read_recording
from hapticbridge.replay.stage import Stage
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.page import head_facts
from hapticbridge.run.options import Workspace
from hapticbridge.run.summary import Summary
from hapticbridge.units import (
    format_count,
    format_degrees,
    format_forces,
    format_number,
    format_si,
    format_wrenches,
)
from hapticbridge.view.replay import Replay

Called = Callable[..., tuple[int, str, str]]

TURNED = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
"""A quarter turn about z from the device's frame to the scene's."""


@pytest.fixture(scope="module")
def scaled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Summary]:
    path = tmp_path_factory.mktemp("scaled") / "run.mcap"
    workspace = Workspace(scale=2.0, force_scale=0.3, axes=TURNED)
    summary = recorded(path, "peg_in_hole", "simulated", None, duration=3.0, workspace=workspace)
    return path, summary


def norms(recording: Recording, field: str) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(recording.ticks[field][:, :3], axis=1))


def test_peaks_of_a_run_are_those_of_the_hand_and_those_of_the_tool(
    scaled: tuple[Path, Summary],
) -> None:
    path, summary = scaled
    recording = read_recording(path)
    assert summary.peak_force == pytest.approx(norms(recording, "wrench_on_device").max())
    assert summary.peak_tool_force == pytest.approx(norms(recording, "wrench_on_tool").max())
    assert summary.peak_tool_force > 3 * summary.peak_force > 0


def test_run_report_and_what_if_name_both(scaled: tuple[Path, Summary], call: Called) -> None:
    path, summary = scaled
    recording, report = read_recording(path), audit(path)
    evidence = Evidence.of(recording)
    assert evidence is not None
    words = dict(head_facts(report, evidence))["largest force"]
    assert f"{format_si(summary.peak_force, 'N')}, " in words.partition(" on the hand; ")[0]
    assert words.endswith(" on the tool")
    assert format_si(summary.peak_tool_force, "N") in words.partition(" on the hand; ")[2]
    code, out, _ = call("audit", path, "--what-if", "controller=off")
    rows = {line.split("  ")[0]: line for line in out.splitlines()}
    assert code == 0
    assert format_si(summary.peak_force, "N") in rows["peak force on hand"]
    assert format_si(summary.peak_tool_force, "N") in rows["peak force on tool"]


def test_pictures_draw_the_force_on_the_hand_with_its_sign_and_in_the_scenes_frame(
    scaled: tuple[Path, Summary],
) -> None:
    stage = Stage(scaled[0])
    stage.show(2500)
    row = stage.row[0]
    hand, tool = stage.hand_force, row["wrench_on_tool"][:3]
    np.testing.assert_allclose(hand, -0.3 * tool, rtol=1e-9, atol=1e-12)
    assert np.linalg.norm(row["wrench_on_device"][:3] - hand) > 0.1 * np.linalg.norm(hand)
    assert stage.tool_reference > 3 * stage.hand_reference
    scene = mujoco.MjvScene(stage.model, maxgeom=10)
    stage.add_coupling(scene)
    arrow = scene.geoms[scene.ngeom - 1]
    assert arrow.mat[:, 2] @ hand == pytest.approx(np.linalg.norm(hand), rel=1e-5)


def test_contacts_are_drawn_only_where_mujoco_has_a_force(scaled: tuple[Path, Summary]) -> None:
    replay = Replay(scaled[0])
    drawn = [sight.contact_forces for sight in replay.sights]
    assert all(np.linalg.norm(forces, axis=1).all() for forces in drawn)
    assert not len(drawn[0])  # the peg hangs in the air, with a wrench on it
    stage = Stage(scaled[0])
    stage.show(0)
    scene = mujoco.MjvScene(stage.model, maxgeom=10)
    stage.add_contacts(scene)
    assert scene.ngeom == 0


@pytest.mark.parametrize(
    ("hand", "tool", "text"),
    [
        (1.7, 5.67, "1.7 N on the hand; 5.67 N on the tool"),
        (1.7, 1.7001, "1.7 N on the hand"),
        (None, 5.67, "5.67 N on the tool"),
    ],
)
def test_a_force_is_never_printed_without_its_owner(
    hand: float | None, tool: float, text: str
) -> None:
    assert format_forces(hand, tool) == text


def test_force_and_torque_share_an_owner() -> None:
    assert format_wrenches((1.7, 0.0), (5.67, 0.1)) == (
        "1.7 N, 0 N m on the hand; 5.67 N, 100 mN m on the tool"
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (-0.0, "0 N"),
        (0.99996, "1 N"),
        (1234.0, "1.23 kN"),
        (9.996e-4, "1 mN"),
        (-2e6, "-2 MN"),
        (2.15e9, "2.15 GN"),
    ],
)
def test_a_number_has_three_digits_and_the_prefix_that_fits(value: float, text: str) -> None:
    assert format_si(value, "N") == text


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(20000.0, 4, "20000"), (2412.6, 4, "2413"), (1234.0, 2, "1200"), (1.7, 4, "1.7"), (0, 4, "0")],
)
def test_a_large_number_has_no_exponent(value: float, digits: int, text: str) -> None:
    assert format_number(value, digits) == text


def test_an_angle_and_a_number_of_things_are_written_as_they_are_read() -> None:
    assert [format_degrees(each, 2) for each in (2.43, 2.0 * np.pi)] == ["140 deg", "360 deg"]
    assert [format_count(each, "pair") for each in (1, 2)] == ["1 pair", "2 pairs"]


def test_sentences_on_fast_loops_have_no_exponents(call: Called) -> None:
    _, out, _ = call("check", "point_mass", "--rate", 20000)
    assert "20000 Hz" in out
    assert not re.search(r"\de\+\d", out)
    asked = ("run", "point_mass", "--fast", "--duration", 0.05, "--rate", 20000)
    _, out, err = call(*asked, "--scene-rate", 10000)
    assert "the scene steps at 10000 Hz" in err
    assert not re.search(r"\de\+\d", out + err)


def test_a_stiff_coupling_is_printed_as_it_is_typed(call: Called) -> None:
    _, out, err = call("run", "point_mass", "--fast", "--duration", "0.01", "--stiffness", "20000")
    assert "K = 20000 N/m, B = " in out and "e+04" not in out + err
