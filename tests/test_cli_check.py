"""``hapticbridge check``: counts, faults and cost of a scene, and a leaner scene."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import mujoco
import pytest
from check_scenes import PLANTS, bench, line_of
from cli_cases import Called, facts_of
from outside_scenes import CONTACT, hand_file, mjcf, scene_file

from hapticbridge.recording import read_recording
from hapticbridge.scene import scene_path
from hapticbridge.scene.fault import FAILS

PLANT = {plant.kind: plant for plant in PLANTS}


def test_check_tells_counts_stiffness_and_cost(tmp_path: Path, call: Called) -> None:
    picture = tmp_path / "check.png"
    code, out, _ = call("check", "virtual_wall", "--plot", picture)
    assert code == 0
    for words in (
        "bodies               1, 1 of them moving",
        "pairs that can touch 1, 1 did",
        "contact rows         at most 1 in a step",
        "contact stiffness    21,200 to 21,200 kN/m at the tool",
        "(rigid contacts; solref and solimp of the scene give no softness)",
        "only visual: geom 'bench', geom 'rail'",
        "whole tick, median",
        "highest rate:",
        "nothing found",
    ):
        assert words in out
    assert picture.read_bytes().startswith(b"\x89PNG")
    _, out, _ = call("check", "virtual_wall", "--contact", "scene")
    assert "kN/m at the tool" in out and "21,200" not in out
    assert "(contacts of the scene, by its solref and solimp)" in out


def test_check_prints_every_change_of_a_run(tmp_path: Path, call: Called) -> None:
    """A seventh change is not counted as one more of its kind: it is another change."""
    path = tmp_path / "changed.xml"
    path.write_text(
        """<mujoco><option timestep="0.001" iterations="7" ls_iterations="7" tolerance="1e-3"
        ls_tolerance="0.1" impratio="3" noslip_iterations="2"/><worldbody><body><freejoint/>
        <geom size=".02" mass=".1"/><site name="grip"/></body></worldbody></mujoco>"""
    )
    _, out, _ = call("check", path)
    names = "iterations", "ls_iterations", "tolerance", "ls_tolerance", "impratio", "cone"
    assert [f"a change, {name}: " in out for name in (*names, "noslip_iterations")] == [True] * 7
    assert "more of 'changed'" not in out


@pytest.mark.parametrize(
    ("contact", "words"),
    [("rigid", "as rigid impacts"), ("scene", "by MuJoCo's springs, as in the file")],
)
def test_check_names_what_bounces_and_how(
    contact: str, words: str, tmp_path: Path, call: Called
) -> None:
    text = scene_path("virtual_wall").read_text(encoding="utf-8")
    line = f"e at most 0.74 ({words}): "
    back = "1 m/s comes back as 0.74 m/s, a fall of 100 mm rebounds to "
    line += back if contact == "rigid" else "how far depends on the time step, too"
    for solref, is_said in (("0.002 0.1", True), ("0.002 1", False)):
        path = tmp_path / "wall.xml"
        path.write_text(text.replace('solref="0.002 1"', f'solref="{solref}"'), encoding="utf-8")
        _, out, _ = call("check", path, "--contact", contact)
        assert (line in " ".join(out.split())) == is_said


@pytest.mark.parametrize("contact", ["scene", "rigid"])
@pytest.mark.parametrize("solref", ["0.02 0.1", "0.02 1"])
@pytest.mark.filterwarnings("ignore::hapticbridge.errors.SceneWarning")
def test_a_run_with_the_scenes_contacts_says_that_they_bounce(
    call: Called, tmp_path: Path, contact: str, solref: str
) -> None:
    """MuJoCo's contact alone: e = 0.74 here; with 0.005 0.1 at 1 ms, 100 mm rebound to 514 mm."""
    text = scene_path("virtual_wall").read_text(encoding="utf-8")
    scene = tmp_path / "wall.xml"
    scene.write_text(text.replace('solref="0.002 1"', f'solref="{solref}"'), encoding="utf-8")
    words = ("--fast", "--duration", 0.01, "--contact", contact)
    told = "MuJoCo's springs bounce by themselves: geom" in call("run", scene, *words)[2]
    assert told == (contact == "scene" and solref == "0.02 0.1")


