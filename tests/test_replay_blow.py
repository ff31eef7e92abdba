"""Blows in pictures and pages: where and when the tool struck, its energy and its pulse."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from tapping import GAP
from view_cases import tapped_wall

from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.recording import read_recording
from hapticbridge.replay.blow import SHOWN, NewestBlow, newest_blow
from hapticbridge.replay.stage import Stage, place_of_blow
from hapticbridge.report.evidence import Evidence, blows_of
from hapticbridge.units import format_energy, format_si

FACE = np.array([GAP + 0.02, 0.0, 0.0])
"""Point of the wall that the tool strikes, in m."""


@pytest.fixture(scope="module")
def tapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tapped_wall(tmp_path_factory.mktemp("tapped"))


def test_the_stage_has_each_blow_with_its_place_energy_and_pulse(tapped: Path) -> None:
    evidence = Evidence.of(read_recording(tapped))
    assert evidence is not None
    blows, rows, stage = blows_of(evidence), evidence.ticks, Stage(tapped)
    assert len(blows) == 2
    ends = [blow.tick - 1 for blow in blows[1:]] + [len(rows) - 1]
    stage.show(blows[0].tick - 1)
    assert stage.blow is None
    for blow, end in zip(blows, ends, strict=True):
        stage.show(end)
        seen = stage.blow
        assert seen is not None
        assert (seen.time, seen.energy) == (blow.time, pytest.approx(blow.burned, rel=1e-12))
        sizes = np.linalg.norm(rows["pulse"][blow.tick + 1 : end + 1], axis=1)
        assert seen.pulse == sizes.max() > 0.3
        # the contact lies in the middle of the gap of less than a step's way
        assert np.linalg.norm(seen.place - FACE) < 0.5e-3 * blow.speed


def test_a_blow_is_the_same_in_large_and_in_small_parts_of_a_run(tapped: Path) -> None:
    rows, place = read_recording(tapped).ticks, np.zeros(3)
    whole = newest_blow(None, rows, place)
    for size in (1, 7):
        parts = None
        for start in range(0, len(rows), size):
            parts = newest_blow(parts, rows[start : start + size], place)
        assert parts == whole is not None


def test_a_pulse_before_any_blow_and_rows_at_rest_show_none() -> None:
    rows = np.zeros(3, TICK_DTYPE)
    assert newest_blow(None, rows, np.zeros(3)) is None
    rows["pulse"][1, 0] = 1.0
    assert newest_blow(None, rows, np.zeros(3)) is None


def test_the_place_is_that_of_the_largest_force_or_else_of_the_grip() -> None:
    row = np.zeros(1, TICK_DTYPE)[0]
    row["tool_position"] = 1.0, 2.0, 3.0
    assert place_of_blow(np.zeros((0, 2, 3)), row).tolist() == [1.0, 2.0, 3.0]
    contacts = np.zeros((2, 2, 3))
    contacts[:, 0, 0], contacts[:, 1, 2] = (5.0, 6.0), (0.5, -2.0)
    assert place_of_blow(contacts, row).tolist() == [6.0, 0.0, 0.0]


def test_a_picture_marks_the_blow_with_words_and_only_for_a_time(tapped: Path) -> None:
    stage = Stage(tapped)
    stage.show(299)
    seen, scene = stage.blow, mujoco.MjvScene(stage.model, maxgeom=10)
    assert seen is not None
    stage.add_blow(scene)
    (mark,) = scene.geoms[: scene.ngeom]
    np.testing.assert_allclose(mark.pos, seen.place, atol=1e-7)
    assert mark.label == seen.words.replace("µ", "u")
    assert format_energy(seen.energy) in seen.words
    assert f"pulse {format_si(seen.pulse, 'N')}" in seen.words
    assert "pulse" not in NewestBlow(0.0, 1, 1e-3, 0.0, np.zeros(3)).words
    full = mujoco.MjvScene(stage.model, maxgeom=0)
    stage.add_blow(full)
    assert full.ngeom == 0
    stage.row["deadline_ns"] += round(1e9 * SHOWN)
    stage.add_blow(scene)
    assert scene.ngeom == 1
