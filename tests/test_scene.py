"""load_scene: what it refuses and in which words, what of a scene survives, what it sets."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from outside_scenes import (
    FREE_TOOL,
    hand_file,
    mjcf,
    obj_bytes,
    png_bytes,
    scene_file,
    stl_bytes,
)
from scipy.spatial.transform import Rotation

import hapticbridge as hb
from hapticbridge.inputs import input_writes
from hapticbridge.kernel.state import COUPLING_ACTUATORS
from hapticbridge.provenance import compiled_model
from hapticbridge.scene import Scene, load_scene, scene_names, scene_path
from hapticbridge.scene.source import read_elements

HINGE_TOOL = """<body name="arm"><joint name="elbow" {joint}/>
<geom name="arm" size="0.01" mass="0.1"/><site name="grip" pos="0.1 0 0"/></body>"""


def refusal(path: str | Path, grip: str = "grip") -> str:
    """Loads what must be refused; returns the message, which is one line."""
    with pytest.raises(hb.SceneError) as caught:
        load_scene(path, grip)
    message = str(caught.value)
    assert "\n" not in message
    assert "Error" not in message.split("'", maxsplit=1)[0]
    assert len(message) < 400
    return message


def refusal_of(folder: Path, text: str | bytes, grip: str = "grip") -> str:
    return refusal(scene_file(folder, text), grip)


# --- files and names ------------------------------------------------------------------------------


def test_missing_file_name_and_folder_are_told_apart(tmp_path: Path) -> None:
    missing = tmp_path / "gone.xml"
    assert refusal(missing) == f"no scene file '{missing}' exists"
    message = refusal("peg_in_hola")
    assert "'peg_in_hola'" in message
    assert all(f"'{name}'" in message for name in scene_names())
    assert refusal(tmp_path).startswith(f"scene '{tmp_path}' is a folder")
    assert "empty" in refusal("")
    assert "too long" in refusal("x" * 5000)


def test_name_of_a_model_is_a_scene_and_a_file_in_the_folder_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = {"peg_in_hole", "planar_peg", "point_mass", "virtual_wall"}
    assert set(scene_names()) == paths | {"drawer", "hammer", "open_wrench", "ratchet"}
    assert load_scene("point_mass").name == "point_mass"
    monkeypatch.chdir(tmp_path)
    scene_file(tmp_path, mjcf(), "point_mass")
    assert scene_path("point_mass") == Path("point_mass")


def test_file_that_does_not_end_in_xml_is_refused_with_what_would_be_read(tmp_path: Path) -> None:
    assert "must end in .xml" in refusal(scene_file(tmp_path, mjcf(), "scene.mjcf"))


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
        ("<mujoco><asset><mesh file='gone.stl'/></asset></mujoco>", ["grip"]),
        (mjcf("<asset><mesh name='m' file='gone.stl'/></asset>"), ["'gone.stl'"]),
        (mjcf("<asset><texture name='t' type='2d' file='gone.png'/></asset>"), ["'gone.png'"]),
        (mjcf(world="<body name='tool'/>"), ["repeated name 'tool'"]),
        (mjcf("<size memory='1P'/>"), ["memory", "<size>"]),
    ],
)
def test_file_that_mujoco_cannot_read_is_refused_with_the_culprit_and_its_line(
    tmp_path: Path, text: str, words: list[str]
) -> None:
    message = refusal_of(tmp_path, text)
    assert all(word in message for word in words), message


def test_malformed_include_is_refused_with_its_own_line(tmp_path: Path) -> None:
    scene_file(tmp_path, "<mujocoinclude>\n\n<worldbody></mujocoinclude>", "part.xml")
    message = refusal_of(tmp_path, "<mujoco><include file='part.xml'/></mujoco>")
    assert "line 3 is not well-formed XML" in message


def test_urdf_is_refused_because_it_can_have_no_site(tmp_path: Path) -> None:
    text = "<robot name='r'><link name='a'/></robot>"
    assert "sites: none exist" in refusal(scene_file(tmp_path, text, "robot.urdf"))


# --- names ----------------------------------------------------------------------------------------


def test_grip_that_does_not_exist_is_refused_with_the_sites_that_do(tmp_path: Path) -> None:
    body = "<body><freejoint/><geom size='.01'/><site name='tip'/><site/><site name='heel'/></body>"
    message = refusal_of(tmp_path, mjcf(body=body))
    assert message.endswith("no site 'grip' to grip the tool by; sites: 'heel', 'tip'")
    path = scene_file(tmp_path, mjcf(body=body))
    assert load_scene(path, grip="heel").grip == "heel"
    assert "no site ''" in refusal(path, "")


@pytest.mark.parametrize(
    ("world", "actuator", "culprit"),
    [
        ("<body name='handle'/>", "", "body 'handle'"),
        ("<site name='handle'/>", "", "site 'handle'"),
        *[
            ("", f"<actuator><motor name='{name}' joint='elbow'/></actuator>", f"actuator '{name}'")
            for name in COUPLING_ACTUATORS
        ],
    ],
)
def test_name_that_the_bridge_needs_is_refused_where_it_is_taken(
    tmp_path: Path, world: str, actuator: str, culprit: str
) -> None:
    text = mjcf(actuator, body=HINGE_TOOL.format(joint=""), world=world)
    message = refusal_of(tmp_path, text)
    assert culprit in message
    assert "rename yours" in message


def test_names_of_ours_are_free_for_other_kinds_of_things(tmp_path: Path) -> None:
    body = HINGE_TOOL.format(joint="").replace("elbow", "handle").replace('"arm"', '"coupling_x"')
    actuator = "<actuator><motor name='coupling_left' joint='handle'/></actuator>"
    world = "<geom name='handle' size='.01' pos='1 0 0'/><body name='hapticbridge_handle'/>"
    assert load_scene(scene_file(tmp_path, mjcf(actuator, body=body, world=world))).model.nu == 7


@pytest.mark.parametrize(
    ("body", "where"),
    [
        ("<site name='grip'/>", "the world"),
        ("<body name='shelf'><geom size='.01'/><site name='grip'/></body>", "body 'shelf'"),
        ("<body><body><geom size='.01'/><site name='grip'/></body></body>", "body '2'"),
        ("<body name='puck' mocap='true'><site name='grip'/></body>", "body 'puck'"),
        (
            "<body mocap='true'><body name='lid'><site name='grip'/></body></body>",
            "body 'lid'",
        ),
    ],
)
def test_grip_on_what_cannot_move_is_refused(tmp_path: Path, body: str, where: str) -> None:
    message = refusal_of(tmp_path, mjcf(body=body))
    assert message.startswith(f"grip 'grip' sits on {where}, which cannot move; put it on a body")


def test_grip_on_a_rigid_part_of_a_moving_body_is_accepted(tmp_path: Path) -> None:
    part = "<body name='arm'><freejoint/><geom size='.01'/><body pos='.1 0 0'><site name='grip'/>"
    scene = load_scene(scene_file(tmp_path, mjcf(body=part + "</body></body>")))
    assert scene.grip_pose()[:3] == (0.1, 0.0, 0.0)


# --- options --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("<option solver='PGS'/>", ["PGS", "use Newton"]),
        ("<option noslip_iterations='3'/>", ["noslip_iterations=3", "set it to 0"]),
        ("<option><flag ipc='enable'/></option>", ["flag ipc", "disable it"]),
        ("<option><flag sleep='enable'/></option>", ["flag sleep", "disable it"]),
        ("<option><flag actuation='disable'/></option>", ["actuation", "enable it"]),
        ("<option actuatorgroupdisable='30 0 4'/>", ["0, 4, 30", "remove actuatorgroupdisable"]),
    ],
)
def test_option_that_breaks_the_implicit_step_is_refused(
    tmp_path: Path, option: str, words: list[str]
) -> None:
    message = refusal_of(tmp_path, mjcf(option))
    assert all(word in message for word in words), message


def test_rk4_runs_under_discrete_with_a_warning_and_other_integrators_without(
    tmp_path: Path,
) -> None:
    path = scene_file(tmp_path, mjcf("<option integrator='RK4'/>"))
    with pytest.warns(UserWarning, match="RK4; it runs under 'discrete'") as caught:
        scene = load_scene(path)
    assert len(caught) == 1
    assert scene.model.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE
    for name in ("Euler", "implicit", "implicitfast", "discrete"):
        scene = load_scene(scene_file(tmp_path, mjcf(f"<option integrator='{name}'/>")))
        assert scene.model.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE


def test_what_does_unmetered_work_is_warned_of(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="wind does work"):
        load_scene(scene_file(tmp_path, mjcf("<option wind='1 0 0'/>")))
    belt = "<geom name='belt' type='plane' size='1 1 1' pos='0 0 -1' surfacevel='1 0 0 0 0 0'/>"
    with pytest.warns(UserWarning, match="surfacevel does work"):
        load_scene(scene_file(tmp_path, mjcf(world=belt)))


def test_options_and_timestep_are_set_whatever_the_file_says(tmp_path: Path) -> None:
    option = (
        "<option integrator='Euler' solver='CG' timestep='0.01'><flag energy='disable' "
        "diagexact='disable' autoreset='enable' fwdinv='enable' midphase='disable'/></option>"
    )
    scene = load_scene(scene_file(tmp_path, mjcf(option)))
    opt = scene.model.opt
    enable, disable = mujoco.mjtEnableBit, mujoco.mjtDisableBit
    assert opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE
    assert opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    for bit in (enable.mjENBL_ENERGY, enable.mjENBL_DIAGEXACT, enable.mjENBL_FWDINV):
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
        scene.set_coupling(hb.Coupling(stiffness, 0.5, rotational, 1e-3))
        scene.reset()
        data.mocap_pos[-1] += offset
        data.mocap_quat[-1] = quaternion
        mujoco.mj_forward(model, data)
        # a resting tool: f = K (h - x), torque = K_r log(R_h R_xT), in the free joint's axes
        assert data.qfrc_actuator[:3] == pytest.approx(stiffness * offset, rel=1e-12)
        assert data.qfrc_actuator[3:] == pytest.approx(rotational * turn, rel=1e-12)


# --- masses ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "NaN", "infinity"])
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
def test_mass_that_is_not_finite_is_refused_where_it_is_written(
    tmp_path: Path, element: str, value: str
) -> None:
    body = f"<body name='tool'><freejoint/>\n{element.format(value)}<site name='grip'/></body>"
    message = refusal_of(tmp_path, mjcf(body=body))
    assert "finite" in message
    if "scene.xml" in message:
        assert "line 2" in message
        assert value in message


def test_mass_that_becomes_infinite_in_compilation_is_refused_with_its_body(
    tmp_path: Path,
) -> None:
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


def test_mass_in_a_comment_is_not_read(tmp_path: Path) -> None:
    load_scene(scene_file(tmp_path, mjcf("<!-- <geom mass='nan'/> -- > -->")))


# --- joints of the tool ---------------------------------------------------------------------------


def test_force_limit_of_a_joint_is_refused_on_the_tool_and_accepted_elsewhere(
    tmp_path: Path,
) -> None:
    limit = "actuatorfrcrange='-1 1'"
    outer = f"<body name='stand'><joint name='base' {limit}/><geom size='.01'/>{{}}</body>"
    message = refusal_of(tmp_path, mjcf(body=outer.format(HINGE_TOOL.format(joint=""))))
    assert message.startswith("joint 'base' of body 'stand' limits actuator forces")
    unnamed = HINGE_TOOL.format(joint=limit).replace('name="elbow"', "")
    assert refusal_of(tmp_path, mjcf(body=unnamed)).startswith("joint '0' of body 'arm'")
    elsewhere = f"<body pos='1 0 0'><joint {limit}/><geom size='.01'/></body>"
    load_scene(scene_file(tmp_path, mjcf(world=elsewhere)))


# --- start ----------------------------------------------------------------------------------------

TABLE = "<geom name='table' type='plane' size='1 1 1'/>"


def resting(height: float) -> str:
    body = FREE_TOOL.replace('name="tool">', f'name="tool" pos="0 0 {height}">', 1)
    return mjcf(body=body, world=TABLE)


def test_tool_inside_something_is_refused_with_pair_and_depth(tmp_path: Path) -> None:
    message = refusal_of(tmp_path, resting(0.0098))
    assert "0.2 mm inside" in message
    assert "geom 'table' and geom 'ball'" in message
    unnamed = resting(0.005).replace('name="ball"', "").replace("name='table'", "")
    message = refusal_of(tmp_path, unnamed)
    assert "5 mm inside" in message
    assert "geom 0 of the world and geom 1 of body 'tool'" in message


@given(depth=st.floats(1e-5, 5e-3))
@example(depth=0.05e-3)
@example(depth=0.099e-3)
@example(depth=0.101e-3)
@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_start_is_refused_exactly_beyond_a_tenth_of_a_millimetre(
    tmp_path: Path, depth: float
) -> None:
    path = scene_file(tmp_path, resting(0.01 - depth))
    if depth > 1.0001e-4:
        assert "inside something" in refusal(path)
    elif depth < 0.9999e-4:
        load_scene(path)


def test_start_is_judged_at_keyframe_home(tmp_path: Path) -> None:
    deep = "<keyframe><key name='{}' qpos='0 0 0.005 1 0 0 0'/></keyframe>"
    text = resting(1.0).replace("</mujoco>", deep + "</mujoco>")
    load_scene(scene_file(tmp_path, text.format("other")))
    assert "5 mm inside" in refusal_of(tmp_path, text.format("home"))


def test_other_bodies_may_start_in_contact_and_a_tool_inside_a_cloth_may_not(
    tmp_path: Path,
) -> None:
    sunk = "<body pos='1 0 .005'><freejoint/><geom size='.01'/></body>"
    load_scene(scene_file(tmp_path, resting(0.02).replace(TABLE, TABLE + sunk)))
    cloth = (
        "<flexcomp name='cloth' type='grid' count='4 4 1' spacing='.05 .05 .05' mass='1' "
        "radius='.001'><edge equality='true'/></flexcomp>"
    )
    message = refusal_of(tmp_path, mjcf(world=cloth))
    assert "geom 'ball' and flex 'cloth'" in message


@pytest.mark.parametrize(
    "key", ["qpos='0 0 nan 1 0 0 0 0'", "qvel='0 0 1e11 0 0 0 0'", "ctrl='1e11'"]
)
@pytest.mark.filterwarnings("ignore:XML contains")
def test_start_that_mujoco_would_not_step_is_refused(tmp_path: Path, key: str) -> None:
    world = "<body pos='1 0 0'><joint name='j' type='slide'/><geom size='.01'/></body>"
    text = mjcf(
        "<actuator><motor joint='j'/></actuator>",
        f"<keyframe><key name='home' {key}/></keyframe>",
        world=world,
    )
    assert f"in {key.split('=', maxsplit=1)[0]}" in refusal_of(tmp_path, text)


def test_control_so_large_that_mujoco_ignores_all_controls_is_refused(tmp_path: Path) -> None:
    body = HINGE_TOOL.format(joint="")
    text = mjcf("<actuator><motor name='m' joint='elbow'/></actuator>", body=body)
    scene = load_scene(scene_file(tmp_path, text))
    scene.set_coupling(hb.Coupling(1000.0, 2.0, 1.0, 1e-3))
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


# --- the handle -----------------------------------------------------------------------------------


def handle_pose(data: Any) -> NDArray[np.float64]:
    site = data.site("handle")
    return np.concatenate([site.xpos, site.xmat])


def grip_pose(data: Any, grip: str = "grip") -> NDArray[np.float64]:
    site = data.site(grip)
    return np.concatenate([site.xpos, site.xmat])


TURNED = FREE_TOOL.replace(
    '<site name="grip"/>', '<site name="grip" pos=".02 .01 -.03" quat=".5 .1 -.7 .2"/>'
).replace('name="tool">', 'name="tool" pos="1 2 3" quat="-.3 .5 .1 .8">', 1)
SITE_DEFAULTS = (
    "pos='1 2 3' quat='0 1 0 0'",
    "euler='10 20 30'",
    "axisangle='1 0 0 90'",
    "zaxis='1 1 0'",
    "xyaxes='0 1 0 -1 0 0'",
    "size='3 3 3' type='box' group='5'",
)


@pytest.mark.parametrize("site", SITE_DEFAULTS)
def test_handle_stands_at_the_grip_whatever_the_default_of_sites(tmp_path: Path, site: str) -> None:
    text = mjcf(f"<default><site {site}/></default>", body=TURNED)
    scene = load_scene(scene_file(tmp_path, text))
    assert handle_pose(scene.data) == pytest.approx(grip_pose(scene.data), abs=1e-15)
    handle = scene.model.site("handle")
    assert np.array_equal(handle.pos, [0, 0, 0])
    assert np.array_equal(handle.quat, [1, 0, 0, 0])


def test_handle_stands_at_a_grip_that_a_default_places(tmp_path: Path) -> None:
    default = "<default><site fromto='0 0 0 .1 .1 .1' type='capsule' size='.01'/></default>"
    scene = load_scene(scene_file(tmp_path, mjcf(default)))
    assert scene.data.site("grip").xpos == pytest.approx([0.05, 0.05, 0.05])
    assert handle_pose(scene.data) == pytest.approx(grip_pose(scene.data), abs=1e-15)


def test_handle_stands_at_the_grip_in_qpos0_and_in_every_keyframe(tmp_path: Path) -> None:
    keys = """<keyframe><key name='up' qpos='0 0 3 1 0 0 0'/>
    <key name='home' qpos='.1 .2 .3 .5 .5 -.5 .5'/></keyframe>"""
    plain = load_scene(scene_file(tmp_path, mjcf(body=TURNED)))
    assert handle_pose(plain.data) == pytest.approx(grip_pose(plain.data), abs=1e-15)
    keyed = load_scene(scene_file(tmp_path, mjcf(keys, body=TURNED)))
    assert keyed.data.qpos == pytest.approx([0.1, 0.2, 0.3, 0.5, 0.5, -0.5, 0.5])
    assert handle_pose(keyed.data) == pytest.approx(grip_pose(keyed.data), abs=1e-15)
    # a start that was changed after loading takes the handle along
    keyed.model.key_qpos[1, :3] = 7.0
    keyed.reset()
    assert handle_pose(keyed.data) == pytest.approx(grip_pose(keyed.data), abs=1e-15)
    keyed.model.key_qpos[1, :3] = [0.1, 0.2, 0.3]
    # whoever opens the compiled model without the package finds the handle there as well
    for key in (None, 0, 1):
        data = mujoco.MjData(keyed.model)
        if key is not None:
            mujoco.mj_resetDataKeyframe(keyed.model, data, key)
        mujoco.mj_forward(keyed.model, data)
        assert handle_pose(data) == pytest.approx(grip_pose(data), abs=1e-15)
        assert np.abs(data.qfrc_actuator).max() < 1e-12


def test_handle_weighs_nothing_whatever_the_compiler_is_told(tmp_path: Path) -> None:
    geom = "<default><geom mass='7' size='1 1 1'/></default>"
    bound = "<compiler boundmass='0.5' boundinertia='0.1'/>"
    scene = load_scene(scene_file(tmp_path, mjcf(bound, geom)))
    model, data = scene.model, scene.data
    assert model.body("tool").mass == 0.5
    assert model.body("handle").mass == 0
    assert not model.body("handle").inertia.any()
    # else the potential energy of the ledger would follow the hand
    mujoco.mj_energyPos(model, data)
    before = data.energy[0]
    data.mocap_pos[-1] += 1.0
    mujoco.mj_forward(model, data)
    assert data.energy[0] == before
    assert model.body("handle").geomnum == 0


def test_scene_gives_the_handle_six_actuators_and_nothing_else(tmp_path: Path) -> None:
    path = scene_file(tmp_path, mjcf(body=TURNED))
    alone, model = mujoco.MjModel.from_xml_path(str(path)), load_scene(path).model
    added = {name: getattr(model, name) - getattr(alone, name) for name in ("nq", "nv", "ngeom")}
    assert not any(added.values())
    assert (model.nbody - alone.nbody, model.nsite - alone.nsite, model.nmocap) == (1, 1, 1)
    assert (model.nactuator, model.nu, model.neq, model.nsensor) == (6, 6, 0, 0)
    assert [model.actuator(i).name for i in range(6)] == list(COUPLING_ACTUATORS)


# --- defaults -------------------------------------------------------------------------------------

ACTUATOR_DEFAULTS = (
    "<general forcelimited='true' forcerange='-1e-3 1e-3'/>",
    "<general forcerange='-1e-3 1e-3' ctrlrange='-1e-6 1e-6' actrange='-1 1'/>",
    "<general ctrllimited='true' ctrlrange='-1e-6 1e-6' group='7'/>",
    "<general dyntype='filter' dynprm='.1 2 3' actearly='true'/>",
    "<general dyntype='integrator' actlimited='true' actrange='-1 1'/>",
    "<general gaintype='affine' gainprm='5 6 7' biastype='affine' biasprm='1 2 3'/>",
    "<general gear='3 3 3 3 3 3' armature='2'/>",
    "<general damping='9' />",
    "<general delay='0.01' nsample='20' interp='linear'/>",
    "<motor gear='5' ctrllimited='true' ctrlrange='-1e-6 1e-6' forcerange='-1 1'/>",
    "<position kp='77' kv='3' forcerange='-1 1' ctrlrange='-1 1' timeconst='.1'/>",
    "<position kp='77' dampratio='1' inheritrange='0.5'/>",
    "<velocity kv='9'/>",
    "<intvelocity kp='5' actrange='-1 1'/>",
    "<damper kv='5' ctrlrange='0 1'/>",
    "<cylinder timeconst='.3' area='3'/>",
    "<muscle force='10' scale='3'/>",
    "<adhesion gain='3' ctrlrange='0 1'/>",
    "<site euler='30 20 10' size='2'/><geom mass='3' friction='9 9 9'/>",
    "<joint damping='5' armature='3' frictionloss='1' actuatorfrcrange='-1 1'/>",
)
GRIPPED = FREE_TOOL.replace(
    '<site name="grip"/>', '<site name="grip" pos=".01 0 0" quat="1 0 0 0"/>'
)


def ticks(path: Path, hand: Path, count: int = 200) -> NDArray[np.void]:
    with hb.Bridge(load_scene(path), f"trajectory:{hand}", clock=hb.SimulatedClock()) as bridge:
        bridge.run(duration=count / 1000)
        return bridge.latest_records(count)


@pytest.fixture(scope="module")
def plain_ticks(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, NDArray[np.void]]:
    folder = tmp_path_factory.mktemp("plain")
    hand = hand_file(folder, [(0.1, (0.01, -0.005, 0.01)), (0.1, (-0.01, 0.0, 0.0))])
    return hand, ticks(scene_file(folder, mjcf(body=GRIPPED)), hand)


@pytest.mark.parametrize("default", ACTUATOR_DEFAULTS)
def test_default_of_the_scene_does_not_reach_the_coupling(
    tmp_path: Path, plain_ticks: tuple[Path, NDArray[np.void]], default: str
) -> None:
    hand, expected = plain_ticks
    path = scene_file(tmp_path, mjcf(f"<default>{default}</default>", body=GRIPPED))
    model = load_scene(path).model
    clean = load_scene(scene_file(tmp_path, mjcf(body=GRIPPED), "clean.xml")).model
    for name in dir(model):
        if name.startswith("actuator_"):
            assert np.array_equal(getattr(model, name), getattr(clean, name)), name
    got = ticks(path, hand)
    for name in got.dtype.names or ():
        if not name.endswith("_ns"):
            assert np.array_equal(got[name], expected[name]), name


@pytest.mark.parametrize("default", ACTUATOR_DEFAULTS[:-2])
def test_the_same_default_reaches_an_actuator_that_leaves_its_fields_open(default: str) -> None:
    hostile = mujoco.MjSpec.from_string(mjcf(f"<default>{default}</default>"))
    one, other = hostile.add_actuator(), mujoco.MjSpec.from_string(mjcf()).add_actuator()
    fields = [name for name in dir(one) if name.endswith(("prm", "range", "type", "limited"))]
    fields += ["gear", "armature", "damping", "delay", "nsample", "group", "inheritrange"]
    assert any(np.any(getattr(one, name) != getattr(other, name)) for name in fields)


# --- what survives --------------------------------------------------------------------------------

RICH = """<mujoco model="rich">
  <compiler angle="degree" autolimits="true"/>
  <default><default class="servo"><position kp="40" kv="1" ctrlrange="-1 1"/></default></default>
  <worldbody>
    <body name="tool" pos="0 0 .5"><freejoint/><geom size=".02" mass=".2"/>
      <site name="grip"/><site name="eye" pos=".02 0 0"/></body>
    <body name="puck" mocap="true" pos="1 1 1"><geom size=".01"/></body>
    <body name="cart" pos="2 0 0"><joint name="rail" type="slide" axis="1 0 0" range="-1 1"/>
      <geom size=".05" mass="1"/><site name="hook"/></body>
    <body name="gate" pos="3 0 0"><joint name="hinge" range="-90 90"/><geom size=".05" mass="1"/>
      <site name="latch" pos="0 .1 0"/></body>
    <body name="puck2" mocap="true" pos="-1 0 0"/>
  </worldbody>
  <tendon><spatial name="cord" stiffness="3"><site site="hook"/><site site="latch"/></spatial>
  <fixed name="mix"><joint joint="rail" coef="2"/></fixed></tendon>
  <equality><connect name="chain" body1="cart" body2="gate" anchor="0 0 0" active="false"/>
    <joint name="gear" joint1="rail" joint2="hinge" polycoef="0 .1 0 0 0"/></equality>
  <actuator><position class="servo" name="drive" joint="rail"/><motor name="torque" joint="hinge"/>
    <general name="winch" tendon="cord" dyntype="filter" dynprm=".1"/></actuator>
  <sensor><jointpos name="where" joint="rail"/><force name="push" site="hook"/>
    <tendonpos name="length" tendon="cord"/></sensor>
  <custom><numeric name="n" data="1 2 3"/><text name="about" data="a rich scene"/></custom>
  <contact><exclude body1="cart" body2="gate"/></contact>
  <keyframe>
    <key name="away" qpos="5 0 0 1 0 0 0 .3 .2" ctrl=".1 .2 .3" mpos="9 9 9 8 8 8"/>
    <key name="home" time="2" qpos="0 0 1 1 0 0 0 .2 .1" qvel="0 0 0 0 0 0 .5 0" ctrl=".4 .5 .6"
         act=".7" mpos="1 2 3 4 5 6" mquat="0 1 0 0 0 0 1 0"/>
  </keyframe>