def test_check_says_what_a_device_can_answer_a_tap_with(call: Called) -> None:
    code, facts = facts_of(call, "check", "virtual_wall")
    tap = facts["tap"]
    assert (code, tap["spare"]) == (0, pytest.approx(0.3))
    kept = math.exp(-1e-3 / 0.0125) * tap["burned"]  # of wood, after the account's first tick
    assert tap["pulse"] == pytest.approx(2 * math.sqrt(tap["spare"] * kept / 1e-3))
    out = call("check", "virtual_wall")[1]
    words = (
        "a tap at 0.2 m/s takes up to 1 mJ from the tool, which pays for a pulse of up to 1.05 N"
    )
    assert f"impact pulses        {words} on the hand" in out
    assert facts_of(call, "check", "virtual_wall", "--contact", "scene")[1]["tap"] is None
    assert "impact pulses" not in call("check", "virtual_wall", "--contact", "scene")[1]
    # its pawl turns on the tool: (10 g and 1e-5 kg m² of armature) at 20 mm from the pin
    tap = facts_of(call, "check", "ratchet")[1]["tap"]
    assert 0.5 * 0.2**2 * 1e-5 / 0.02**2 < tap["burned"] < 0.5 * 0.2**2 * (0.01 + 1e-5 / 0.02**2)


def test_a_pulse_that_is_none_is_told_and_refused_by_a_run_that_needs_it(
    call: Called, tmp_path: Path
) -> None:
    scene = tmp_path / "peg.xml"
    text = scene_path("virtual_wall").read_text(encoding="utf-8")
    named = '<custom><text name="pulse" data="brass"/></custom></mujoco>'
    scene.write_text(text.replace("</mujoco>", named), encoding="utf-8")
    told = "the scene's custom text 'pulse' is 'brass'; it must be one of"
    code, out, _ = call("check", scene)
    assert code == 0
    assert f"none can be given: {told}" in " ".join(out.split())
    assert facts_of(call, "check", scene)[1]["tap"] is None
    code, _, err = call("run", scene, "--fast", "--impact-pulses", 1)
    assert code == 2
    assert told in " ".join(err.split())


def test_run_and_check_foresee_the_same_tap(call: Called, tmp_path: Path) -> None:
    """A run compares the file's motion with the bridge's first, and holds the tool for it."""
    scene = tmp_path / "peg.xml"
    scene.write_text(
        """<mujoco><option timestep="0.001"/><worldbody><geom type="plane" size="1 1 .1"/>
        <body name="tool" pos="0 0 .1"><freejoint/><geom type="box" size=".01 .01 .01" mass=".2"/>
        <site name="grip"/></body></worldbody></mujoco>"""
    )
    words = "a tap at 0.2 m/s takes up to 4 mJ"
    _, _, err = call("run", scene, "--fast", "--duration", 0.1, "--impact-pulses", 1)
    assert words in " ".join(err.split())
    assert words in " ".join(call("check", scene)[1].split())


@pytest.mark.parametrize("is_fused", [False, True])
def test_check_names_a_body_whose_inertia_mujoco_refuses(
    is_fused: bool, tmp_path: Path, call: Called
) -> None:
    rod = "<body name='rod'><joint/><inertial pos='0 0 0' mass='1' diaginertia='0 0 0'/></body>"
    base = f"<body name='base'><geom size='.01'/>{rod}</body>"
    fuse = f"<compiler fusestatic='{str(is_fused).lower()}'/>"
    code, out, _ = call("check", scene_file(tmp_path, mjcf(fuse, world=base)))
    assert code == 1
    assert "body 'rod' moves, and MuJoCo refuses its inertia" in out


