"""Start of a scene: violated constraints, mocap bodies that hold the grip, carried loads."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
import pytest
from check_scenes import case_of
from outside_scenes import mjcf, scene_file

import hapticbridge as hb
from hapticbridge.check.findings import find_faults
from hapticbridge.scene import load_scene
from hapticbridge.scene.scene import Scene
from hapticbridge.scene.start import row_name, start_on_constraints

TOOL = """<body name="tool" pos=".5 0 .1"><freejoint/>
  <geom type="box" size=".02 .02 .02" mass=".1"/><site name="grip"/></body>"""
ARM = """<body name="{0}" pos="0 {1} .5" gravcomp="1">
  <joint name="{0}" axis="0 1 0" damping=".01" {2}/>
  <geom type="capsule" fromto="0 0 0 .2 0 0" size=".01" mass=".1"/></body>"""
PART = '<body name="part" pos="0 0 .1"><freejoint/><geom size=".02" mass=".1"/></body>'
DRIVEN = '<body name="{0}" pos="{1} 0 0"><joint name="{0}" type="slide"/><geom size=".02"/></body>'


def scene_text(bodies: str, rest: str = "") -> str:
    return f"<mujoco><worldbody>{TOOL}{bodies}</worldbody>{rest}</mujoco>"


def started_said(scene: Scene) -> list[str]:
    return [change for change in scene.changes if change.startswith("start")]


def error(scene: Scene) -> float:
    """Largest violation of MuJoCo's own rows at the start."""
    data = scene.data
    is_equality = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    return float(np.where(is_equality, np.abs(data.efc_pos), -data.efc_pos).max(initial=0.0))


BEYOND = scene_text(ARM.format("elbow", 0, 'range="20 90"'))
GEARED = scene_text(
    ARM.format("j1", 0, "") + ARM.format("j2", 0.5, ""),
    '<equality><joint joint1="j1" joint2="j2" polycoef=".5 1 0 0 0"/></equality>',
)
WELDED = scene_text(
    PART, '<equality><weld name="hold" body1="part" relpose="0 0 .05 1 0 0 0"/></equality>'
)
TURNED = scene_text(  # by 30 deg about z, whatever its torquescale; and by 3, 4 and 12 cm
    PART.replace("</body>", '<site name="b" pos=".03 .04 .12" euler="0 0 30"/></body>')
    + '<site name="a" pos="0 0 .1"/>',
    '<equality><weld site1="a" site2="b" torquescale=".2"/></equality>',
)
PINNED = scene_text(
    PART, '<equality><connect body1="part" body2="tool" anchor="0 0 .2"/></equality>'
    '<keyframe><key name="home" qpos=".5 0 .1 1 0 0 0 0 .1 .1 1 0 0 0"/></keyframe>',
)  # fmt: skip
CORDED = scene_text(
    PART.replace("</body>", '<site name="b"/></body><site name="a" pos="0 0 .4"/>'),
    '<tendon><spatial name="cord" range="0 .2"><site site="a"/><site site="b"/></spatial></tendon>',
)
BALANCED = scene_text(
    ARM.format("j1", 0, "") + ARM.format("j2", 0.5, ""),
    '<tendon><fixed name="belt"><joint joint="j1" coef="1"/><joint joint="j2" coef="-1"/></fixed>'
    '</tendon><equality><tendon tendon1="belt" polycoef=".5 1 0 0 0"/></equality>',
)

CASES = {
    BEYOND: ["start of joint 'elbow': 0 deg → 20 deg, its limit"],
    GEARED: [
        "start of joint equality of joint 'j1' and 'j2': 28.6 deg off → closed",
        "start of joint 'j1': 0 deg → 14.3 deg",
        "start of joint 'j2': 0 deg → -14.3 deg",
    ],
    WELDED: [
        "start of weld 'hold' of body 'part': 150 mm off → closed",
        "start of body 'part': moved by 150 mm",
    ],
    TURNED: [
        "start of weld of site 'a' and 'b': 130 mm off → closed",
        "start of weld of site 'a' and 'b': 30 deg off → closed",
        "start of body 'part': moved by 130 mm, turned by 30 deg",
    ],
    PINNED: [
        "start of connect of body 'part' and 'tool': 100 mm off → closed",
        "start of body 'tool': turned by 8.56 deg",
        "start of body 'part': turned by 5.91 deg",
    ],
    BALANCED: [
        "start of tendon equality of tendon 'belt': 28.6 deg off → closed",
        "start of joint 'j1': 0 deg → 14.3 deg",
        "start of joint 'j2': 0 deg → -14.3 deg",
    ],
    CORDED: [
        "start of tendon 'cord': 100 mm beyond its limit → closed",
        "start of body 'part': moved by 100 mm",
    ],
}


