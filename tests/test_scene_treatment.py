"""The table of what a run does to MJCF is complete, true, and what the guide shows."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest

import hapticbridge as hb
from hapticbridge.cli.guide import page
from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import method_named, prepare
from hapticbridge.scene.treatment import TREATMENTS, treatment_table

SCHEMA = Path(__file__).with_name("mjcf_schema.txt")
"""Elements of MJCF, each with its attributes, when the table was last compared with them."""


@cache
def schema() -> dict[str, tuple[str, ...]]:
    """Returns the attributes of every element that this MuJoCo reads, by the element's path."""
    path: list[str] = []
    found: dict[str, list[str]] = {}
    for line in mujoco.mj_printSchema(False, False).splitlines():
        if element := re.match(r"^( *)(\S+) \(.\) *(.*)$", line):
            depth = len(element[1]) // 3
            path = [*path[:depth], element[2].replace("(world)", "")]
            found["/".join(path)] = element[3].split()
        elif line.strip():
            found["/".join(path)] += line.split()
    return {name: tuple(sorted(attributes)) for name, attributes in found.items()}


def test_every_element_and_attribute_of_mujoco_was_considered() -> None:
    """New ones are kept by default: decide each, add a row if it is not, and write the file."""
    lines = SCHEMA.read_text(encoding="utf-8").splitlines()
    known = {name: set(words) for name, *words in (line.split() for line in lines)}
    new = {name: set(words) - known.get(name, set()) for name, words in schema().items()}
    assert {name: words for name, words in new.items() if words or name not in known} == {}
    assert known == {name: set(words) for name, words in schema().items()}


@pytest.mark.parametrize("subject", TREATMENTS)
def test_a_row_of_the_table_names_settings_of_mujoco(subject: str) -> None:
    for element, attribute in TREATMENTS[subject].settings:
        paths = [path for path in schema() if f"/{path}".endswith(f"/{element}")]
        assert paths, element
        assert not attribute or any(attribute in schema()[path] for path in paths), attribute


def test_the_guide_shows_the_table() -> None:
    assert treatment_table() in page("mjcf")


def run_model(
    path: Path, contact: str, duration: float = 0.01, device: str = "simulated:hand=none"
) -> tuple[hb.Scene, mujoco.MjModel]:
    """Returns a scene after a run, and the file's own model."""
    own = mujoco.MjModel.from_xml_path(str(path))
    scene = hb.load_scene(path)
    clock = hb.SimulatedClock()
    with hb.Bridge(scene, device, clock=clock, contact=contact, tool_weight=True) as bridge:
        bridge.run(duration=duration)
        return bridge.scene, own


DELAYED = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body name="tool"
pos="0 0 1"><freejoint/><geom size=".02" mass=".1"/></body><body><joint name="j" type="slide"/>
<geom size=".01" mass=".1"/></body></worldbody><actuator><motor joint="j" delay="0.05"
nsample="26"/></actuator><sensor><jointpos joint="j" delay="0.1" nsample="51"/><jointpos joint="j"
interval="0.01" delay="0.1" nsample="11"/></sensor><keyframe><key name="home" ctrl="0.1"
qvel="0 0 0 0 0 0 0.1"/></keyframe></mujoco>"""


@pytest.mark.parametrize("method", ["lossless", "weld"])
@pytest.mark.parametrize(("period", "substeps"), [(0.001, 1), (0.002, 4), (0.005, 1)])
def test_a_delay_keeps_its_time_at_another_time_step(
    tmp_path: Path, period: float, substeps: int, method: str
) -> None:
    path = tmp_path / "delayed.xml"
    path.write_text(DELAYED)
    scene = hb.load_scene(path, grip="tool")
    for _ in range(2):  # a scene may be prepared again
        prepare(scene, Coupling(100.0, 1.0, 1.0, 1e-3), period, substeps, method_named(method))
    own = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(own)
    mujoco.mj_resetDataKeyframe(own, data, 0)
    for model, state in ((own, data), (scene.model, scene.data)):
        mujoco.mj_step(model, state, round(0.4 / model.opt.timestep))
    assert scene.data.sensordata == pytest.approx(data.sensordata, abs=4e-3)
    assert scene.data.qvel[-1] == pytest.approx(data.qvel[-1], abs=4e-3)


EXACT_DELAY = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body name="tool">
<freejoint/><geom size=".02" mass=".1"/></body><body pos="1 0 0"><joint name="j" type="slide"/>
<geom size=".01" mass=".1"/></body></worldbody><actuator><motor name="0" joint="j" delay="0.02"
nsample="10"/></actuator><sensor><clock/><clock delay="0.02" nsample="10"/><actuatorfrc
actuator="0"/></sensor></mujoco>"""