@pytest.mark.parametrize("name", ["tip", ""])
@pytest.mark.parametrize("joint", ["", "<joint/>"])
def test_check_names_a_refused_body_that_is_fused_with_its_parent(
    name: str, joint: str, tmp_path: Path, call: Called
) -> None:
    """A body that has no joint is no body of the compiled scene, whatever its number."""
    rod = "<inertial pos='0 0 0' mass='.1' diaginertia='1e-5 1e-5 1'/>"
    tip = f"<body{f' name={name!r}' if name else ''}>{joint}{rod}</body>"
    tool = f"<body name='grip'><freejoint/><geom size='.01' mass='.1'/>{tip}</body>"
    fuse = "<compiler fusestatic='true'/>"
    code, out, err = call("check", scene_file(tmp_path, mjcf(fuse, body=tool)))
    assert code == 1, err
    assert f"body {f'{name!r}' if name else 2} moves, and MuJoCo refuses its inertia" in out


def test_check_says_what_a_run_says_where_no_stand_in_helps(tmp_path: Path, call: Called) -> None:
    """Bodies with a stand-in are not fused, and below one of them MuJoCo takes no free joint."""
    rod = "<inertial pos='0 0 0' mass='.1' diaginertia='1e-5 1e-5 1'/>"
    tool = "<body name='grip'><freejoint/><geom size='.01' mass='.1'/></body>"
    stand = f"<body name='stand'>{rod}{tool}<body>{rod}</body></body>"
    scene = scene_file(tmp_path, mjcf("<compiler fusestatic='true'/>", body=stand))
    found = [call(*words, scene) for words in (("check",), ("run", "--fast"))]
    assert found[0] == found[1]
    assert found[0][0] == 2
    assert "A + B >= C" in found[0][2]


LINK = """<robot name="r">{}<link name="base"/><link name="tool"><inertial><mass value="0.3"/>
<inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial></link>
<joint name="j" type="prismatic"><parent link="base"/><child link="tool"/>
<limit lower="-1" upper="1" effort="0" velocity="1"/></joint></robot>"""


def test_check_says_where_a_urdf_takes_what_it_names(tmp_path: Path, call: Called) -> None:
    """The finding is gone once the file has what the note says."""
    path = scene_file(tmp_path, LINK.format(""), "arm.urdf")
    _, out, _ = call("check", path, "--grip", "tool")
    assert 'timestep="0.001"' in out
    assert "<option> and <compiler> go into <mujoco> in <robot>" in out
    own = '<mujoco><option timestep="0.001"/></mujoco>'
    path = scene_file(tmp_path, LINK.format(own), "arm.urdf")
    assert 'timestep="0.001"' not in call("check", path, "--grip", "tool")[1]
    text = mujoco.MjSpec.from_file(str(path)).to_xml()
    _, out, _ = call("check", scene_file(tmp_path, text), "--grip", "tool")
    assert "URDF" not in out


def test_check_says_where_a_urdf_that_does_not_compile_takes_its_inertia(
    tmp_path: Path, call: Called
) -> None:
    """MuJoCo makes no MJCF of it, so the file itself has to be mended."""
    text = LINK.format("")
    broken = scene_file(tmp_path, text.replace('izz="1e-4"', 'izz="9e-4"'), "arm.urdf")
    with pytest.raises(ValueError, match="inertia must satisfy"):
        mujoco.MjSpec.from_file(str(broken)).to_xml()
    code, out, _ = call("check", broken, "--grip", "tool")
    assert code == 1
    assert "write: the right inertia, or" in out
    assert "mass and inertia into <inertial> in <link>" in out
    code, out, _ = call("check", scene_file(tmp_path, text, "arm.urdf"), "--grip", "tool")
    assert code == 0
    assert "inertia, or" not in out


def test_check_draws_a_motion_too_short_to_measure_growth(tmp_path: Path, call: Called) -> None:
    picture, motion = tmp_path / "check.png", tmp_path / "short.csv"
    motion.write_text("t,x,y,z\n0,0,0,0\n0.05,0.001,0,0\n")
    code, out, err = call("check", "point_mass", "--motion", motion, "--plot", picture)
    assert code == 0, err
    assert f"run point_mass --device simulated:path={motion}" in " ".join(out.split())
    assert picture.exists()