FOLDED = scene_text(  # a step turns the pair, so that the weld's orientation is to be closed, too
    '<body name="block" pos=".6 0 -.07"><freejoint/><geom type="box" size=".03 .03 .03" mass=".2"/>'
    "</body>",
    '<equality><weld body1="tool" body2="block" relpose="0 0 -.05 1 0 0 0" torquescale=".01"/>'
    "</equality>",
)


def test_a_weld_is_closed_whatever_its_torquescale(tmp_path: Path) -> None:
    scene = load_scene(scene_file(tmp_path, FOLDED))
    assert error(scene) < 1e-8
    assert "closed" in started_said(scene)[0]


@pytest.mark.parametrize("text", CASES)
def test_violated_constraint_is_closed_before_the_run_and_said(tmp_path: Path, text: str) -> None:
    scene = load_scene(scene_file(tmp_path, text))
    assert error(scene) < 1e-8
    assert started_said(scene) == CASES[text]
    # the file itself starts with the violation
    with pytest.warns(UserWarning, match="and stays so"):
        assert error(load_scene(scene_file(tmp_path, text), as_is=True)) > 0.05


def test_closed_start_is_what_the_scenes_own_soft_law_comes_to(tmp_path: Path) -> None:
    scene = load_scene(scene_file(tmp_path, GEARED))
    model = mujoco.MjModel.from_xml_string(GEARED.replace('damping=".01"', 'damping=".001"'))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 5000)
    assert scene.data.qpos[7:] == pytest.approx(data.qpos[7:], abs=5e-3)


def test_run_its_reset_and_its_audit_start_on_the_constraints(tmp_path: Path) -> None:
    scene = load_scene(scene_file(tmp_path, GEARED))
    with hb.Bridge(
        scene, "simulated", clock=hb.SimulatedClock(), recording=tmp_path / "run.mcap"
    ) as bridge:
        bridge.run(duration=0.2)
    mujoco.mj_resetData(scene.model, scene.data)
    scene.reset()
    assert error(scene) < 1e-8
    report = hb.audit(tmp_path / "run.mcap")
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


def test_carried_tool_keeps_the_closed_start(tmp_path: Path) -> None:
    scene = load_scene(scene_file(tmp_path, BEYOND))
    scene.carry_tool("asked for")
    assert scene.data.joint("elbow").qpos[0] == pytest.approx(np.deg2rad(20.0))


def test_constraint_that_cannot_be_closed_is_left_and_said(tmp_path: Path) -> None:
    far = GEARED.replace('damping=".01" ', 'damping=".01" range="-5 5"')
    with pytest.warns(UserWarning, match="joint equality of joint 'j1' and 'j2' starts 28.6 deg"):
        scene = load_scene(scene_file(tmp_path, far))
    assert not started_said(scene)
    assert not scene.data.qpos[7:].any()


def test_start_on_its_constraints_adds_nothing_to_the_scene(tmp_path: Path) -> None:
    good = BEYOND.replace('range="20 90"', 'range="-20 90"')
    scene = load_scene(scene_file(tmp_path, good))
    assert (scene.model.nkey, started_said(scene)) == (0, [])
    closed = load_scene(scene_file(tmp_path, BEYOND))
    assert closed.model.key(0).name == "home"
    assert np.array_equal(closed.data.mocap_pos[-1], closed.data.site("grip").xpos)


