"""``hapticbridge scenes`` and ``hapticbridge new-scene``."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_cases import Called, facts_of, one_sentence
from outside_scenes import scene_file, stl_bytes


def test_the_next_command_of_a_scene_runs(call: Called) -> None:
    _, out, _ = call("scenes", "planar_peg")
    command = out.splitlines()[-1].removeprefix("next: hapticbridge ")
    assert call(*command.split(), "--fast", "--duration", "0.1")[0] == 0


def test_a_scene_of_one_s_own_is_shown_whatever_its_grip_is_called(
    call: Called, tmp_path: Path
) -> None:
    """Without a hand no grip is needed; a scene that does not compile is refused as ever."""
    path = tmp_path / "chisel.xml"
    text = "<mujoco><worldbody><body><freejoint/><geom size='.01'{}/>{}</body></worldbody></mujoco>"
    for site in ("<site name='hand'/>", ""):
        path.write_text(text.format("", site))
        code, out, err = call("scenes", path)
        assert (code, err) == (0, "")
        assert "1 moving body, 6 degrees of freedom" in out
    path.write_text(text.format(" mass='0'", ""))
    code, _, err = call("scenes", path)
    assert code == 2
    assert "error: cannot compile scene" in err
    mesh = "<asset><mesh name='m' file='m.stl'/></asset><worldbody><geom type='mesh' mesh='m'/>"
    path.write_text(f"<mujoco>{mesh}</worldbody></mujoco>")
    code, _, err = call("scenes", path)
    assert code == 2
    assert f"'m.stl', looked for in '{tmp_path}' and its meshdir or texturedir" in err
    assert err.rstrip().endswith("if it names one")
    for absolute in ("/nowhere/m.stl", "C:/nowhere/m.stl"):
        path.write_text(f"<mujoco>{mesh}</worldbody></mujoco>".replace("m.stl", absolute))
        code, _, err = call("scenes", path)
        sentence = f"'{absolute}', an absolute path; write it relative to the scene's file"
        assert (code, err.rstrip().endswith(sentence)) == (2, True)


@pytest.mark.parametrize("is_mended", [False, True])
def test_a_mesh_that_is_not_found_is_told_with_what_finds_it(
    is_mended: bool, call: Called, tmp_path: Path
) -> None:
    """The mesh is found where the scene has what the message says."""
    scene_file(tmp_path / "parts" / "m", stl_bytes(), "m.stl")
    mesh = "<asset><mesh name='m' file='m.stl'/></asset>"
    part = "<mujoco><compiler meshdir='m'/><worldbody><geom type='mesh' mesh='m'/></worldbody>"
    (tmp_path / "parts" / "part.xml").write_text(f"{part}{mesh}</mujoco>")
    scene, robot = tmp_path / "own" / "scene.xml", tmp_path / "own" / "robot.urdf"
    scene.parent.mkdir()
    later = "<compiler meshdir='../parts/m'/>" if is_mended else ""
    scene.write_text(f"<mujoco><include file='../parts/part.xml'/>{later}</mujoco>")
    compiler = '<mujoco><compiler strippath="true" meshdir="../parts/m"/></mujoco>'
    found = compiler if is_mended else ""
    mesh = '<geometry><mesh filename="package://arm/parts/m.stl"/></geometry>'
    link = f'<link name="base"><collision>{mesh}</collision></link>'
    robot.write_text(f'<robot name="arm">{found}{link}</robot>')
    for path, words in ((scene, 'meshdir="FOLDER"/> behind its <include>'), (robot, "strippath")):
        code, _, err = call("scenes", path)
        assert (code, words in err) == ((0, False) if is_mended else (2, True))


def test_a_new_scene_has_no_fault_and_runs(
    call: Called, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, _ = call("new-scene", "stylus")
    assert code == 0
    assert "next: hapticbridge run stylus/stylus.xml" in out
    assert {path.name for path in Path("stylus").iterdir()} == {
        "README.md",
        "stylus.csv",
        "stylus.toml",
        "stylus.xml",
    }
    assert not any("NAME" in path.read_text(encoding="utf-8") for path in Path("stylus").iterdir())
    code, out, _ = call("check", "stylus/stylus.xml")
    assert code == 0
    assert "nothing found" in out
    code, facts = facts_of(call, "run", "stylus/stylus.xml", "--fast", "--set", "mass=0.2")
    assert code == 0
    assert facts["environment"] == "strict"
    assert facts["ticks"] > 7000  # the whole motion of its hand


@pytest.mark.parametrize("name", ["", "Stylus", "a/b", "../a", "1a", "a" * 65, "peg_in_hole"])
def test_a_name_that_no_scene_can_have_is_refused(
    call: Called, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = call("new-scene", name)
    assert code == 2
    assert "name" in one_sentence(err)
    assert not list(tmp_path.iterdir())


def test_a_new_scene_replaces_nothing(
    call: Called, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("stylus").write_text("mine", encoding="utf-8")
    code, _, err = call("new-scene", "stylus")
    assert code == 2
    assert "'stylus' exists" in one_sentence(err)
    assert Path("stylus").read_text(encoding="utf-8") == "mine"