@pytest.mark.parametrize("period", [0.001, 0.0005, 0.002, 0.004, 0.01, 0.02])
def test_as_many_samples_as_a_delay_needs_stay_as_many(tmp_path: Path, period: float) -> None:
    """Ten samples of 2 ms hold a delay of 20 ms exactly, and so do those of each other step."""
    path = tmp_path / "delayed.xml"
    path.write_text(EXACT_DELAY)
    scene = hb.load_scene(path, grip="tool")
    prepare(scene, Coupling(100.0, 1.0, 1.0, 1e-3), period, 1, method_named("lossless"))
    data, motor = scene.data, int(scene.model.actuator_ctrladr[scene.model.actuator("0").id])
    for _ in range(50):
        data.ctrl[motor] = data.time
        mujoco.mj_step(scene.model, data)
    now, sensor, force = data.sensordata
    assert (now - sensor, now - force) == pytest.approx((0.02, 0.02))


# Motion

TOOL = """<body pos="5 5 5"><joint type="slide" axis="1 0 0"/><site name="grip"/>
<geom size=".02" mass="0.1" contype="0" conaffinity="0"/></body>"""
ARM = """<body><joint name="j" type="hinge" axis="0 1 0" {}/><geom type="capsule" contype="0"
conaffinity="0" mass=".2" fromto="0 0 0 .2 0 0" size=".01" {}/>
<site name="end" pos=".2 0 0"/></body>
<site name="hook" pos=".3 0 .1"/>"""
BALL = '<body pos="0 0 1" {}><freejoint/><geom size=".05" mass=".02" {}/></body>'
TENDON = '<tendon><spatial name="t" {}><site site="hook"/><site site="end"/></spatial></tendon>'
ACTUATOR = "<actuator>{}</actuator><keyframe><key name='home' ctrl='0.5'/></keyframe>"


def scene_with(body: str, more: str = "", option: str = "", flag: str = "") -> str:
    """Returns a scene with a held tool far away, and bodies that move by themselves."""
    return (
        f"<mujoco><compiler angle='radian'/><option timestep='0.001' cone='elliptic' {option}>"
        f"<flag {flag}/></option><worldbody>{TOOL}{body}</worldbody>{more}</mujoco>"
    )


def arm(joint: str = "", geom: str = "", more: str = "", option: str = "", flag: str = "") -> str:
    return scene_with(ARM.format(joint, geom), more, option, flag)


