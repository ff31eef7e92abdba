"""Claims about what a hand may hold in a scene."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from cli_cases import Called
from outside_scenes import mjcf, refusal, refusal_of, scene_file

import hapticbridge as hb
from hapticbridge.kernel.codes import Grip
from hapticbridge.scene import grips
from hapticbridge.whatif import what_if

ARM = """<body name="base" pos="0 0 .5">
  <geom name="plate" size=".05" mass="4"/>
  <body name="upper" pos="0 0 .1"><joint name="shoulder" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/>
    <site name="imu" pos=".1 0 0"/>
    <body name="hand" pos=".3 0 0"><joint name="wrist" axis="0 1 0"/><joint type="slide"/>
      <geom size=".02" pos=".04 0 0" mass=".2"/>
      {site}
    </body>
  </body>
</body>"""
TURNED = "<default><site pos='1 2 3' euler='90 0 0'/></default>"


def arm(site: str = "") -> str:
    box = "<body pos='1 0 0'><freejoint/><geom size='.1' mass='50'/></body>"
    return mjcf(TURNED, "<compiler angle='degree'/>", body=ARM.format(site=site), world=box)


def test_without_a_grip_the_most_plausible_are_offered(tmp_path: Path, call: Called) -> None:
    path = scene_file(tmp_path, arm('<site name="tcp"/>'))
    found = [grip.name for grip in grips(mujoco.MjModel.from_xml_path(str(path)))]
    assert found == ["tcp", "hand", "imu", "4", "upper"]
    for command in ("run", "check"):
        code, _, err = call(command, str(path))
        words = " ".join(err.split())
        assert code == 2
        assert "no site or body 'grip' to hold; choose one (--grip" in words
        assert "'tcp' (site of 'hand', 0.2 kg, 2 of 6 free), 'hand' (body, " in words
        assert " and 1 more" in words
    fixed = mjcf(body="<body name='shelf'><geom size='.01'/></body>")
    assert refusal_of(tmp_path, fixed).endswith("nothing in it can move; give a body a joint")


def test_grip_is_a_site_then_a_body_at_its_centre_of_mass_then_a_point(tmp_path: Path) -> None:
    path = scene_file(tmp_path, arm())
    for grip, place in {
        "hand": (0.34, 0, 0.6),
        "hand@0,0,.1": (0.3, 0, 0.7),
        "4": (1.0, 0, 0),
        "4@-.1,0,1e-3": (0.9, 0, 0.001),
    }.items():
        pose = hb.load_scene(path, grip=grip).grip_pose()
        assert pose == pytest.approx((*place, 1, 0, 0, 0), abs=1e-12), grip
    both = scene_file(tmp_path, arm('<site name="hand" pos="0 0 0" euler="0 0 0"/>'))
    with pytest.warns(UserWarning, match="'hand' is a site and a body, and the hand holds the"):
        assert hb.load_scene(both, "hand").grip_pose()[:3] == pytest.approx((0.3, 0, 0.6))
    for wrong in ("hand@", "hand@1,2", "hand@0,0,inf", "hand@a,b,c"):
        assert "three finite numbers in m" in refusal_of(tmp_path, arm(), wrong)
    for unknown in ("foot@0,0,0", "@0,0,0", "1"):
        assert f"no site or body '{unknown}'" in refusal_of(tmp_path, arm(), unknown)


LINKS = """<robot name="arm"><link name="base"/>
<link name="beam"><collision><origin xyz="0 0 0.1"/><geometry><box size="0.02 0.02 0.2"/></geometry>
</collision></link>
<link name="tcp"/>
<link name="tool"><inertial><origin xyz="0 0 0.02"/><mass value="0.1"/>
<inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial></link>
<joint name="a" type="continuous"><parent link="base"/><child link="beam"/></joint>
<joint name="b" type="fixed"><origin xyz="0 0 0.2"/><parent link="beam"/><child link="tcp"/></joint>
<joint name="c" type="fixed"><origin xyz="0 0 .01"/><parent link="tcp"/><child link="tool"/></joint>
</robot>"""


def test_links_that_mujoco_fuses_are_held_at_their_own_centre_or_origin(tmp_path: Path) -> None:
    path = scene_file(tmp_path, LINKS, "arm.urdf")
    assert mujoco.MjModel.from_xml_path(str(path)).nbody == 2
    for grip, height in {"beam": 0.1, "tcp": 0.2, "tcp@0,0,.1": 0.3, "tool": 0.23}.items():
        assert hb.load_scene(path, grip=grip).grip_pose()[2] == pytest.approx(height), grip
    assert "'base' sits on the world, which cannot move" in refusal(path, "base")
    assert "'beam' (body, 0.18 kg, 1 of 6 free)" in refusal(path, "nothing")
    mount = '<joint name="a" type="floating"><parent link="base"/><child link="beam"/></joint>'
    text = LINKS.replace(next(line for line in LINKS.splitlines() if '"a"' in line), mount)
    path = scene_file(tmp_path, text, "flying.urdf")
    assert hb.load_scene(path, grip="tcp").grip_pose()[2] == pytest.approx(0.2)
    assert "'beam' (body, 0.18 kg, 6 of 6 free)" in refusal(path, "nothing")


def test_unnamed_bodies_have_no_number_where_others_are_fused(tmp_path: Path) -> None:
    fixed = "<body pos='1 0 0'><geom size='.1'/></body>"
    free = "<body pos='2 0 0'><freejoint/><geom size='.1'/></body>"
    for is_fused in (False, True):
        compiler = f"<compiler fusestatic='{str(is_fused).lower()}'/>"
        text = mjcf(compiler, body=fixed + free)
        if is_fused:
            assert "'2'" not in refusal_of(tmp_path, text, "2").partition("hold")[2]
        else:
            pose = hb.load_scene(scene_file(tmp_path, text), grip="2").grip_pose()
            assert pose[0] == pytest.approx(2.0)
            assert "'2' (body" in refusal_of(tmp_path, text, "3")


def test_a_body_without_mass_is_held_at_its_origin(tmp_path: Path) -> None:
    """MuJoCo's ``body_ipos`` would hold it twice as far from the hand."""
    path = scene_file(tmp_path, arm('<body name="tip" pos=".08 0 0"/>'))
    pose = hb.load_scene(path, grip="tip").grip_pose()
    assert pose[:3] == pytest.approx((0.38, 0.0, 0.6))