def test_check_names_line_and_change_of_a_fault(tmp_path: Path, call: Called) -> None:
    plant = PLANT["margin"]
    scene = bench(tmp_path / "scene", plant)
    scene.with_suffix(".csv").unlink()
    assert "What is wrong\n  nothing found" in call("check", scene)[1]
    code, out, _ = call("check", scene, "--contact", "scene")
    file, line = line_of(plant, scene)
    assert f" margin  {file}:{line}, geom 'button'" in out
    assert 'to change it: margin="0"' in out
    assert code == 0
    assert "motion: the default hand motion: slow, 1 cm along and 0.1 rad about each axis" in out


def test_the_json_holds_counts_faults_and_cost(tmp_path: Path, call: Called) -> None:
    scene = bench(tmp_path / "scene", PLANT["keyframe"])
    code, facts = facts_of(call, "check", scene, "--rate", 2000, "--stiffness", 1000)
    assert (code, facts["period_s"], facts["coupling"]["stiffness"]) == (0, 0.0005, 1000)
    assert facts["inventory"]["degrees_of_freedom"] == 14
    assert {"free", "contact", "stages", "highest_rate", "by_rows"} <= facts["cost"].keys()
    [fault] = facts["faults"]
    assert (fault["kind"], fault["place"]["file"]) == ("keyframe", "bench.xml")
    assert fault["is_note"]


def test_code_1_is_for_what_fails_and_not_for_advice(tmp_path: Path, call: Called) -> None:
    advice = [plant for plant in PLANTS if not FAILS[plant.kind]]
    code, out, _ = call("check", bench(tmp_path / "advice", *advice))
    assert (code, "What is wrong\n  nothing found" in out) == (0, True)
    for kind in ("density of water", "heavy tool", "visual geom with mass", "far grip"):
        assert f" {kind}  " in out.partition("Worth knowing")[2]
    scene = bench(tmp_path / "fault", PLANT["margin"], PLANT["not passive"])
    code, out, _ = call("check", scene, "--contact", "scene")
    assert (code, "What is wrong: 1 found" in out) == (1, True)


def test_a_recording_is_a_motion_too(tmp_path: Path, call: Called) -> None:
    recording = tmp_path / "run.mcap"
    call("run", "virtual_wall", "--fast", "--duration", 0.5, "--record", recording)
    code, facts = facts_of(call, "check", "virtual_wall", "--motion", recording)
    length = 0.001 * (len(read_recording(recording).ticks) - 1)
    assert (code, facts["motion"]["seconds"]) == (0, pytest.approx(length))


def test_scale_and_workspace_decide_if_the_motion_fits(call: Called) -> None:
    code, out, _ = call("check", "drawer", "--workspace", 0.1)
    assert (code, "run it with --scale 2.0" in out) == (1, True)
    assert call("check", "drawer", "--workspace", 0.1, "--scale", 2.1)[0] == 0


def test_parameters_of_a_scene_are_checked_as_set(call: Called) -> None:
    code, facts = facts_of(call, "check", "peg_in_hole", "--set", "clearance=0.0005")
    assert (code, facts["parameters"]["clearance"]) == (0, 0.0005)
    assert facts["inventory"]["possible_pairs"] == 5
    usual = facts_of(call, "check", "peg_in_hole")[1]["inventory"]
    assert facts["inventory"]["deepest"] != usual["deepest"]