def test_servo_of_a_closed_start_keeps_its_own_target(tmp_path: Path) -> None:
    text = BEYOND.replace(
        "</worldbody>", '</worldbody><actuator><position joint="elbow" kp="5"/></actuator>'
    )
    scene = load_scene(scene_file(tmp_path, text))
    assert scene.data.ctrl[0] == 0.0


# Mocap bodies that hold the grip

HELD = """<mujoco><worldbody>
  <body name="target" mocap="true" pos="0 0 .2"/>
  <body name="far" mocap="true" pos="1 0 .2"/>
  <body name="palm" pos="0 0 .2" gravcomp="1"><freejoint/>
    <geom type="box" size=".03 .03 .03" mass=".2"/><site name="palm_site"/>
    <body name="finger" pos="0 0 .05" gravcomp="1"><joint type="slide" axis="1 0 0"/>
      <geom size=".01" mass=".02" contype="0" conaffinity="0"/></body>
    <body name="lever" pos="0 0 -.05" gravcomp="1"><joint axis="0 1 0"/><joint axis="1 0 0"/>
      <geom size=".01" pos="0 0 -.1" mass=".02" contype="0" conaffinity="0"/></body></body>
  <body name="other" pos="1 0 .2" gravcomp="1"><freejoint/><geom size=".02" mass=".1"/></body>
  </worldbody><equality><weld body1="far" body2="other"/>{}</equality></mujoco>"""
WELD = '<weld body1="target" body2="palm"/>'
CONNECT = '<connect name="pin" body1="palm" body2="target" anchor="0 0 0"/>'
REPLACED = "grip held by mocap body 'target' → by the hand alone"


def tool_way(scene: Scene) -> float:
    """Way in m that the grip follows a hand that moves by its slow path."""
    scene_grip = scene.grip
    with hb.Bridge(scene, "simulated", clock=hb.SimulatedClock()) as bridge:
        before = scene.data.site(scene_grip).xpos.copy()
        bridge.run(duration=1.0)
        return float(np.linalg.norm(scene.data.site(scene_grip).xpos - before))


@pytest.mark.parametrize(("grip", "holding"), [("palm", WELD), ("finger", WELD), ("palm", CONNECT)])
def test_hand_takes_the_place_of_the_mocap_body_that_holds_its_grip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, grip: str, holding: str
) -> None:
    path = scene_file(tmp_path, HELD.format(holding))
    scene = load_scene(path, grip=grip)
    assert REPLACED in scene.changes
    assert scene.model.eq_active0.tolist() == [1, 0]
    assert tool_way(scene) > 1e-3
    # beside the constraint, the palm stays where it is
    monkeypatch.setattr("hapticbridge.scene.load.take_over_mocap", lambda *_, **__: ((), []))
    if grip == "palm":
        assert tool_way(load_scene(path, grip=grip)) < 1e-5
    monkeypatch.undo()
    with pytest.raises(hb.SceneError, match="held in place by mocap body 'target'; write active="):
        load_scene(path, grip=grip, as_is=True)


def test_run_without_the_mocap_body_it_replaces_is_audited_bit_for_bit(tmp_path: Path) -> None:
    scene = load_scene(scene_file(tmp_path, HELD.format(WELD)), grip="palm")
    scene.carry_tool("asked for")
    assert not scene.model.eq_active0[1]
    with hb.Bridge(
        scene, "simulated", clock=hb.SimulatedClock(), recording=tmp_path / "run.mcap"
    ) as bridge:
        bridge.run(duration=0.2)
    assert hb.audit(tmp_path / "run.mcap").resimulation == "bit for bit"


def test_soft_weld_whose_place_the_hand_takes_is_not_said_to_be_rigid(tmp_path: Path) -> None:
    soft = WELD.replace("/>", ' name="soft" solref="0.1 1"/>')
    for grip, is_replaced in (("palm", True), ("other", False)):
        scene = load_scene(scene_file(tmp_path, HELD.format(soft)), grip=grip)
        scene.set_contact(is_rigid=True)
        assert (REPLACED in scene.changes) == is_replaced
        assert any("equality 'soft': a spring of" in each for each in scene.changes) != is_replaced


