from __future__ import annotations

import json
from pathlib import Path

import pytest
from outside_scenes import CONTACT, hand_file, mjcf, scene_file

from hapticbridge.cli import main
from hapticbridge.cli.main import USAGE_ERROR

Capsys = pytest.CaptureFixture[str]

RIVETS = "".join(
    f'<geom name="rivet_{k}" size="0.002" pos="{0.01 * k} 0.1 0" contype="0" conaffinity="0"/>'
    for k in range(300)
)
OPTION = (
    '<option timestep="0.001" gravity="0 0 0" integrator="discrete" cone="elliptic">'
    '<flag diagexact="enable"/></option>'
)
TOOL = f"""<body name="tool"><joint name="rail" type="slide" axis="0 0 1"/>
  <geom name="ball" size="0.01" mass="0.05" {CONTACT}/><site name="tip"/></body>"""
WALL = f'<geom name="wall" type="box" size="0.03 0.03 0.01" pos="0 0 -0.025" {CONTACT}/>'


@pytest.fixture
def studded(tmp_path: Path) -> tuple[str, ...]:
    """A tool on a rail before a wall with 400 rivets that are only seen, and its hand's motion."""
    scene = scene_file(tmp_path, mjcf(OPTION, body=TOOL, world=WALL + RIVETS))
    hand = hand_file(tmp_path, [(0.2, (0.0, 0.0, -0.008)), (0.2, (0.0, 0.0, 0.0))])
    return str(scene), "--grip", "tip", "--motion", str(hand)


def test_check_writes_a_leaner_scene_that_runs(
    studded: tuple[str, ...], tmp_path: Path, capsys: Capsys
) -> None:
    lean, picture, table = (tmp_path / name for name in ("lean.xml", "lean.png", "tried.csv"))
    files = ["--write", str(lean), "--plot", str(picture), "--table", str(table)]
    assert main(["check", *studded, *files]) == 0
    said = capsys.readouterr().out
    assert "What could go" in said
    assert "nothing only seen" in said
    assert "may go with the picture" in said
    assert f"next: hapticbridge run {lean} --grip tip" in said
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert table.read_text(encoding="utf-8").startswith("step,name,verdict")
    assert "rivet" not in lean.read_text(encoding="utf-8")
    assert main(["run", str(lean), "--grip", "tip", "--fast", "--duration", "0.2"]) == 0


def test_json_holds_what_was_tried(studded: tuple[str, ...], capsys: Capsys) -> None:
    assert main(["check", *studded, "--lean", "--budget", "0.5", "--json"]) == 0
    lean = json.loads(capsys.readouterr().out)["lean"]
    assert lean["budget_jnd"] == 0.5
    assert lean["result"]["felt_jnd"] <= 0.5
    alone = {trial["name"]: trial for trial in lean["alone"]}
    assert alone["nothing only seen"]["felt_jnd"] < 1e-6
    assert alone["no friction"]["environment"] == "strict"
    assert lean["written"] is None


def test_bad_input_is_refused_before_anything_is_run(
    studded: tuple[str, ...], tmp_path: Path, capsys: Capsys
) -> None:
    for extra, words in (
        (["--lean", "--budget", "-1"], "budget"),
        (["--lean", "--budget", "nan"], "budget"),
        (["--write", studded[0]], "is a file of the scene itself"),
        (["--write", str(tmp_path / "lean.txt")], "must end in .xml"),
        (["--table", str(tmp_path / "tried.txt")], "must end in .csv"),
        (["--table", str(tmp_path / "scene.csv")], "taken for the hand's motion in 'scene.xml'"),
        (
            ["--write", str(tmp_path / "lean.xml"), "--table", str(tmp_path / "lean.csv")],
            "taken for the hand's motion in 'lean.xml'",
        ),
    ):
        assert main(["check", *studded, *extra]) == USAGE_ERROR
        captured = capsys.readouterr()
        assert words in captured.err
        assert captured.out == ""


def test_scene_that_must_be_mended_first_is_told_so(
    studded: tuple[str, ...], tmp_path: Path, capsys: Capsys
) -> None:
    inside = WALL.replace("-0.025", "-0.015")
    scene_file(tmp_path, mjcf(OPTION, body=TOOL, world=inside))
    assert main(["check", *studded, "--lean"]) == 1
    assert "what could go cannot be said: the tool starts" in capsys.readouterr().err
