"""Refusals of scenes and of starts, with the culprit, and the options that loading sets."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from audit_cases import recorded
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from outside_scenes import FREE_TOOL, HINGE_TOOL, mjcf, refusal, refusal_of, scene_file
from scipy.spatial.transform import Rotation

import hapticbridge as hb
from hapticbridge.device import Motion, SimulatedDevice
from hapticbridge.kernel.codes import (
    COUPLING_ACTUATORS,
    HANDLE,
    PREFIX,
    WELD_NAME,
    added_id,
    coupling_ids,
)
from hapticbridge.scene import load_scene, scene_names, scene_path
from hapticbridge.scene.checks import unmetered_work
from hapticbridge.scene.inputs import input_writes


def test_missing_file_name_and_folder_are_told_apart(tmp_path: Path) -> None:
    missing = tmp_path / "gone.xml"
    assert refusal(missing).startswith(f"no scene file '{missing}' exists; give the path of an")
    message = refusal("peg_in_hola")
    assert "'peg_in_hola'" in message
    assert all(f"'{name}'" in message for name in scene_names())
    assert refusal(tmp_path).startswith(f"scene '{tmp_path}' is a folder")
    assert "empty" in refusal("")
    assert "too long" in refusal("x" * 5000)
    assert "MjSpec.from_string" in refusal(mjcf())
    assert "MjSpec.from_string" in refusal("\n" + mjcf("<!-- -->" * 1000))


def test_a_file_goes_before_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(scene_names()) >= {"peg_in_hole", "planar_peg", "point_mass", "virtual_wall"}
    assert load_scene("point_mass").name == "point_mass"
    monkeypatch.chdir(tmp_path)
    scene_file(tmp_path, mjcf(), "point_mass")
    assert scene_path("point_mass") == Path("point_mass")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["empty file"]),
        ("hello", ["line 1", "not well-formed XML"]),
        ("<mujoco>\n<worldbody>\n<body>\n</worldbody></mujoco>", ["line 3", "'body'"]),
        ("<mujoco>\n<worldbody>\n<bdy/>\n</worldbody></mujoco>", ["'bdy'", "line 3"]),
        ("<mujoco>\n<worldbody>\n<body foo='1'/></worldbody></mujoco>", ["'foo'", "line 3"]),
        ("<mujoco>\n\n<worldbody><body pos='a b c'/></worldbody></mujoco>", ["'pos'", "line 3"]),
        ("<mujoco><include file='gone.xml'/></mujoco>", ["'gone.xml'", "line 1"]),
        ("<mujoco><include file='part.xml'/></mujoco>", ["line 3 is not well-formed XML"]),
        ("<mujoco><asset><mesh file='gone.stl'/></asset></mujoco>", ["'gone.stl'"]),
        (mjcf("<asset><mesh name='m' file='gone.stl'/></asset>"), ["'gone.stl'"]),
        (mjcf("<asset><texture name='t' type='2d' file='gone.png'/></asset>"), ["'gone.png'"]),
        (mjcf(world="<body name='tool'/>"), ["repeated name 'tool'"]),
        # what switches the coupling off or cannot be simulated again
        (mjcf("<option><flag ipc='enable'/></option>"), ["flag ipc", "disable it"]),
    ],
)
def test_unreadable_file_is_told_with_line(tmp_path: Path, text: str, words: list[str]) -> None:
    scene_file(tmp_path, "<mujocoinclude>\n\n<worldbody></mujocoinclude>", "part.xml")
    message = refusal_of(tmp_path, text)
    assert all(word in message for word in words), message
    assert "must end in .xml" in refusal(scene_file(tmp_path, text, "scene.mjcf"))


def test_scene_may_use_any_name_but_under_our_prefix(tmp_path: Path) -> None:
    body = HINGE_TOOL.format(joint="").replace("elbow", "handle").replace('"arm"', '"handle"')
    names = ("handle", *(name.removeprefix(PREFIX) for name in COUPLING_ACTUATORS))
    motors = "".join(f"<motor name='{name}' joint='handle'/>" for name in names)
    world = "<site name='handle'/><body name='hapticbridge'/>"
    weld = "<equality><weld name='handle_weld' body1='handle' active='false'/></equality>"
    text = mjcf(f"<actuator>{motors}</actuator>{weld}", body=body, world=world)
    model = load_scene(scene_file(tmp_path, text)).model
    assert coupling_ids(model) == tuple(range(7, 13))
    assert model.body_mocapid[added_id(model, mujoco.mjtObj.mjOBJ_BODY, HANDLE)] == 0
    assert added_id(model, mujoco.mjtObj.mjOBJ_EQUALITY, WELD_NAME) == -1
    for kind in ("<body name='{}'/>", "<site name='{}'/>"):
        world = kind.format(f"{PREFIX}x")
        assert f"name '{PREFIX}x'" in refusal_of(tmp_path, mjcf(world=world))


def test_names_of_earlier_recordings_are_found() -> None:
    motors = "".join(
        f"<motor name='{name.removeprefix(PREFIX)}' site='grip'/>" for name in COUPLING_ACTUATORS
    )
    weld = "<equality><weld name='handle_weld' body1='tool'/></equality>"
    handle = "<body name='handle' mocap='true'><site name='handle'/></body>"
    text = mjcf(f"<actuator><motor joint='tool'/>{motors}</actuator>{weld}", world=handle)
    model = mujoco.MjModel.from_xml_string(text)
    assert coupling_ids(model) == tuple(range(1, 7))
    assert added_id(model, mujoco.mjtObj.mjOBJ_SITE, HANDLE) == model.site("handle").id
    assert added_id(model, mujoco.mjtObj.mjOBJ_EQUALITY, WELD_NAME) == 0


@pytest.mark.parametrize(
    ("body", "where"),
    [
        ("<site name='grip'/>", "the world"),
        ("<body name='shelf'><geom size='.01'/><site name='grip'/></body>", "body 'shelf'"),
        ("<body><body><geom size='.01'/><site name='grip'/></body></body>", "body '2'"),
        ("<body name='puck' mocap='true'><site name='grip'/></body>", "body 'puck'"),
        ("<body mocap='true'><body name='lid'><site name='grip'/></body></body>", "body 'lid'"),
    ],
)
def test_grip_on_what_cannot_move_is_refused(tmp_path: Path, body: str, where: str) -> None:
    message = refusal_of(tmp_path, mjcf(body=body))
    assert message.startswith(f"grip 'grip' sits on {where}, which cannot move; put it on a body")
    assert message.endswith("in the place of mocap") == ("mocap" in body)


def test_grip_on_a_rigid_part_of_a_moving_body_is_accepted(tmp_path: Path) -> None:
    part = "<body name='arm'><freejoint/><geom size='.01'/><body pos='.1 0 0'><site name='grip'/>"
    scene = load_scene(scene_file(tmp_path, mjcf(body=part + "</body></body>")))
    assert scene.grip_pose()[:3] == (0.1, 0.0, 0.0)


@pytest.mark.parametrize(
    ("option", "change", "is_needed"),
    [
        ("<option solver='PGS'/>", "solver: PGS → Newton", True),
        ("<option noslip_iterations='3'/>", "noslip_iterations: 3 → 0", True),
        ("<option><flag sleep='enable'/></option>", "flag sleep: enable → disable", True),
        ("<option solver='CG'/>", "solver: CG → Newton", False),
        ("<option integrator='RK4'/>", "integrator: RK4 → the method's", False),
        ("<option integrator='implicitfast'/>", "integrator: implicitfast → the method's", False),
    ],
)
def test_options_that_exclude_the_coupling_are_changed_and_told(
    tmp_path: Path, option: str, change: str, *, is_needed: bool
) -> None:
    path = scene_file(tmp_path, mjcf(option))
    scene = load_scene(path)
    assert change in scene.changes
    assert len(scene.changes) == 1 + ("integrator" not in change)  # Euler, MuJoCo's default
    opt = scene.model.opt
    assert opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE
    assert opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    assert opt.noslip_iterations == 0
    assert not opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP
    if is_needed:
        with pytest.raises(hb.SceneError, match=re.escape(change)):
            load_scene(path, as_is=True)
    else:
        assert load_scene(path, as_is=True).changes == scene.changes
    fitting = mjcf("<option integrator='discrete'/>")
    assert load_scene(scene_file(tmp_path, fitting), as_is=True).changes == ()


def test_what_does_unmetered_work_is_warned_of(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="wind does work"):
        load_scene(scene_file(tmp_path, mjcf("<option wind='1 0 0' viscosity='0.1'/>")))
    load_scene(scene_file(tmp_path, mjcf("<option wind='1 0 0'/>")))  # of a medium without mass
    floor = "<geom name='floor' type='plane' size='1 1 1' pos='0 0 -1' adhesion='1'/>"
    with pytest.warns(UserWarning, match="adhesion that pulls across a gap does work"):
        load_scene(scene_file(tmp_path, mjcf(world=floor)))
    model = load_scene(scene_file(tmp_path, mjcf())).model
    assert unmetered_work(model) == {}
    model.body_plugin[1] = 0  # MuJoCo ships none with passive forces
    assert "the plugin of a body may do work" in unmetered_work(model)["plugin"]


@pytest.mark.parametrize("name", ["passive", "control", "act_gain"])
def test_a_callback_of_the_program_is_refused_at_load_and_before_a_run(
    tmp_path: Path, name: str
) -> None:
    path = scene_file(tmp_path, mjcf())
    scene, clear = load_scene(path), getattr(mujoco, f"set_mjcb_{name}")
    clear(lambda *_: 0.0)
    try:
        with pytest.raises(hb.SceneError, match=rf"mjcb_{name}.*set_mjcb_{name}\(None\)"):
            load_scene(path)
        bridge = hb.Bridge(scene, "simulated", clock=hb.SimulatedClock())
        with pytest.raises(hb.SceneError, match=f"mjcb_{name}"), bridge:
            pass
    finally:
        clear(None)
    with hb.Bridge(scene, "simulated", clock=hb.SimulatedClock()) as bridge:
        clear(lambda *_: 0.0)
        try:
            with pytest.raises(hb.SceneError, match=f"mjcb_{name}"):
                bridge.run(0.01)
        finally:
            clear(None)
        assert bridge.run(0.01).ticks == 10


def test_options_and_timestep_are_set_whatever_the_file_says(tmp_path: Path) -> None:
    option = """<option integrator='Euler' solver='CG' timestep='0.01'><flag energy='disable'
      diagexact='disable' autoreset='enable' fwdinv='enable' midphase='disable'/></option>"""
    scene = load_scene(scene_file(tmp_path, mjcf(option)))
    opt = scene.model.opt
    enable, disable = mujoco.mjtEnableBit, mujoco.mjtDisableBit
    assert opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE
    assert opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    for bit in (enable.mjENBL_ENERGY, enable.mjENBL_FWDINV):
        assert opt.enableflags & bit
    for bit in (disable.mjDSBL_AUTORESET, disable.mjDSBL_MIDPHASE):
        assert opt.disableflags & bit
    scene.set_timestep(1 / 500, 4)
    assert opt.timestep == (1 / 500) / 4
    with hb.Bridge(scene, "simulated", rate=2000, substeps=2, clock=hb.SimulatedClock()):
        assert opt.timestep == (1 / 2000) / 2
    for period, substeps in ((0.0, 1), (float("nan"), 1), (-1.0, 1), (0.001, 0)):
        with pytest.raises(hb.SceneError, match="must be"):
            scene.set_timestep(period, substeps)


def test_gains_are_set_without_compiling_and_give_the_coupling_law(tmp_path: Path) -> None:
    scene = load_scene(scene_file(tmp_path, mjcf("<option gravity='0 0 0'/>")))
    model, data = scene.model, scene.data
    offset, turn = np.array([2e-3, -1e-3, 3e-3]), np.array([0.01, 0.02, -0.005])
    quaternion = Rotation.from_rotvec(turn).as_quat(scalar_first=True)
    for stiffness, rotational in ((100.0, 0.3), (2500.0, 4.0)):
        scene.set_gains((0.5, stiffness, 0.5), (1e-3, rotational, 1e-3))
        scene.reset()
        data.mocap_pos[-1] += offset
        data.mocap_quat[-1] = quaternion
        mujoco.mj_forward(model, data)
        # a resting tool: f = K (h - x), torque = K_r log(R_h R_xT), in the free joint's axes
        assert data.qfrc_actuator[:3] == pytest.approx(stiffness * offset, rel=1e-12)
        assert data.qfrc_actuator[3:] == pytest.approx(rotational * turn, rel=1e-12)


@pytest.mark.parametrize("value", ["nan", "-inf", "infinity"])
@pytest.mark.parametrize(
    "element",
    [
        "<geom size='.01' mass='{}'/>",
        "<geom size='.01' density='{}'/>",
        "<inertial pos='0 0 0' mass='{}' diaginertia='1 1 1'/>",
        "<inertial pos='0 0 0' mass='1' diaginertia='1 {} 1'/>",
        "<inertial pos='0 0 0' mass='1' fullinertia='1 1 1 0 {} 0'/>",
    ],
)
@pytest.mark.filterwarnings("ignore:XML contains")
def test_infinite_mass_is_told_where_written(tmp_path: Path, element: str, value: str) -> None:
    body = f"<body name='tool'><freejoint/>\n{element.format(value)}<site name='grip'/></body>"
    message = refusal_of(tmp_path, mjcf(f"<!-- {element.format(value)} -->", body=body))
    assert "finite" in message
    if "scene.xml" in message:
        assert "line 2" in message and value in message


def test_mass_that_becomes_infinite_in_compilation_is_refused_with_its_body(tmp_path: Path) -> None:
    body = FREE_TOOL.replace('size="0.01" mass="0.1"', 'size="1e200"')
    message = refusal_of(tmp_path, mjcf(body=body))
    assert message.startswith("body 'tool' has mass inf kg")
    body = FREE_TOOL.replace('mass="0.1"', 'mass="1e308"')
    message = refusal_of(tmp_path, mjcf(body=body))
    assert message.startswith("body 'tool' has mass 1e+308 kg and inertia [inf, inf, inf]")
    default = "<default><geom mass='nan'/></default>"
    scene_file(tmp_path, f"<mujocoinclude>\n{default}</mujocoinclude>", "part.xml")
    message = refusal_of(tmp_path, mjcf("<include file='part.xml'/>"))
    assert message.startswith("part.xml, line 2: mass of <geom> is 'nan'")


def test_text_in_another_encoding_is_refused_at_its_line_and_a_comment_is_not(
    tmp_path: Path,
) -> None:
    head = '<?xml version="1.0" encoding="{0}"?>\n<!-- Größe -->\n'
    plain = mjcf(body=FREE_TOOL)
    named = plain.replace('name="tool"', 'name="Würfel"')
    for text, encoding, words in (
        (plain, "latin-1", ""),
        (named, "utf-8", ""),
        (named, "latin-1", "scene.xml, line 3: name of <body> is not in UTF-8; save the file in"),
        (plain, "utf-16", "scene.xml is in UTF-16; save it in UTF-8"),
    ):
        path = tmp_path / "scene.xml"
        path.write_text(head.format(encoding) + text, encoding=encoding)
        if words:
            assert refusal(path).startswith(words)
        else:
            load_scene(path)


def test_a_mesh_is_not_taken_for_a_scene(tmp_path: Path) -> None:
    (tmp_path / "peg.STL").write_bytes(bytes(84))
    assert "is a mesh; write an MJCF file that names it" in refusal(tmp_path / "peg.STL")


ARM_UNDER_LIMIT = HINGE_TOOL.format(joint="actuatorfrcrange='-0.3 0.2'")


def turning(model: mujoco.MjModel, control: float, pull: float = 0.0) -> float:
    """Returns the torque in N m on the elbow under a motor's control and a coupling's pull."""
    data = mujoco.MjData(model)
    data.ctrl[0] = control
    if pull:
        data.mocap_pos[-1, 1] += pull
    mujoco.mj_forward(model, data)
    return float(data.qfrc_actuator[0])


@pytest.mark.parametrize("gear", [1.0, -4.0])
@pytest.mark.parametrize("own", ["", "forcerange='-0.04 0.1'"])
def test_force_limit_of_a_joint_bites_its_motor_and_not_the_coupling(
    tmp_path: Path, gear: float, own: str
) -> None:
    motor = f"<actuator><motor name='m' joint='elbow' gear='{gear}' {own}/></actuator>"
    text = mjcf("<option gravity='0 0 0'/>", motor, body=ARM_UNDER_LIMIT)
    scene, plain = load_scene(scene_file(tmp_path, text)), mujoco.MjModel.from_xml_string(text)
    assert scene.changes[-1].startswith("force limit of joint 'elbow': on all actuators")
    assert scene.changes[-1].endswith("→ on its actuator")
    for control in (-10.0, -0.05, 0.01, 0.04, 10.0):
        # MuJoCo's own limit of the scene without a coupling
        assert turning(scene.model, control) == pytest.approx(turning(plain, control), abs=1e-15)
    assert max(turning(scene.model, 10.0), turning(scene.model, -10.0)) <= 0.2
    scene.set_gains((0.0, 1000.0, 0.0), (0.0, 0.0, 0.0))
    # 1000 N/m · 0.02 m at an arm of 0.1 m
    felt = turning(scene.model, 10.0, 0.02) - turning(scene.model, 10.0)
    assert felt == pytest.approx(2.0, rel=1e-9)


def test_force_limit_of_a_joint_is_each_motors_if_it_has_several(tmp_path: Path) -> None:
    motors = "<motor name='a' joint='elbow'/><motor name='b' joint='elbow' gear='2'/>"
    text = mjcf(f"<actuator>{motors}</actuator>", body=ARM_UNDER_LIMIT)
    scene = load_scene(scene_file(tmp_path, text))
    assert scene.changes[-1].endswith("→ on each of its actuators")
    ranges = scene.model.actuator_forcerange[:2].tolist()
    assert ranges == [[-0.3, 0.2], [-0.15, 0.1]]


def test_force_limit_of_a_joint_without_an_actuator_is_on_none(tmp_path: Path) -> None:
    scene = load_scene(scene_file(tmp_path, mjcf(body=ARM_UNDER_LIMIT)))
    assert scene.changes[-1].endswith("→ none, as the scene has no actuator there")


@pytest.mark.parametrize(
    ("motor", "is_fixed"),
    [
        ("<motor name='m' joint='elbow'/>", True),
        ("<motor name='m' tendon='cord'/>", True),
        # no moment arm at the start: the force points to the hinge
        ("<motor name='m' site='grip' refsite='base' gear='1 0 0 0 0 0'/>", False),
        ("<motor name='m' site='grip' refsite='base' gear='0 1 0 0 0 0'/>", False),
        ("<motor name='m' tendon='rope'/>", False),
    ],
)
def test_force_limit_of_a_joint_tells_moment_arms_that_change(
    tmp_path: Path, motor: str, *, is_fixed: bool
) -> None:
    text = mjcf(
        "<tendon><fixed name='cord'><joint joint='elbow' coef='2'/></fixed>"
        "<spatial name='rope'><site site='base'/><site site='grip'/></spatial></tendon>",
        f"<actuator>{motor}</actuator>",
        body=ARM_UNDER_LIMIT,
        world="<site name='base' pos='0.2 0.3 0'/>",
    )
    scene, plain = load_scene(scene_file(tmp_path, text)), mujoco.MjModel.from_xml_string(text)
    said = scene.changes[-1].endswith(
        "on each of its actuators, for the moment arms of the start alone"
    )
    assert said == (not is_fixed)
    # MuJoCo's own limit, at another angle
    torques = []
    for model in (scene.model, plain):
        data = mujoco.MjData(model)
        data.ctrl[0], data.qpos[0] = 100.0, 1.0
        mujoco.mj_forward(model, data)
        torques.append(float(data.qfrc_actuator[0]))
    assert (torques[0] == pytest.approx(torques[1], rel=1e-9)) == is_fixed


def test_force_limit_is_moved_on_the_way_to_the_grip_alone(tmp_path: Path) -> None:
    limit = "actuatorfrcrange='-1 1'"
    outer = f"<body name='stand'><joint name='base' {limit}/><geom size='.01'/>{ARM_UNDER_LIMIT}"
    path = scene_file(tmp_path, mjcf(body=outer + "</body>"))
    assert load_scene(path).changes[-1].startswith("force limit of joint 'base' and 1 more:")
    with pytest.raises(hb.SceneError, match=r"joint 'base' and 1 more limits .*--as-is"):
        load_scene(path, as_is=True)
    elsewhere = f"<body pos='1 0 0'><joint {limit}/><geom size='.01'/></body>"
    scene = load_scene(scene_file(tmp_path, mjcf(world=elsewhere)))
    assert scene.model.jnt_actfrclimited.tolist() == [0, 1]
    assert not any("force limit" in change for change in scene.changes)


TABLE = "<geom name='table' type='plane' size='1 1 1'/>"


def resting(height: float) -> str:
    body = FREE_TOOL.replace('name="tool">', f'name="tool" pos="0 0 {height}">', 1)
    return mjcf(body=body, world=TABLE)


def strict_refusal(folder: Path, text: str) -> str:
    """Returns the refusal under ``as_is`` of a scene that loads without it."""
    path = scene_file(folder, text)
    load_scene(path)
    return refusal(path, as_is=True)


def test_tool_inside_something_is_refused_as_is_with_pair_and_depth(tmp_path: Path) -> None:
    message = strict_refusal(tmp_path, resting(0.0098))
    assert "overlap by 0.2 mm" in message
    assert "geom 'table' and geom 'ball'" in message
    unnamed = resting(0.005).replace('name="ball"', "").replace("name='table'", "")
    message = strict_refusal(tmp_path, unnamed)
    assert "overlap by 5 mm" in message
    assert "geom 0 of the world and geom 1 of body 'tool'" in message


@given(depth=st.floats(1e-5, 5e-3))
@example(depth=0.05e-3)
@example(depth=0.1e-3)
@example(depth=0.1004e-3)
@example(depth=0.1006e-3)
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_start_is_refused_exactly_beyond_tenth_of_millimetre(tmp_path: Path, depth: float) -> None:
    path = scene_file(tmp_path, resting(0.01 - depth))
    if depth > 1.0051e-4:  # no refusal says that 0.1 mm is more than 0.1 mm
        assert "starts in penetration" in refusal(path, as_is=True)
    elif depth < 1.0049e-4:
        load_scene(path, as_is=True)


def test_tool_is_refused_where_the_audit_would_take_rounding_for_tampering(tmp_path: Path) -> None:
    run = tmp_path / "run.mcap"
    recorded(run, scene_file(tmp_path, resting(999.0)), duration=0.5)
    assert hb.audit(run).verdict == "passive"
    assert "the tool starts 1001 m from the origin" in refusal_of(tmp_path, resting(1001.0))


def test_start_is_judged_at_keyframe_home(tmp_path: Path) -> None:
    deep = "<keyframe><key name='{}' qpos='0 0 0.005 1 0 0 0'/></keyframe>"
    text = resting(1.0).replace("</mujoco>", deep + "</mujoco>")
    load_scene(scene_file(tmp_path, text.format("other")), as_is=True)
    assert "overlap by 5 mm" in strict_refusal(tmp_path, text.format("home"))


def test_other_bodies_may_start_in_contact_and_tool_inside_cloth_may_not_as_is(
    tmp_path: Path,
) -> None:
    sunk = "<body pos='1 0 .005'><freejoint/><geom size='.01'/></body>"
    with pytest.warns(UserWarning, match="overlap by 5 mm at the start, and stay so"):
        load_scene(scene_file(tmp_path, resting(0.02).replace(TABLE, TABLE + sunk)), as_is=True)
    cloth = """<flexcomp name='cloth' type='grid' count='4 4 1' spacing='.05 .05 .05' mass='1'
      radius='.001'><edge equality='true'/></flexcomp>"""
    message = strict_refusal(tmp_path, mjcf(world=cloth))
    assert "geom 'ball' and flex 'cloth'" in message


def still_run(path: Path, contact: str | None = None) -> tuple[hb.Scene, np.ndarray, str]:
    """Holds the device still for 1 s; returns scene, heights of the tool and verdict."""
    scene = load_scene(path)
    device = SimulatedDevice(path=Motion([0.0, 2.0], np.zeros((2, 3))))
    with hb.Bridge(scene, device, clock=hb.SimulatedClock(), contact=contact) as bridge:
        summary = bridge.run(duration=1.0)
        ticks = bridge.latest_records(1000)
    return scene, ticks["tool_position"][:, 2].copy(), summary.environment


LID = TABLE.replace("'table'", "'lid'").replace("/>", " pos='0 0 .015' zaxis='0 0 -1'/>")
"""A plane above the table, whose gap is 5 mm too narrow for the ball."""


def test_tool_that_starts_inside_a_table_starts_on_it(tmp_path: Path) -> None:
    path = scene_file(tmp_path, resting(0.005))
    for contact in ("rigid", "scene"):
        scene, heights, environment = still_run(path, contact)
        assert environment == "strict"
        assert heights == pytest.approx(0.01, abs=1e-3)  # soft contacts rest a little deeper
        said = "start where geom 'table' and geom 'ball' overlap by 5 mm → closed"
        assert said in scene.changes


def test_tool_that_starts_inside_two_tables_stays_there_in_a_still_hand(tmp_path: Path) -> None:
    text = resting(0.005).replace(TABLE, TABLE + LID)
    plain = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(plain)
    speeds = []
    while data.time < 0.2:
        mujoco.mj_step(plain, data)
        speeds.append(data.qvel[2])
    assert max(speeds) > 0.05  # MuJoCo's own contact throws the ball out
    scene, heights, environment = still_run(scene_file(tmp_path, text))
    assert environment == "strict"
    assert heights == pytest.approx(0.0075, abs=1e-4)  # nothing dissipated could pay for more
    assert np.abs(np.diff(heights)).max() < 1e-5  # 10 mm/s
    assert "overlap by 2.5 mm (and 1 more pair): pushed out" in scene.changes[-1]
    with pytest.raises(hb.SceneError, match=r"in penetration.*--contact rigid"):
        still_run(scene_file(tmp_path, text), contact="scene")


NEST = """<body name='base'><geom name='shell' size='.05'/>
<body name='mid' pos='0 0 .04'><joint name='first' axis='0 1 0'/><geom size='.001' mass='.1'
contype='0' conaffinity='0'/><body {outer} pos='0 0 .01'><joint axis='1 0 0'/>
<geom name='tip' size='.02' mass='.1'/><site name='grip'/></body></body></body>"""


@pytest.mark.parametrize("outer", ["name='outer'", ""])
def test_links_inside_each_other_are_excluded_and_neighbours_of_the_tree_are_not(
    tmp_path: Path, outer: str
) -> None:
    text = mjcf(body=NEST.format(outer=outer), world=TABLE.replace("/>", " pos='0 0 -1'/>"))
    scene = load_scene(scene_file(tmp_path, text))
    assert scene.data.ncon == 0
    assert mujoco.MjModel.from_xml_string(text).nexclude == 0
    assert scene.model.nexclude == 1
    assert scene.changes[-1].startswith(
        "contact where geom 'shell' and geom 'tip' overlap by 20 mm"
    )
    assert refusal(scene.path, as_is=True).startswith(
        "the tool starts in penetration: geom 'shell'"
    )
    # it still meets what is not part of the robot
    ball = "<body pos='0 0 .06'><freejoint/><geom name='ball' size='.02'/></body>"
    scene = load_scene(scene_file(tmp_path, text.replace("</worldbody>", ball + "</worldbody>")))
    assert scene.data.ncon >= 1
    # a shallow overlap is held, because a gripper that closes must not pass through itself
    shallow = load_scene(scene_file(tmp_path, text.replace("pos='0 0 .01'", "pos='0 0 .0295'")))
    assert shallow.model.nexclude == 0
    assert shallow.data.ncon == 1


ROPE = """<flexcomp name='rope' type='grid' dim='1' count='12 1 1' spacing='.02 .02 .02' mass='.1'
  radius='.002' pos='0 0 -.03'><edge {}/><pin id='0 11'/></flexcomp>"""


@pytest.mark.parametrize(
    ("edge", "change"),
    [
        ("stiffness='500' damping='.1'", "springs → constraints of constant length"),
        ("equality='true' damping='.1'", "damping 0.1 → 0"),
        ("equality='true'", ""),
    ],
)
def test_edges_of_a_flex_are_constraints_where_discrete_has_no_springs(
    tmp_path: Path, edge: str, change: str
) -> None:
    path = scene_file(tmp_path, mjcf("<option integrator='discrete'/>", world=ROPE.format(edge)))
    scene, heights, environment = still_run(path)
    said = [each for each in scene.changes if each.startswith("edges of")]
    assert said == ([f"edges of flex 'rope': {change}"] if change else [])
    assert (environment, heights.min() > -0.05) == ("strict", True)
    lengths = np.linalg.norm(np.diff(scene.data.flexvert_xpos, axis=0), axis=1)
    assert lengths == pytest.approx(0.02, rel=0.2)  # MuJoCo's constraints are soft
    if change:
        assert change in refusal(path, as_is=True)
    else:
        load_scene(path, as_is=True)


@pytest.mark.parametrize(
    "key", ["qpos='0 0 1e11 1 0 0 0 0'", "qvel='0 0 1e11 0 0 0 0'", "ctrl='1e11'"]
)
def test_start_that_mujoco_would_not_step_is_refused(tmp_path: Path, key: str) -> None:
    world = "<body pos='1 0 0'><joint name='j' type='slide'/><geom size='.01'/></body>"
    keys = f"<keyframe><key name='home' {key}/></keyframe>"
    text = mjcf("<actuator><motor joint='j'/></actuator>", keys, world=world)
    assert f"in {key.split('=', maxsplit=1)[0]}" in refusal_of(tmp_path, text)


def test_control_so_large_that_mujoco_ignores_all_controls_is_refused(tmp_path: Path) -> None:
    body = HINGE_TOOL.format(joint="")
    text = mjcf("<actuator><motor name='m' joint='elbow'/></actuator>", body=body)
    scene = load_scene(scene_file(tmp_path, text))
    scene.set_gains((2.0, 1000.0, 2.0), (1e-3, 1.0, 1e-3))
    scene.data.ctrl[1] = 0.5  # a handle that moves with 0.5 m/s
    for value, force in ((1e10, 1.0), (1.01e10, 0.0)):
        scene.data.ctrl[0] = value
        mujoco.mj_forward(scene.model, scene.data)
        # what the refusal is for: the coupling's damper would act against the world
        assert scene.data.actuator_force[1] == pytest.approx(force, abs=1e-9)
        if force:
            assert input_writes(scene.model, ctrl={"m": value}) == [("ctrl", 0, [value])]
        else:
            with pytest.raises(hb.SceneError, match=r"'m'.* up to 1e\+10"):
                input_writes(scene.model, ctrl={"m": value})


@pytest.mark.parametrize("option", ["gravity='0 0 -inf'", "density='inf'", "wind='inf 0 0'"])
def test_an_option_that_is_not_finite_is_named(tmp_path: Path, option: str) -> None:
    name = option.partition("=")[0]
    message = refusal_of(tmp_path, mjcf(f"<option {option}/>"))
    assert f"{name} in <option> is not finite; write a number" in message