def test_run_that_holds_a_point_of_a_body_is_simulated_again(tmp_path: Path, call: Called) -> None:
    text = mjcf("<option gravity='0 0 0' noslip_iterations='2'/>", body=ARM.format(site=""))
    path, file = scene_file(tmp_path, text), tmp_path / "run.mcap"
    options = ("--fast", "--duration", "0.2", "--record", str(file))
    code, out, err = call("run", str(path), "--grip", "hand@.04,0,.02", *options)
    assert (code, "passive" in out) == (0, True), err
    changes = ["integrator: Euler → the method's", "noslip_iterations: 2 → 0"]
    assert all(f"changed in the scene: {change}" in err for change in changes)
    assert set(changes) < set(json.loads(hb.read_recording(file).meta["scene_changes"]))
    report = hb.audit(file)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    ticks = hb.read_recording(file).ticks
    assert ticks["tool_position"][0] == pytest.approx((0.34, 0, 0.62), abs=1e-5)
    assert any("in every bit" in note for note in what_if(file, {}).notes)


@pytest.mark.parametrize(
    ("text", "name", "is_joint"),
    [
        ("tcp", "tcp", False),
        ("hand@0,0,0.1", "hand@0,0,0.1", False),
        ("joint:hinge", "hinge", True),
        ("joint:a:b", "a:b", True),
        ("joint", "joint", False),
        ("left:tip", "left:tip", False),
    ],
)
def test_a_grip_is_a_site_or_body_or_a_joint(text: str, name: str, is_joint: bool) -> None:
    grip = Grip.from_text(text)
    assert (grip.name, grip.is_joint, str(grip)) == (name, is_joint, text)


def test_a_site_whose_name_begins_as_a_joint_is_no_grip(tmp_path: Path) -> None:
    path = scene_file(tmp_path, arm('<site name="joint:tip"/>'))
    assert "joint:tip" not in [each.name for each in grips(mujoco.MjModel.from_xml_path(str(path)))]
    assert "no hinge or slide 'tip' to hold" in refusal(path, "joint:tip")


DIALS = {
    "a dial on its axis": (
        "<body name='dial'><joint axis='0 0 1' damping='1e-4'/>"
        "<geom type='cylinder' size='.04 .01' mass='.1'/></body>",
        ["dial@0.04,0,0", "dial"],
    ),
    "a valve in a turned frame, without a name": (
        "<body euler='0 90 0'><body euler='30 0 0'><joint axis='0 1 0' damping='1e-4'/>"
        "<geom type='box' size='.1 .01 .01' mass='.1'/></body></body>",
        ["2@0.1,0,0", "2"],
    ),
    "a knob on a ball joint": (
        "<body name='knob'><joint type='ball' damping='1e-4'/><geom size='.02' mass='.1'/></body>",
        ["knob@0.02,0,0", "knob"],
    ),
    "a body off its axis": (
        "<body name='door'><joint axis='0 0 1'/><geom size='.01' pos='.1 0 0'/></body>",
        ["door"],
    ),
}


@pytest.mark.parametrize("kind", DIALS)
def test_a_body_that_turns_about_its_centre_is_offered_by_its_rim(
    tmp_path: Path, kind: str
) -> None:
    body, expected = DIALS[kind]
    path = scene_file(tmp_path, mjcf("<option gravity='0 0 0'/>", body=body))
    assert [each.name for each in grips(mujoco.MjModel.from_xml_path(str(path)))] == expected
    scene = hb.load_scene(path, expected[0])
    with hb.Bridge(scene, "simulated", clock=hb.SimulatedClock()) as bridge:
        bridge.run(duration=1.0)
    # a hand of three axes turns it
    _, *turned = scene.data.qpos if kind == "a knob on a ball joint" else (1.0, *scene.data.qpos)
    assert np.abs(turned).max() > 1e-3
