from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from check_scenes import PLANTS, bench, line_of

from hapticbridge.cli import main
from hapticbridge.recording import read_recording
from hapticbridge.scene import scene_path

PLANT = {plant.kind: plant for plant in PLANTS}


def facts_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, object]]:
    code = main(["check", *arguments, "--json"])
    facts: dict[str, object] = json.loads(capsys.readouterr().out)
    return code, facts


def test_check_says_what_costs_and_what_is_right(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "check.png"
    assert main(["check", "virtual_wall", "--plot", str(picture)]) == 0
    said = capsys.readouterr().out
    for words in (
        "bodies               1, 1 of them moving",
        "pairs that can touch 1, 1 did",
        "contact rows         at most 1 in a step",
        "contact stiffness    119 to 119 kN/m at the tool",
        "only visual: geom 'bench', geom 'rail'",
        "whole tick, median",
        "highest rate:",
        "nothing found",
    ):
        assert words in said
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_check_names_line_and_change_of_a_fault(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant = PLANT["margin"]
    scene = bench(tmp_path / "scene", plant)
    assert main(["check", str(scene)]) == 1
    said = capsys.readouterr().out
    file, line = line_of(plant, scene)
    assert f" 1 margin  {file}:{line}, geom 'button'" in said
    assert 'write: margin="0"' in said
    assert "1 found" in said


def test_json_holds_counts_faults_and_cost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = bench(tmp_path / "scene", PLANT["keyframe"])
    code, facts = facts_of(capsys, str(scene), "--rate", "2000", "--stiffness", "1000")
    assert code == 1
    assert facts["period_s"] == 0.0005
    coupling, inventory, cost = facts["coupling"], facts["inventory"], facts["cost"]
    assert isinstance(coupling, dict) and isinstance(inventory, dict) and isinstance(cost, dict)
    assert coupling["stiffness"] == 1000
    assert inventory["degrees_of_freedom"] == 14
    assert {"free", "contact", "stages", "highest_rate", "by_rows"} <= cost.keys()
    faults = facts["faults"]
    assert isinstance(faults, list)
    assert [fault["kind"] for fault in faults] == ["keyframe"]
    assert faults[0]["place"]["file"] == "bench.xml"


def test_scene_without_a_motion_follows_the_default_hand_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = bench(tmp_path / "scene")
    scene.with_suffix(".csv").unlink()
    main(["check", str(scene)])
    assert "motion: the default hand motion: slow, 1 cm about each axis" in capsys.readouterr().out


def test_recording_is_a_motion_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = tmp_path / "run.mcap"
    run = ["run", "virtual_wall", "--fast", "--duration", "0.5", "--record", str(recording)]
    assert main(run) == 0
    capsys.readouterr()
    code, facts = facts_of(capsys, "virtual_wall", "--motion", str(recording))
    assert code == 0
    motion = facts["motion"]
    assert isinstance(motion, dict)
    assert motion["seconds"] == pytest.approx(0.001 * (len(read_recording(recording).ticks) - 1))


def test_scale_and_workspace_decide_whether_the_motion_fits(
    capsys: pytest.CaptureFixture[str],
) -> None:
    narrow = ["check", "drawer", "--workspace", "0.1"]
    assert main(narrow) == 1
    assert "run it with --scale 2.0" in capsys.readouterr().out
    assert main(["check", "drawer", "--workspace", "0.1", "--scale", "2.1"]) == 0


def test_parameters_of_a_scene_are_checked_as_set(capsys: pytest.CaptureFixture[str]) -> None:
    code, facts = facts_of(capsys, "peg_in_hole", "--set", "clearance=0.0005")
    parameters, inventory = facts["parameters"], facts["inventory"]
    assert code == 0
    assert isinstance(parameters, dict) and isinstance(inventory, dict)
    assert parameters["clearance"] == 0.0005
    assert inventory["possible_pairs"] == 5
    _, other = facts_of(capsys, "peg_in_hole")
    before = other["inventory"]
    assert isinstance(before, dict)
    assert inventory["deepest"] != before["deepest"]


def test_check_leaves_no_log_of_mujocos_warnings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "scene"
    scene = bench(folder, PLANT["mass ratio"], PLANT["solver iterations"])
    assert main(["check", str(scene)]) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_scene_of_somebody_else_in_another_folder_is_read_where_it_lies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "round_peg"
    shutil.copytree(scene_path("round_peg").parent, copy)
    code, facts = facts_of(capsys, str(copy / "round_peg.xml"))
    assert code == 0
    assert facts["scene"] == str(copy / "round_peg.xml")
