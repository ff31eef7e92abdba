"""Recordings for viewers: a file for rerun, a layout for Foxglove."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from hapticbridge.export import export
from hapticbridge.export_viewers import ENERGIES
from hapticbridge.recording import read_recording


def test_every_path_of_the_layout_is_in_the_recording(run_file: Path, tmp_path: Path) -> None:
    export(run_file, "foxglove", tmp_path / "layout.json")
    layout = json.loads((tmp_path / "layout.json").read_text())
    panels = layout["configById"]
    with run_file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        topics = {channel.topic for channel in summary.channels.values()}
        first = {
            channel.topic: value
            for _, channel, _, value in reader.iter_decoded_messages(
                topics=["/tick", "/wrench_on_hand"]
            )
        }
    paths = [each["value"] for panel in panels.values() for each in panel.get("paths", [])]
    assert len(paths) == 3 + len(ENERGIES)
    for path in paths:
        topic, *fields = path.split(".")
        value = first[topic]
        for field in fields:
            value = getattr(value, field)
        assert isinstance(value, float)
    assert set(panels["3D!scene"]["topics"]) <= topics
    assert panels["RosOut!events"]["topicToRender"] in topics

    def shown(part: object) -> list[str]:
        if isinstance(part, str):
            return [part]
        assert isinstance(part, dict)
        return shown(part["first"]) + shown(part["second"])

    assert sorted(shown(layout["layout"])) == sorted(panels)


def test_rerun_reads_its_file(run_file: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    target = tmp_path / "run.rrd"
    done = export(run_file, "rerun", target)
    assert done.ticks == len(read_recording(run_file).ticks)

    def rerun(*words: str) -> str:
        command = [sys.executable, "-m", "rerun", "rrd", *words, str(target)]
        found = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
        return found.stdout + found.stderr

    assert "without error" in rerun("verify")
    counts = rerun("stats")
    for entity in ("scene/handle", "scene/tool", "scene/force_on_hand", "force/on_hand", "events"):
        assert f"/{entity}: " in counts
    assert "/view/" in counts, "the panels' arrangement"