</mujoco>"""


def test_everything_of_the_users_scene_survives_unchanged(tmp_path: Path) -> None:
    path = scene_file(tmp_path, RICH)
    alone, scene = mujoco.MjModel.from_xml_path(str(path)), load_scene(path)
    model = scene.model
    names = [
        "jnt_",
        "eq_",
        "tendon_",
        "wrap_",
        "sensor_",
        "numeric_",
        "text_",
        "exclude_",
        "geom_",
        "dof_",
        "key_qpos",
        "key_qvel",
        "key_act",
        "key_time",
        "qpos0",
        "qpos_spring",
    ]
    compared = 0
    for name in dir(alone):
        if name.startswith(tuple(names)) and isinstance(getattr(alone, name), np.ndarray):
            before, after = getattr(alone, name), getattr(model, name)
            # indices into the table of names and of bodies after ours may shift
            if "bodyid" not in name:
                assert np.array_equal(before, after), name
                compared += 1
    assert compared > 100
    for kind in ("joint", "geom", "tendon", "sensor", "equality", "keyframe"):
        accessor = {"keyframe": "key"}.get(kind, kind)
        count = {"joint": 2, "geom": 4, "tendon": 2, "sensor": 3, "equality": 2, "keyframe": 2}
        for i in range(count[kind]):
            assert getattr(model, accessor)(i).name == getattr(alone, accessor)(i).name
    for name in ("drive", "torque", "winch"):
        a, b = alone.actuator(name), model.actuator(name)
        assert a.id == b.id
        for field in ("biasprm", "gainprm", "forcerange", "dyntype", "gear"):
            assert np.array_equal(getattr(a, field), getattr(b, field)), (name, field)
    assert np.array_equal(model.key_ctrl[:, :3], alone.key_ctrl)
    assert not model.key_ctrl[:, 3:].any()
    assert np.array_equal(model.key_mpos[:, :6], alone.key_mpos)
    assert np.array_equal(model.key_mquat[:, :8], alone.key_mquat)


def test_start_is_keyframe_home_with_the_users_own_inputs(tmp_path: Path) -> None:
    scene = load_scene(scene_file(tmp_path, RICH))
    data = scene.data
    for _ in range(2):
        assert data.time == 2.0
        assert data.ctrl.tolist() == [0.4, 0.5, 0.6, 0, 0, 0, 0, 0, 0]
        assert data.act.tolist() == [0.7]
        assert data.qvel.tolist() == [0, 0, 0, 0, 0, 0, 0.5, 0]
        assert data.mocap_pos.tolist() == [[1, 2, 3], [4, 5, 6], [0, 0, 1]]
        assert data.mocap_quat.tolist() == [[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0]]
        mujoco.mj_step(scene.model, data, 50)
        scene.reset()


def test_users_scene_moves_as_without_the_bridge_where_the_tool_is_apart(tmp_path: Path) -> None:
    path = scene_file(tmp_path, RICH)
    scene = load_scene(path)
    scene.set_timestep(0.001)
    spec = mujoco.MjSpec.from_file(str(path))
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_DIAGEXACT.value
    spec.option.timestep = 0.001
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    for _ in range(300):
        mujoco.mj_step(model, data)
        mujoco.mj_step(scene.model, scene.data)
    assert abs(data.qpos[7] - 0.2) > 0.01
    # the two systems are solved as one, so rounding may differ
    assert scene.data.qpos[7:] == pytest.approx(data.qpos[7:], abs=1e-12)
    assert scene.data.sensordata == pytest.approx(data.sensordata, rel=1e-9, abs=1e-12)


# --- sources --------------------------------------------------------------------------------------

MESHED = """<body name="tool"><freejoint/><geom type="mesh" mesh="m" mass=".1"/>
<site name="grip"/></body>"""
MESH = '<asset><mesh name="m" file="{}"/></asset>'
PART = "<mujocoinclude>{}</mujocoinclude>"
Layout = dict[str, str | bytes]
URDF = """<robot name="r">
  <mujoco><compiler strippath="false"/></mujoco>
  <link name="base"/>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="arm"/></joint>
  <link name="arm">
    <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="meshes/a.obj"/></geometry></collision>
  </link>
