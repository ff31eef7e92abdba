"""A long recording is read and judged block by block, and nothing shows where the blocks end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import recorded, rewritten, tapped
from recording_cases import random_rows, same, write

from hapticbridge.audit import audit
from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice, device_for
from hapticbridge.errors import RecordingError
from hapticbridge.recording import open_recording, read_recording, reader
from hapticbridge.run.bridge import Bridge
from hapticbridge.scene import load_scene

TOO_STIFF = Coupling(9000, 0.5, 1, 1e-3)


@pytest.fixture(scope="module")
def tap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tapped(tmp_path_factory.mktemp("blocks"))


@pytest.mark.parametrize("max_kept", [0, 249, 250])
@pytest.mark.parametrize("size", [1, 7, 100, 1000])
def test_blocks_joined_are_the_records_to_the_bit(
    size: int, max_kept: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "MAX_KEPT", max_kept)
    rows = random_rows(250)
    write(tmp_path / "a.mcap", rows, batch=30)
    file = open_recording(tmp_path / "a.mcap")
    assert (file.kept is None) == (max_kept < 250)
    blocks = list(file.blocks(size))
    assert same(np.concatenate(blocks), rows)
    assert {len(block) for block in blocks[:-1]} <= {size}
    assert len(blocks) == -(-250 // size)


def test_a_file_is_described_alike_with_and_without_its_records(tap: Path) -> None:
    whole, file = vars(read_recording(tap)), vars(open_recording(tap))
    ticks, _ = whole.pop("ticks"), whole.pop("kept")
    assert len(ticks) == file["count"] == file["last_tick"] + 1
    assert same(file.pop("kept"), ticks)
    assert whole == file


def test_a_file_that_changes_between_two_readings_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "MAX_KEPT", 0)
    write(tmp_path / "a.mcap", random_rows(50))
    file = open_recording(tmp_path / "a.mcap")
    write(tmp_path / "a.mcap", random_rows(60))
    with pytest.raises(RecordingError, match="changed while it was read"):
        list(file.blocks())


@pytest.mark.parametrize("options", [{}, {"method": "lossless"}, {"substeps": 2}])
def test_the_report_does_not_depend_on_the_blocks(
    options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tapped(tmp_path, **options)
    whole = audit(path)
    assert whole.environment is not None
    assert whole.energies["slack"] > 0
    monkeypatch.setattr(reader, "BLOCK", 13)
    assert audit(path) == whole


def test_a_device_that_answers_late_is_judged_alike_where_blocks_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The energy given to a late device depends on motion that stands in the next block."""
    path, scene = tmp_path / "late.mcap", load_scene("virtual_wall")
    late = device_for(scene, "simulated:damping=0.5")
    assert isinstance(late, SimulatedDevice)
    late.info = replace(late.info, delay=3e-3)
    recorded(path, scene, late, TOO_STIFF, duration=0.5)
    whole = audit(path)
    assert (whole.verdict, whole.port) == ("active", "device")
    for size in (2, 40):
        monkeypatch.setattr(reader, "BLOCK", size)
        assert audit(path) == whole


def test_pauses_and_inputs_are_repeated_where_blocks_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An input in every tenth tick; with blocks of ten, each stands where a block begins."""

    def push(bridge: Bridge, tick: int) -> None:
        if tick % 10 == 0:
            bridge.set_input(body_wrench={"tool": [0.1, 0, 0, 0, 0, 0]})

    path = tmp_path / "a.mcap"
    recorded(path, "point_mass", duration=0.1, on_tick=push)
    for size in (10, 15, 1000):
        monkeypatch.setattr(reader, "BLOCK", size)
        assert audit(path).resimulation == "bit for bit"


@pytest.mark.parametrize(
    ("name", "place", "change"),
    [
        ("device_energy", slice(150, 151), 1e-3),
        ("deadline_ns", slice(150, None), 1000),
        ("kinetic", slice(150, 151), np.nan),
        ("solver_iterations", slice(150, 151), 1),
    ],
)
def test_a_fault_is_found_at_its_tick_whatever_the_blocks(
    name: str,
    place: slice,
    change: float,
    tap: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording = read_recording(tap)
    rows = recording.ticks.copy()
    rows[name][place] += change
    if name == "kinetic":
        rows["tick"][20] = 7  # an earlier fault of a kind that is looked at later
    path = rewritten(recording, tmp_path / "changed.mcap", ticks=rows)
    whole = audit(path)
    assert (whole.verdict, whole.tick) == ("invalid", 150)
    monkeypatch.setattr(reader, "BLOCK", 64)
    assert audit(path).reason == whole.reason