def moved(path: Path, text: str, contact: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns where bodies are after 0.2 s, in a run and in MuJoCo."""
    path.write_text(text)
    scene, own = run_model(path, contact, 0.2)
    data = mujoco.MjData(own)
    if own.nkey:
        mujoco.mj_resetDataKeyframe(own, data, 0)
    for _ in range(200):
        mujoco.mj_step(own, data)
    return scene.data.qpos[1:], data.qpos[1:]


def driven(actuator: str) -> str:
    """Returns an actuator of the joint with a control, in XML."""
    return ACTUATOR.format(f'<{actuator} joint="j"/>')


MOTOR = arm(more=driven("motor"))
KEPT = {
    "gravity": (arm(option='gravity="0 0 -3"'), arm()),
    "flag gravity": (arm('springref="1" stiffness=".2"', flag='gravity="disable"'), arm()),
    "flag spring": (
        arm('springref="1" stiffness="1"', flag='spring="disable"'),
        arm('springref="1" stiffness="1"'),
    ),
    "flag damper": (arm('damping="0.05"', flag='damper="disable"'), arm('damping="0.05"')),
    "flag frictionloss": (
        arm('frictionloss=".1"', flag='frictionloss="disable"'),
        arm('frictionloss=".1"'),
    ),
    "flag limit": (arm('range="-.1 1"', flag='limit="disable"'), arm('range="-.1 .1"')),
    "damping": (arm('damping="0.05"'), arm()),
    "damping of higher order": (arm('damping="0 0.02 0.01"'), arm()),
    "armature": (arm('armature="0.01"'), arm()),
    "stiffness": (arm('stiffness="2"'), arm()),
    "springref": (arm('stiffness=".2" springref="1"'), arm('stiffness=".2"')),
    "springdamper": (arm('springdamper="0.1 0.5"'), arm()),
    "frictionloss": (arm('frictionloss="0.1"'), arm()),
    "gravcomp": (scene_with(ARM.format("", "").replace("<body>", "<body gravcomp='.5'>")), arm()),
    "fluid": (
        scene_with(BALL.format("", ""), "", "density='100' viscosity='1'"),
        scene_with(BALL.format("", "")),
    ),
    "fluidshape": (
        scene_with(BALL.format("", 'fluidshape="ellipsoid"'), "", "density='100'"),
        scene_with(BALL.format("", "")),
    ),
    "wind": (
        scene_with(BALL.format("", ""), "", "density='10' viscosity='1' wind='9 0 0'"),
        scene_with(BALL.format("", ""), "", "density='10' viscosity='1'"),
    ),
    "tendon stiffness": (arm(more=TENDON.format('stiffness="20"')), arm()),
    "tendon damping": (arm(more=TENDON.format('damping="2"')), arm()),
    "tendon armature": (arm(more=TENDON.format('armature="0.3"')), arm()),
    "tendon frictionloss": (arm(more=TENDON.format('frictionloss="0.6"')), arm()),
    "tendon range": (arm(more=TENDON.format('range="0 .16"')), arm()),
    "range": (arm('range="-1 0.2"'), arm()),
    "joint margin": (arm('range="-1 0.2" margin="0.1"'), arm('range="-1 0.2"')),
    "motor": (MOTOR, arm()),
    "position": (arm(more=driven('position kp="3" kv=".1"')), arm()),
    "delay": (arm(more=driven('motor delay="0.05" nsample="60"')), MOTOR),
    "actuator armature": (arm(more=driven('motor armature="0.01"')), MOTOR),
    "actuator damping": (arm(more=driven('motor damping="0.1"')), MOTOR),
    "velocity": (arm(more=driven('velocity kv="1"')), arm()),
    "intvelocity": (arm(more=driven('intvelocity kp="3" actrange="-1 1"')), arm()),
    "damper": (arm(more=driven('damper kv="1" ctrlrange="0 1"')), arm()),
    "cylinder": (arm(more=driven('cylinder area="1" timeconst="0.1"')), arm()),
    "pid": (arm(more=driven('pid kp="3" ki="1" kv=".1" imax="1"')), arm()),
    "muscle": (
        arm('range="-1 1"', more=driven('muscle force="2" lengthrange="-1 1"')),
        arm('range="-1 1"'),
    ),
    "dcmotor": (arm(more=driven('dcmotor motorconst="0.5" resistance="1"')), arm()),
    "filter": (arm(more=driven('general dyntype="filter" dynprm="0.1"')), MOTOR),
}
"""Scenes with a setting that is kept, and beside each one without it."""

MAX_DEVIATION = 0.03
"""Largest deviation of a place from MuJoCo's over the way that the setting makes. The integrators
differ by a step's way of 1 ms in 200."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("setting", KEPT)
def test_what_is_kept_moves_bodies_as_in_mujoco(tmp_path: Path, setting: str) -> None:
    with_it, without = KEPT[setting]
    ours, mujocos = moved(tmp_path / "with.xml", with_it, "rigid")
    _, others = moved(tmp_path / "without.xml", without, "rigid")
    way = np.abs(mujocos - others).max()
    assert way > 1e-4
    assert np.abs(ours - mujocos).max() < MAX_DEVIATION * way


FLOOR = '<geom name="floor" type="plane" size="3 3 .1" {}/>'
BOX = """<body name="b" pos="0 0 {}"><freejoint/>
<geom name="bg" type="box" size=".05 .05 .05" mass=".2" {}/></body>"""
PULL = "gravity='3 0 -9'"
LIFT = "gravity='0 0 {}'"
OVERRIDE = 'override="enable"'
PAIR = '<contact><pair geom1="floor" geom2="bg" {}/></contact>'
SUCK = """<actuator><adhesion body="b" ctrlrange="0 1" gain="5"/></actuator>
<keyframe><key name="home" ctrl="1"/></keyframe>"""


def on_floor(
    floor: str = "", box: str = "", height: str = ".0499", more: str = "", option: str = "",
    flag: str = "",
) -> str:  # fmt: skip
    return scene_with(FLOOR.format(floor) + BOX.format(height, box), more, option, flag)


TOUCHING = {
    "friction": on_floor('friction=".1"', 'friction=".1"', option=PULL),
    "condim 1": on_floor('condim="1"', 'condim="1"', option=PULL),
    "priority": on_floor('friction=".1" priority="1"', option=PULL),
    "contype": on_floor('contype="2"', 'contype="4" conaffinity="8"'),
    "friction of a pair": on_floor(more=PAIR.format('friction=".1 .1"'), option=PULL),
    "condim of a pair": on_floor(more=PAIR.format('condim="1"'), option=PULL),
    "o_friction": on_floor(option=f'{PULL} o_friction=".1 .1"', flag=OVERRIDE),
    "exclude": on_floor(more='<contact><exclude body1="world" body2="b"/></contact>'),
    "flag contact": on_floor(flag='contact="disable"'),
    "flag constraint": on_floor(flag='constraint="disable"'),
    "surfacevel": on_floor('surfacevel="0.2 0 0 0 0 0"'),
    "adhesion of a geom": on_floor('adhesion="3" gap=".002"', option=LIFT.format(5)),
    "adhesion of a pair": on_floor(
        more=PAIR.format('adhesion="3" gap=".002"'), option=LIFT.format(5)
    ),
    "adhesion by an actuator": on_floor(more=SUCK, option=LIFT.format(5)),
    "adhesion by an actuator that is too weak": on_floor(more=SUCK, option=LIFT.format(90)),
    "margin": on_floor('margin=".01"', height=".0598"),
    "margin of a pair": on_floor(more=PAIR.format('margin=".01"'), height=".0598"),
    "gap": on_floor('gap=".01"'),
}
"""Scenes of a box that touches a floor, with a setting that rigid contacts keep."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("setting", TOUCHING)
def test_a_contact_s_setting_that_is_kept_acts_as_in_mujoco(tmp_path: Path, setting: str) -> None:
    ours, mujocos = moved(tmp_path / "touching.xml", TOUCHING[setting], "rigid")
    assert np.abs(ours[:3] - mujocos[:3]).max() < 5e-4 + 0.02 * np.abs(mujocos[:3]).max()


def ball_on_floor(ball: str = "", more: str = "", option: str = "", flag: str = "") -> str:
    """Returns a ball on a floor: of one contact, MuJoCo's approximate diagonal is exact."""
    return on_floor("", ball, ".05", more, option, flag).replace('type="box"', 'type="sphere"')


REPLACED = {
    "softness": (
        ball_on_floor('solref=".3 1"'),
        "geom 'bg': a spring of 1.6 Hz → rigid",
    ),
    "softness of a pair": (
        ball_on_floor(more=PAIR.format('name="p" solref=".3 1"')),
        "pair 'p': a spring of 1.6 Hz → rigid",
    ),
    "o_solref": (
        ball_on_floor(option='o_solref=".3 1"', flag=OVERRIDE),
        "contact 'o_solref': a spring of 1.6 Hz → rigid",
    ),
    "o_margin": (
        on_floor(option='o_margin=".01"', height=".06", flag=OVERRIDE),
        "o_margin: 10 mm → 0",
    ),
    "limit": (
        arm('range="-1 0.1" solreflimit=".3 1"'),
        "limit of joint 'j': a spring of 1.6 Hz → rigid",
    ),
    "limit of a tendon": (
        arm(more=TENDON.format('range="0 .14" solreflimit=".3 1"')),
        "limit of tendon 't': a spring of 1.6 Hz → rigid",
    ),
}
"""Scenes with a setting that rigid contacts replace, and the line that says it."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("setting", REPLACED)
def test_what_is_replaced_moves_otherwise_and_is_said(tmp_path: Path, setting: str) -> None:
    text, line = REPLACED[setting]
    path = tmp_path / "replaced.xml"
    ours, mujocos = moved(path, text, "rigid")
    assert np.abs(ours - mujocos).max() > 5e-4
    scene, _ = run_model(path, "rigid")
    assert f"{line} (--contact scene keeps it)" in scene.changes
    softly, _ = moved(path, text, "scene")
    assert np.abs(softly - mujocos).max() < np.abs(ours - mujocos).max() / 5
    scene.set_contact(is_rigid=False)
    assert not any("--contact scene" in change for change in scene.changes)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("floor", "more"), [('adhesion="3"', ""), ("", SUCK)])
def test_adhesion_pulls_from_as_far_as_is_said(tmp_path: Path, floor: str, more: str) -> None:
    line = "adhesion: from the file's gap on → from 1 mm before it"
    for height, is_held in ((".0508", True), (".0515", False)):
        text = on_floor(floor, "", height, more, LIFT.format(5))
        ours, _ = moved(tmp_path / "sticky.xml", text, "rigid")
        assert (ours[2] < 0.051) == is_held
        scene, _ = run_model(tmp_path / "sticky.xml", "rigid")
        assert line in scene.changes
        # as the finding's remedy says: a method that sees no contact ahead
        alone = hb.load_scene(tmp_path / "sticky.xml")
        prepare(alone, Coupling(1000.0, 1.0), 1e-3, 1, method_named("implicit"))
        assert not any("adhesion" in change for change in alone.changes)
    (tmp_path / "dry.xml").write_text(on_floor())
    assert line not in run_model(tmp_path / "dry.xml", "rigid")[0].changes


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("flag", ["", 'diagexact="enable"'])
def test_own_contacts_keep_the_files_choice_of_the_diagonal(tmp_path: Path, flag: str) -> None:
    soft = on_floor("", 'solref=".3 1"', ".05", flag=flag)
    ours, mujocos = moved(tmp_path / "soft.xml", soft, "scene")
    assert abs(mujocos[2] - ours[2]) < 2e-4
    other, _ = moved(tmp_path / "soft.xml", on_floor("", 'solref=".3 1"', ".05"), "scene")
    exact = on_floor("", 'solref=".3 1"', ".05", flag='diagexact="enable"')
    assert abs(moved(tmp_path / "soft.xml", exact, "scene")[0][2] - other[2]) > 1e-3


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("friction", ["", 'frictionloss=".1"'])
def test_the_diagonal_of_rigid_contacts_is_said_where_it_moves_something(
    tmp_path: Path, friction: str
) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(arm(friction))
    line = "flag diagexact: disable → enable (--contact scene keeps it)"
    assert (line in run_model(path, "rigid")[0].changes) == bool(friction)
    assert line not in run_model(path, "scene")[0].changes


REFUSED = {
    "ipc": scene_with("", flag='ipc="enable"'),
}


@pytest.mark.parametrize(
    "subject", [key for key, row in TREATMENTS.items() if row.act == "refused"]
)
def test_what_is_refused_is_refused(tmp_path: Path, subject: str) -> None:
    path = tmp_path / "refused.xml"
    path.write_text(REFUSED[subject])
    with pytest.raises(hb.SceneError, match=subject):
        hb.load_scene(path)


WITHOUT_MOTOR = """<mujoco>{}<worldbody><body name="tool" gravcomp="1">
<joint name="h" type="slide" axis="0 0 1" actuatorgravcomp="true"/><geom size=".015" mass=".1"/>
<site name="grip"/></body></worldbody></mujoco>"""
MOTOR, FLAG = '<actuator><motor joint="h"/></actuator>', '<flag actuation="disable"/>'


@pytest.mark.parametrize(
    ("more", "falls"),
    [("", True), (MOTOR, False), (f"<option>{FLAG}</option>{MOTOR}", True)],
    ids=["no actuator", "an actuator", "the flag"],
)
def test_gravity_compensation_that_mujoco_alone_does_not_give_is_said(
    tmp_path: Path, more: str, falls: bool
) -> None:
    text = WITHOUT_MOTOR.format(more)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 100)
    assert bool(data.qpos[0] < -0.1) is falls
    path = tmp_path / "scene.xml"
    path.write_text(text, encoding="utf-8")
    said = [change.words for change in hb.load_scene(path).differences]
    words = "gravity compensation of joint 'h': none without an actuator → given"
    assert (words in said) is falls