def test_mocap_body_beside_which_the_grip_moves_is_left_and_named(tmp_path: Path) -> None:
    path = scene_file(tmp_path, HELD.format(WELD))
    with pytest.warns(UserWarning, match="'target' holds the tool and leaves the grip 2 of 6 of"):
        scene = load_scene(path, grip="lever")
    assert scene.model.eq_active0.all()
    assert REPLACED not in scene.changes
    # of two mocap bodies, the one that holds the other body is never named
    assert not any("far" in change for change in load_scene(path, grip="palm").changes)


@pytest.mark.parametrize(
    ("ties", "is_held"),
    [
        ("<weld body1='tool'/>", True),
        ("<weld body1='tool' active='false'/>", False),
        ("<weld body1='tool' body2='post'/>", True),
        ("<connect body1='tool' anchor='.1 0 0'/>", False),
    ],
)
def test_a_grip_that_a_weld_to_the_world_holds_fast_is_told(
    ties: str, is_held: bool, tmp_path: Path
) -> None:
    post = "<body name='post' pos='1 0 0'><geom size='.01'/></body>"
    path = scene_file(tmp_path, mjcf(f"<equality>{ties}</equality>", world=post))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_scene(path)
    words = "the grip is held fast by a weld or connect to the world"
    assert any(words in str(each.message) for each in caught) == is_held
    found = [each.sentence for each in find_faults(case_of(path)) if each.kind == "held grip"]
    assert found == [words] * is_held


# Overlaps and loads, in words that are true

PAIR = """<body name="link" pos="1 0 .3"><joint axis="0 1 0"/><geom name="a" size=".05"/>
  <body><joint axis="1 0 0"/><geom size=".001" mass=".1"/>
    <body name="nested" pos="0 0 .06"><joint axis="0 1 0"/><geom name="b" size=".02"/></body>
  </body></body>"""


@pytest.mark.parametrize("is_explicit", [False, True])
def test_only_a_contact_that_an_exclusion_ends_is_said_to_be_off(
    tmp_path: Path, *, is_explicit: bool
) -> None:
    pair = '<contact><pair geom1="b" geom2="a"/></contact>' if is_explicit else ""
    scene = load_scene(scene_file(tmp_path, scene_text(PAIR, pair)))
    assert scene.data.ncon == is_explicit
    said = [change for change in scene.changes if "overlap by 10 mm" in change]
    assert len(said) == 1
    assert ("on → off" in said[0]) != is_explicit
    assert ("eased out" in said[0]) == is_explicit


LOADED = """<mujoco><option gravity="0 0 -10"/><worldbody>
  <body name="tool" pos=".5 0 1"><freejoint/><geom size=".04" mass="1"/><site name="grip"/></body>
  <body name="arm" pos="0 0 1"><joint type="ball"/>
    <geom type="capsule" size=".01" fromto="0 0 0 .5 0 0" mass="2" contype="0" conaffinity="0"/>
    <site name="end" pos=".5 0 0"/>
    </body>
  <body name="weight" pos=".5 0 .7"><freejoint/><geom size=".02" mass=".5"/>
    <site name="hook"/></body>
  <body name="apart" pos="2 0 1"><freejoint/><geom size=".02" mass=".5"/></body></worldbody>
  <tendon><spatial range="0 .3"><site site="grip"/><site site="hook"/></spatial></tendon>
  <equality><weld site1="end" site2="grip"/></equality></mujoco>"""