</robot>"""

LAYOUTS: dict[str, Layout] = {
    "mesh beside": {"main.xml": mjcf(MESH.format("a.stl"), body=MESHED), "a.stl": stl_bytes()},
    "obj and meshdir": {
        "main.xml": mjcf("<compiler meshdir='m'/>", MESH.format("a.obj"), body=MESHED),
        "m/a.obj": obj_bytes(),
    },
    "assetdir for mesh, texture and height field": {
        "main.xml": mjcf(
            "<compiler assetdir='assets'/>",
            MESH.format("a.obj"),
            "<asset><texture name='t' type='2d' file='t.png'/>"
            "<hfield name='h' file='h.png' size='1 1 .1 .1'/></asset>",
            body=MESHED,
            world="<geom type='hfield' hfield='h' pos='0 0 -2'/>",
        ),
        "assets/a.obj": obj_bytes(),
        "assets/t.png": png_bytes(),
        "assets/h.png": png_bytes(90),
    },
    "texturedir and faces of a cube": {
        "main.xml": mjcf(
            "<compiler texturedir='t' meshdir='m'/>",
            "<asset><texture name='c' type='cube' fileright='r.png' fileleft='l.png' "
            "fileup='r.png' filedown='d.png' filefront='r.png' fileback='b.png'/></asset>",
        ),
        **{f"t/{name}.png": png_bytes(number) for number, name in enumerate("rldb")},
    },
    "strippath": {
        "main.xml": mjcf(
            "<compiler meshdir='m' strippath='true'/>",
            MESH.format("/home/somebody/cad/a.stl"),
            body=MESHED,
        ),
        "m/a.stl": stl_bytes(),
    },
    "nested includes, relative to the main file or to their own": {
        "main.xml": mjcf("<include file='parts/one.xml'/>", body=MESHED),
        "parts/one.xml": PART.format("<include file='deep/two.xml'/>"),
        "parts/deep/two.xml": PART.format("<include file='common.xml'/>" + MESH.format("a.stl")),
        "common.xml": PART.format("<option gravity='0 0 -3'/>"),
        "parts/deep/a.stl": stl_bytes(),
    },
    "compiler in one include, mesh in another": {
        "main.xml": mjcf("<include file='mesh.xml'/><include file='inc/c.xml'/>", body=MESHED),
        "mesh.xml": PART.format(MESH.format("a.stl")),
        "inc/c.xml": PART.format("<compiler meshdir='geometry'/>"),
        "geometry/a.stl": stl_bytes(),
        "a.stl": stl_bytes(0.5),
    },
    "attached model with assets of its own": {
        "main.xml": mjcf(
            "<compiler meshdir='mine'/>",
            "<asset><model name='g' file='gripper/g.xml'/><mesh name='m' file='a.stl'/></asset>",
            body=MESHED,
            world="<frame pos='1 0 0'><attach model='g' body='finger' prefix='g_'/></frame>",
        ),
        "mine/a.stl": stl_bytes(),
        "gripper/g.xml": "<mujoco><compiler meshdir='meshes'/><include file='more.xml'/>"
        "<worldbody><body name='finger'><joint/><geom type='mesh' mesh='f' mass='1'/></body>"
        "</worldbody></mujoco>",
        "gripper/more.xml": PART.format("<asset><mesh name='f' file='f.obj'/></asset>"),
        "gripper/meshes/f.obj": obj_bytes(0.02),
    },
    "assets above the scene's folder": {
        "scenes/main.xml": mjcf(
            MESH.format("../shared/a.stl"), "<include file='../common.xml'/>", body=MESHED
        ),
        "shared/a.stl": stl_bytes(),
        "common.xml": PART.format("<option gravity='0 0 -3'/>"),
    },
    "comments and names that only MuJoCo's parser accepts": {
        "main.xml": "<!-- a -- b <include file='gone.xml'/> -->\n"
        + mjcf(MESH.format("R&D.stl"), "<include file='a&amp;b.xml'/>", body=MESHED),
        "R&D.stl": stl_bytes(),
        "a&b.xml": PART.format("<option gravity='0 0 -3'/>"),
    },
    "spaces, other letters, byte-order mark and declaration": {
        "Zähne und Löcher/main.xml": b"\xef\xbb\xbf<?xml version='1.0'?><!-- first -->"
        + mjcf(MESH.format("größe 1.stl"), body=MESHED).encode(),
        "Zähne und Löcher/größe 1.stl": stl_bytes(),
    },
    "backslashes": {
        "main.xml": mjcf(MESH.format("m\\a.stl"), body=MESHED),
        "m/a.stl": stl_bytes(),
    },
    "attached robot in URDF": {
        "main.xml": mjcf(
            "<asset><model name='r' file='robot/r.urdf'/></asset>",
            world="<frame pos='1 0 0'><attach model='r' body='arm' prefix='r_'/></frame>",
        ),
        "robot/r.urdf": URDF,
        "robot/meshes/a.obj": obj_bytes(),
    },
    "soft body from a mesh": {
        "main.xml": mjcf(
            "<compiler meshdir='m'/>",
            world="<body name='b' pos='0 0 1'><flexcomp name='f' type='mesh' file='a.obj' dim='2' "
            "mass='.1' radius='.001'><edge equality='true'/></flexcomp></body>",
        ),
        "m/a.obj": obj_bytes(0.1),
    },
}


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS.keys())
def test_sources_are_every_file_and_rebuild_the_same_model(tmp_path: Path, layout: Layout) -> None:
    for name, content in layout.items():
        scene_file(tmp_path / "original", content, name)
    main = next(name for name in layout if name.endswith("main.xml"))
    # a decoy that nobody names
    scene_file(tmp_path / "original", stl_bytes(0.3), "unused.stl")
    scene = load_scene(tmp_path / "original" / main)
    sources = {source.name: source.data for source in scene.sources}
    assert Path(scene.sources[0].name).name == "main.xml"
    expected = {n: c.encode() if isinstance(c, str) else c for n, c in layout.items()}
    if "geometry/a.stl" in layout:
        del expected["a.stl"]  # hidden by meshdir
    inner = "Zähne und Löcher/" if main.startswith("Z") else ""
    assert sources == {name.removeprefix(inner): data for name, data in expected.items()}
    for name, data in sources.items():
        scene_file(tmp_path / "rebuilt1" / inner, data, name)
    again = load_scene(tmp_path / "rebuilt1" / inner / scene.sources[0].name)
    # a compiled model holds the paths of its assets
    model = compiled_model(again.model).replace(b"/rebuilt1/", b"/original/")
    assert model == compiled_model(scene.model)


def test_compiled_model_is_the_same_in_every_compilation(tmp_path: Path) -> None:
    path = scene_file(tmp_path, RICH)
    assert compiled_model(load_scene(path).model) == compiled_model(load_scene(path).model)


def test_relative_path_works_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, content in LAYOUTS["assets above the scene's folder"].items():
        scene_file(tmp_path, content, name)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    scene = load_scene(os.path.join("..", "scenes", "main.xml"))  # noqa: PTH118 - as typed
    assert [s.name for s in scene.sources] == ["scenes/main.xml", "shared/a.stl", "common.xml"]


@given(st.binary(max_size=300))
def test_any_bytes_can_be_looked_through_for_elements(data: bytes) -> None:
    for element in read_elements(b"<a x='1'/>\n" + data + b'\n<!-- \n --><b y="2">'):
        assert element.line >= 1


def test_elements_are_read_with_their_lines_and_values() -> None:
    text = b"<a>\n<!-- <x/>\n -- --><b p='1' q = \"a &amp; &lt;b>\"/>\n\n<c:d\n r='2'></c:d></a>"
    found = [(e.tag, e.attributes, e.line) for e in read_elements(text)]
    assert found == [
        ("a", {}, 1),
        ("b", {"p": "1", "q": "a & <b>"}, 3),
        ("c:d", {"r": "2"}, 5),
    ]


# --- strange but legal ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        mjcf(
            body="<body><freejoint/><inertial pos='0 0 0' mass='1' diaginertia='1 1 1'/>"
            "<site name='grip'/></body>"
        ),
        mjcf("<size nuserdata='1000' memory='50M'/>"),
        mjcf("<compiler fusestatic='true' discardvisual='true'/>"),
        mjcf("<compiler autolimits='false' angle='degree' eulerseq='zyx'/>"),
        mjcf("<compiler coordinate='local' balanceinertia='true' inertiafromgeom='true'/>"),
        mjcf("<option><flag contact='disable' gravity='disable' damper='disable'/></option>"),
        mjcf("<default class='main'><geom contype='0'/></default>"),
        mjcf("<statistic extent='1'/><visual/><custom/>"),
    ],
)
def test_strange_but_legal_scene_runs_and_follows_the_hand(tmp_path: Path, text: str) -> None:
    hand = hand_file(tmp_path, [(0.15, (0.01, 0.0, 0.01))])
    scene: Scene
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = load_scene(scene_file(tmp_path, text))
    with hb.Bridge(scene, f"trajectory:{hand}", clock=hb.SimulatedClock()) as bridge:
        summary = bridge.run()
        last = bridge.latest_records(1)[0]
    assert summary.environment == "strict"
    # 9.81 N on 2400 N/m is 4 mm
    assert last["tool_position"] == pytest.approx(last["handle_position"], abs=5e-3)
    assert last["handle_position"] == pytest.approx([0.01, 0.0, 0.01], abs=1e-12)


FLAGS = (
    "constraint",
    "equality",
    "frictionloss",
    "limit",
    "contact",
    "spring",
    "damper",
    "clampctrl",
    "warmstart",
    "filterparent",
    "refsafe",
    "sensor",
    "eulerdamp",
    "midphase",
    "nativeccd",
    "island",
    "autoreset",
    "multiccd",
)


@pytest.mark.parametrize("flag", FLAGS)
def test_flag_that_is_not_refused_leaves_a_free_tools_run_as_it_was(
    tmp_path: Path, plain_ticks: tuple[Path, NDArray[np.void]], flag: str
) -> None:
    hand, expected = plain_ticks
    option = f"<option><flag {flag}='disable'/></option>"
    got = ticks(scene_file(tmp_path, mjcf(option, body=GRIPPED)), hand)
    for name in ("tool_position", "tool_quaternion", "wrench_on_tool", "environment_energy"):
        assert np.array_equal(got[name], expected[name]), name


def test_compiled_model_does_not_depend_on_the_folder_or_tell_it(tmp_path: Path) -> None:
    compiled = []
    for folder in (tmp_path / "a", tmp_path / "elsewhere" / "b"):
        (folder / "meshes").mkdir(parents=True)
        (folder / "meshes" / "t.obj").write_text(
            "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
        )
        (folder / "s.xml").write_text(
            """<mujoco><compiler meshdir="meshes"/><asset><mesh name="t" file="t.obj"/></asset>
            <worldbody><body><freejoint/><geom type="mesh" mesh="t" mass=".1"/><site name="grip"/>
            </body></worldbody></mujoco>"""
        )
        compiled.append(compiled_model(load_scene(folder / "s.xml").model))
    assert compiled[0] == compiled[1]
    assert str(tmp_path).encode() not in compiled[0]