@pytest.mark.parametrize(("margin", "words"), [(0, "sank in by"), (0.003, "a margin kept 3 mm")])
def test_a_tool_that_a_margin_keeps_away_did_not_sink_in(
    margin: float, words: str, tmp_path: Path, call: Called
) -> None:
    floor = f"<geom type='plane' size='1 1 1' margin='{margin}'/>"
    tool = "<geom type='box' size='.02 .02 .02' mass='.1'/><site name='grip'/>"
    body = f"<body pos='0 0 {0.02 + margin}'><joint type='slide' axis='0 0 1'/>{tool}</body>"
    path = tmp_path / "a.xml"
    path.write_text(f"<mujoco><worldbody>{floor}{body}</worldbody></mujoco>")
    code, out, _ = call("check", path)
    (line,) = (each for each in out.splitlines() if "contact stiffness" in each)
    assert (code, words in line, "-" in line) == (0, True, False)


def test_check_leaves_no_log_of_mujocos_warnings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Called
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = bench(tmp_path / "scene", PLANT["mass ratio"], PLANT["solver iterations"])
    assert " mass ratio  " in call("check", scene)[1]
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_a_copy_of_a_scene_in_another_folder_is_read_where_it_lies(
    tmp_path: Path, call: Called
) -> None:
    copy = tmp_path / "round_peg"
    shutil.copytree(scene_path("round_peg").parent, copy)
    code, facts = facts_of(call, "check", copy / "round_peg.xml")
    assert (code, facts["scene"]) == (0, str(copy / "round_peg.xml"))


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
    """A tool on a rail before a wall with 300 rivets that are only seen, and its hand's motion."""
    scene = scene_file(tmp_path, mjcf(OPTION, body=TOOL, world=WALL + RIVETS))
    hand = hand_file(tmp_path, [(0.2, (0.0, 0.0, -0.008)), (0.2, (0.0, 0.0, 0.0))])
    return str(scene), "--grip", "tip", "--motion", str(hand)


def test_check_writes_a_leaner_scene_that_runs(
    studded: tuple[str, ...], tmp_path: Path, call: Called
) -> None:
    lean = tmp_path / "lean.xml"
    code, out, _ = call("check", *studded, "--write", lean)
    assert code == 0
    run = f"hapticbridge run {lean} --grip tip --device simulated:path={studded[-1]}"
    for words in ("What could go", "nothing only seen", "may go with the picture", f"next: {run}"):
        assert words in out
    assert "rivet" not in lean.read_text(encoding="utf-8")
    assert call(*run.split()[1:], "--fast", "--duration", 0.2)[0] == 0


def test_the_json_holds_what_was_tried(studded: tuple[str, ...], call: Called) -> None:
    code, facts = facts_of(call, "check", *studded, "--lean", "--budget", 0.5)
    lean = facts["lean"]
    assert (code, lean["budget_jnd"], lean["written"]) == (0, 0.5, None)
    assert lean["result"]["felt_jnd"] <= 0.5
    alone = {trial["name"]: trial for trial in lean["alone"]}
    assert alone["nothing only seen"]["felt_jnd"] < 1e-6
    assert alone["no friction"]["environment"] == "strict"


def test_bad_input_is_refused_before_anything_is_run(
    studded: tuple[str, ...], tmp_path: Path, call: Called
) -> None:
    for extra, words in (
        ("--lean --budget -1", "budget"),
        ("--lean --budget nan", "budget"),
        (f"--write {studded[0]}", "is a file of the scene itself"),
        (f"--write {tmp_path}/lean.txt", "must end in .xml"),
        (f"--write {tmp_path}/no/lean.xml", f"the folder {tmp_path}/no does not exist"),
        (f"--plot {tmp_path}/no/check.png", f"the folder {tmp_path}/no does not exist"),
    ):
        code, out, err = call("check", *studded, *extra.split())
        assert (code, out) == (2, "")
        assert words in err


def test_a_scene_that_must_be_mended_first_is_not_made_leaner(
    studded: tuple[str, ...], tmp_path: Path, call: Called
) -> None:
    home = "<keyframe><key name='home' qvel='1e11'/></keyframe>"
    scene_file(tmp_path, mjcf(OPTION, home, body=TOOL, world=WALL))
    code, _, err = call("check", *studded, "--lean")
    assert (code, "what could go cannot be said: the scene's start" in err) == (1, True)