def test_a_weight_on_a_chain_that_diverges_is_told_with_what_pulled_before(tmp_path: Path) -> None:
    """A weight m that falls into a spring pulls with 2 m g at most."""
    link = '<body pos=".05 0 0"><joint type="ball" stiffness=".05" damping=".015"/>'
    link += '<geom type="capsule" fromto="0 0 0 .05 0 0" size=".005"/>'
    last, tied = link.replace("<body", '<body name="last"'), 'contype="0" conaffinity="0"'
    text = f"""<mujoco><default><geom {tied}/></default><worldbody>
      <body><joint type="slide" axis="1 0 0" range="-57 57" damping="1"/>
        <geom type="box" size=".05 .05 .05" mass="1"/><site name="grip"/>{link * 19}{last}
        {"</body>" * 20}</body>
      <body name="load" pos="1.1 0 0"><freejoint/><geom type="box" size=".05 .05 .05" mass="50"/>
      </body></worldbody>
      <equality><connect body1="load" body2="last" anchor="-.05 0 0"/></equality></mujoco>"""
    with hb.Bridge(scene_file(tmp_path, text), clock=hb.SimulatedClock()) as bridge:
        bridge.run(duration=0.01)
        (said,) = [each for each in bridge.scene.changes if each.startswith("weight of the tool")]
    assert "felt → carried, with that of what is tied to it, 'load' (" in said
    assert re.search(r"pulls with up to (1\.0\d kN|9\d\d N),", said), said


@pytest.mark.parametrize(("axis", "pulls"), [("0 1 0", False), ("0 1 -.5", True)])
def test_a_carriage_on_a_level_rail_is_no_load_on_a_tendon(
    tmp_path: Path, axis: str, *, pulls: bool
) -> None:
    text = f"""<mujoco><worldbody><site name="pulley" pos="0 0 1"/>
      <body name="tool" pos="0 0 .5"><joint type="slide" axis="0 0 1"/>
        <geom size=".05" mass="1"/><site name="grip"/></body>
      <body name="carriage" pos="0 .5 1"><joint type="slide" axis="{axis}"/>
        <geom size=".05" mass="1"/><site name="end"/></body></worldbody>
      <tendon><spatial range="0 1"><site site="grip"/><site site="pulley"/><site site="end"/>
      </spatial></tendon></mujoco>"""
    scene = load_scene(scene_file(tmp_path, text), grip="grip")
    scene.carry_tool("asked for")
    assert any("but not that of 'carriage'" in change for change in scene.changes) == pulls


def test_parts_welded_to_the_tool_are_carried_with_it_and_loads_on_tendons_are_named(
    tmp_path: Path,
) -> None:
    scene = load_scene(scene_file(tmp_path, LOADED))
    scene.carry_tool("asked for")
    assert (
        "weight of the tool: felt → carried, with that of what is tied to it, 'arm', but not that "
        "of 'weight' on its tendons (asked for)" in scene.changes
    )
    bodies = "tool", "arm", "weight", "apart"
    assert [float(scene.model.body_gravcomp[scene.model.body(name).id]) for name in bodies] == [
        1.0,
        1.0,
        0.0,
        0.0,
    ]
    mujoco.mj_step(scene.model, scene.data, 200)
    # what is carried stays without a hand, but for the pull of the load
    assert scene.data.body("apart").xpos[2] < 0.9
    off = load_scene(scene_file(tmp_path, LOADED.replace('range="0 .3"', "")))
    off.carry_tool("asked for")
    mujoco.mj_step(off.model, off.data, 200)
    assert off.data.site("grip").xpos == pytest.approx([0.5, 0, 1], abs=1e-6)


def test_a_load_that_sinks_in_the_hand_is_named_with_its_energy(tmp_path: Path) -> None:
    text = LOADED.replace('range="0 .3"', 'range="0 .31"').replace("<equality>", "<!--").replace(
        "</equality>", "-->"
    )  # fmt: skip
    scene = load_scene(scene_file(tmp_path, text))
    scene.carry_tool("asked for")
    with hb.Bridge(
        scene, "simulated", clock=hb.SimulatedClock(), recording=tmp_path / "run.mcap"
    ) as bridge:
        summary = bridge.run(duration=1.0)
    released = summary.hand_energy.scene
    # the weight of 5 N sinks with the hand, which the simulated springs of 135 N/m let down
    assert released == pytest.approx(-summary.energies["coupling_work"], rel=0.01)
    assert released > 0.04
    words = f"gave the hand {1e3 * released:.3g} mJ, as weights that sink, springs and bodies that"
    assert words in str(summary)
    assert words in hb.audit(tmp_path / "run.mcap").reason


CUP = """<body name="cup" pos="0 0 .03"><freejoint/>
  <geom name="cup" type="box" size=".02 .02 .02" mass=".1"/></body>
  <geom name="table" type="box" size=".1 .1 .02"/>"""
"""Box that begins 10 mm inside a fixed one."""
CAUGHT = CUP + '<geom name="lid" type="box" size=".1 .1 .02" pos="0 0 .06"/>'
"""The same box between two fixed ones that leave it no room."""


def depth(scene: Scene) -> float:
    """Returns the deepest overlap at the start in m, by MuJoCo."""
    return float((-scene.data.contact.dist).max(initial=0.0))


def test_parts_that_begin_inside_each_other_are_moved_apart_before_the_run(tmp_path: Path) -> None:
    scene = load_scene(scene_file(tmp_path, scene_text(CUP)))
    assert depth(scene) < 1e-8
    assert started_said(scene) == [
        "start where geom 'table' and geom 'cup' overlap by 10 mm → closed",
        "start of body 'cup': moved by 10 mm",
    ]
    # the file itself starts inside the table, and nothing there touches the tool
    with pytest.warns(UserWarning, match="'cup' overlap by 10 mm at the start, and stay so"):
        assert depth(load_scene(scene_file(tmp_path, scene_text(CUP)), as_is=True)) > 9e-3


def test_parts_that_do_not_touch_by_the_files_own_flag_stay_inside_each_other(
    tmp_path: Path,
) -> None:
    off = '<option><flag contact="disable"/></option>'
    text = scene_text(CUP).replace("<mujoco>", f"<mujoco>{off}")
    assert started_said(load_scene(scene_file(tmp_path, text))) == []


@pytest.mark.parametrize("where", ["geom", "pair", "both geoms"])
@pytest.mark.parametrize("contact", ["rigid", "scene"])
def test_parts_that_begin_within_their_margin_start_at_it(
    tmp_path: Path, where: str, contact: Literal["rigid", "scene"]
) -> None:
    # MuJoCo's contacts rest at their margin: a cube on a floor begins 3 mm inside it
    geom, pair = (
        'margin=".003"',
        '<contact><pair geom1="floor" geom2="cube" margin=".003"/></contact>',
    )
    half = 'margin=".0015"'
    floor, cube, rest = {
        "geom": ("", geom, ""), "pair": ("", "", pair), "both geoms": (half, half, "")
    }[where]  # fmt: skip
    path = scene_file(
        tmp_path,
        f"""<mujoco><option cone="elliptic"/><worldbody>
        <geom name="floor" type="plane" size="1 1 .1" {floor}/><body name="tool" pos="0 0 .1">
        <freejoint/><geom name="cube" type="box" size=".1 .1 .1" mass=".5" {cube}/>
        <site name="grip"/></body></worldbody>{rest}</mujoco>""",
    )
    scene = load_scene(path)
    assert started_said(scene) == [
        "start where geom 'floor' and geom 'cube' are 3 mm closer than their margin of 3 mm → "
        "closed",
        "start of body 'tool': moved by 3 mm",
    ]
    assert scene.data.body("tool").xpos[2] == pytest.approx(0.103, abs=1e-6)
    with pytest.warns(UserWarning, match="3 mm closer than their margin of 3 mm at the start, and"):
        load_scene(path, as_is=True)
    with hb.Bridge(path, contact=contact, clock=hb.SimulatedClock()) as bridge:
        assert bridge.run(0.5).verdict == "passive"
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 2000)
    assert data.body("tool").xpos[2] == pytest.approx(0.103, abs=2e-4)  # its own rest


def test_start_that_overlaps_beside_a_margin_is_told_by_its_overlap(tmp_path: Path) -> None:
    path = scene_file(
        tmp_path,
        """<mujoco><option cone="elliptic"/><worldbody>
        <geom name="floor" type="plane" size="1 1 .1" margin=".003"/>
        <body name="tool" pos="0 0 .08"><freejoint/><geom name="cube" type="box" size=".1 .1 .1"
        mass=".5"/><site name="grip"/></body></worldbody></mujoco>""",
    )
    scene = load_scene(path)
    assert started_said(scene) == [
        "start where geom 'floor' and geom 'cube' overlap by 20 mm, with a margin of 3 mm → closed",
        "start of body 'tool': moved by 23 mm",
    ]


def test_start_within_an_o_margin_stays_because_rigid_contacts_have_none(tmp_path: Path) -> None:
    path = scene_file(
        tmp_path,
        """<mujoco><option o_margin=".01"><flag override="enable"/></option><worldbody>
        <geom type="plane" size="1 1 .1"/><body name="tool" pos="0 0 .1"><freejoint/>
        <geom type="box" size=".1 .1 .1" mass=".5"/><site name="grip"/></body></worldbody>
        </mujoco>""",
    )
    scene = load_scene(path)
    assert started_said(scene) == []
    assert scene.data.body("tool").xpos[2] == pytest.approx(0.1, abs=1e-9)


def test_box_between_two_walls_without_room_is_held_there_and_said(tmp_path: Path) -> None:
    scene = load_scene(scene_file(tmp_path, scene_text(CAUGHT)))
    assert depth(scene) == pytest.approx(0.01, abs=1e-6)
    (said,) = started_said(scene)
    assert "pushed out at once → held" in said


PUSHED = """<body name="push" pos="1 0 .2"><joint name="push" type="slide" axis="1 0 0"
  range=".1 .3"/><geom name="push" type="box" size=".02 .02 .02"/></body>""" + CUP.replace(
    "0 0 .03", "1.12 0 .2"
)
"""Part that its limit moves into a free one."""
FLOATING = """<body pos="1 0 .01"><joint name="across" type="slide" axis="1 0 0"/>
  <geom name="puck" type="box" size=".02 .02 .02"/></body>
  <geom name="floor" type="plane" size="2 2 .1"/>""" + CUP.replace("0 0 .03", "1.03 0 .04")
"""Part without a joint out of the floor, and a free part inside it."""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (PUSHED, ["start of joint 'push': 0 mm → 100 mm, its limit", "start of body 'cup': moved"]),
        (
            FLOATING,
            [
                "start where geom 'puck' and geom 'cup' overlap by 10 mm → closed",
                "start of joint 'across': 0 mm → -",
                "start of body 'cup': moved",
                "start where geom 'floor' and geom 'puck' overlap by 10 mm: pushed out at once →",
            ],
        ),
    ],
)
def test_pairs_that_can_be_moved_apart_are_whatever_else_the_start_needs(
    tmp_path: Path, text: str, said: list[str]
) -> None:
    started = started_said(load_scene(scene_file(tmp_path, scene_text(text))))
    assert len(started) == len(said)
    for words, opening in zip(started, said, strict=True):
        assert words.startswith(opening)


def test_start_out_of_the_table_is_where_the_scenes_own_contacts_push_it(tmp_path: Path) -> None:
    scene = load_scene(scene_file(tmp_path, scene_text(CUP)))
    model = mujoco.MjModel.from_xml_string(scene_text(CUP))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 2000)
    rest = scene.data.body("cup").xpos
    assert rest == pytest.approx(data.body("cup").xpos, abs=1e-3)


def test_a_constraint_of_a_flex_has_a_name(tmp_path: Path) -> None:
    rope = """<flexcomp name="rope" type="grid" count="3 1 1" spacing=".1 .1 .1" dim="1" mass=".1"
      pos="0 0 1" radius=".01"><edge equality="true"/></flexcomp>"""
    model = load_scene(scene_file(tmp_path, scene_text(rope))).model
    (equality,) = np.flatnonzero(model.eq_type == int(mujoco.mjtEq.mjEQ_FLEX))
    assert row_name(model, ("equality", int(equality))).startswith("equality '")


@pytest.mark.parametrize(("count", "words"), [(5, "1 more part of"), (6, "2 more parts of")])
def test_the_last_parts_that_start_elsewhere_are_counted(
    tmp_path: Path, count: int, words: str
) -> None:
    doors = "".join(
        f'<body pos="{each} 0 1"><joint axis="0 0 1" range="20 40" limited="true"/>'
        '<geom pos="0.1 0 0" size="0.02" mass="0.1"/></body>'
        for each in range(1, count + 1)
    )
    tool = '<body name="tool"><freejoint/><geom size="0.02" mass="0.1"/><site name="grip"/></body>'
    (tmp_path / "doors.xml").write_text(f"<mujoco><worldbody>{tool}{doors}</worldbody></mujoco>")
    changes = load_scene(tmp_path / "doors.xml").changes
    assert sum("0 deg → 20 deg" in change for change in changes) == 4
    assert f"start of {words} the scene: as these" in changes[-1]


KEYS = '<keyframe><key {}qpos="0 0 2 1 0 0 0 .5"/>{}</keyframe>'
SERVO = '<actuator><position joint="elbow" kp="5"/></actuator>'


@pytest.mark.parametrize(
    ("name", "other", "is_start"),
    [
        ("", "", True),
        ('name="home" ', "", True),
        ('name="home" ', "<key/>", True),
        ('name="up" ', "", False),
        ("", "<key/>", False),
        ('qvel="0 0 1 0 0 0 0" ', "", False),
    ],
)
def test_the_only_keyframe_at_rest_is_the_start_if_it_has_no_name(
    tmp_path: Path, name: str, other: str, is_start: bool
) -> None:
    keys = KEYS.format(name, other)
    path = scene_file(tmp_path, scene_text(ARM.format("elbow", 0, ""), SERVO + keys))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        case = case_of(path)
    scene = case.scene
    scene.reset()
    assert scene.data.qpos[2] == pytest.approx(2.0 if is_start else 0.1)
    assert scene.data.ctrl[0] == pytest.approx(0.5 if is_start else 0.0)  # the servo holds it
    said = "start: MuJoCo's initial pose → the only keyframe" in scene.changes
    assert said is (is_start and not name)
    assert any(fault.kind == "keyframe" for fault in find_faults(case)) == (not is_start)


SUNK = """<geom name="bench" type="box" size=".06 .06 .1" pos="0 0 -.1" condim="1"/>
<body name="block" pos="0 0 .04" gravcomp="1"><joint name="b" {}/>
<geom name="block" type="box" size=".05 .05 .05" mass=".2" condim="1"/></body>"""
SLED = '<actuator><position joint="b" kp="50" kv="6"/></actuator>' + (
    '<keyframe><key name="home" ctrl=".3"/></keyframe>'
)


@pytest.mark.parametrize(
    ("joint", "rest", "depth"),
    [
        ('type="slide" axis="1 0 0"', "", "10 mm"),  # no joint moves it out
        ('type="slide" axis="0 0 1" range="0 .002"', "", "10 mm"),  # its limit holds it
        ('type="slide" axis="1 0 0"', SLED, ""),  # drives off the bench
        ('type="free"', "", ""),  # is moved out before the run
    ],
)
def test_a_summary_says_what_still_overlaps(
    tmp_path: Path, joint: str, rest: str, depth: str
) -> None:
    scene = load_scene(scene_file(tmp_path, scene_text(SUNK.format(joint), rest)))
    words = "geom 'bench' and geom 'block' overlap by 10 mm"
    announced = any(f"start where {words}: pushed out at once" in each for each in scene.changes)
    assert announced == ("free" not in joint)
    with hb.Bridge(scene, "simulated:hand=none", clock=hb.SimulatedClock()) as bridge:
        bridge.run(duration=1.0)
        summary = bridge.summary()
    assert summary.overlap == (words if depth else "")
    assert ("overlap             " in str(summary)) == bool(depth)


def test_a_rod_that_starts_end_on_in_a_wall_turns_out_of_it_by_the_shortest_way() -> None:
    """Its contact points along the rod, so that the linear step of its hinge has no end."""
    text = """<mujoco><worldbody>
    <geom name="wall" type="box" size=".05 .2 .2" pos=".245 0 .03"/>
    <body><joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass="4"/></body>
    </worldbody></mujoco>"""
    start = start_on_constraints(mujoco.MjModel.from_xml_string(text))
    assert start.positions is not None
    closed = np.arccos((0.195 - 0.02) / 0.2)  # the rod's round end touches the wall
    assert abs(start.positions[0]) == pytest.approx(closed, abs=0.01)
