"""The handle and its actuators, whatever the defaults say; all else of a scene survives."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from outside_scenes import FREE_TOOL, GRIPPED, RICH, hand_file, mjcf, scene_file, ticks

import hapticbridge as hb
from hapticbridge.kernel.codes import COUPLING_ACTUATORS, HANDLE
from hapticbridge.scene import load_scene


def pose(data: Any, site: str) -> NDArray[np.float64]:
    return np.concatenate([data.site(site).xpos, data.site(site).xmat])


def assert_at_grip(data: Any) -> None:
    assert pose(data, HANDLE) == pytest.approx(pose(data, "grip"), abs=1e-15)


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
    "fromto='0 0 0 .1 .1 .1' type='capsule' size='.01'",
)


@pytest.mark.parametrize("site", SITE_DEFAULTS)
def test_handle_stands_at_the_grip_whatever_the_default_of_sites(tmp_path: Path, site: str) -> None:
    text = mjcf(f"<default><site {site}/></default>", body=FREE_TOOL if "from" in site else TURNED)
    scene = load_scene(scene_file(tmp_path, text))
    assert_at_grip(scene.data)
    handle = scene.model.site(HANDLE)
    assert [*handle.pos, *handle.quat] == [0, 0, 0, 1, 0, 0, 0]
    assert "from" not in site or scene.data.site("grip").xpos == pytest.approx([0.05] * 3)


def test_handle_stands_at_the_grip_in_qpos0_and_in_every_keyframe(tmp_path: Path) -> None:
    keys = """<keyframe><key name='up' qpos='0 0 3 1 0 0 0'/>
    <key name='home' qpos='.1 .2 .3 .5 .5 -.5 .5'/></keyframe>"""
    plain = load_scene(scene_file(tmp_path, mjcf(body=TURNED)))
    assert_at_grip(plain.data)
    keyed = load_scene(scene_file(tmp_path, mjcf(keys, body=TURNED)))
    assert keyed.data.qpos == pytest.approx([0.1, 0.2, 0.3, 0.5, 0.5, -0.5, 0.5])
    assert_at_grip(keyed.data)
    # a start that was changed after loading takes the handle along
    before = keyed.model.key_qpos[1].copy()
    keyed.model.key_qpos[1] = [7, 7, 7, 1, 0, 0, 0]
    keyed.reset()
    assert_at_grip(keyed.data)
    keyed.model.key_qpos[1] = before
    # whoever opens the compiled model without the package finds the handle there as well
    for key in (None, 0, 1):
        data = mujoco.MjData(keyed.model)
        if key is not None:
            mujoco.mj_resetDataKeyframe(keyed.model, data, key)
        mujoco.mj_forward(keyed.model, data)
        assert_at_grip(data)
        assert np.abs(data.qfrc_actuator).max() < 1e-12


def test_handle_weighs_nothing_whatever_the_compiler_is_told(tmp_path: Path) -> None:
    geom = "<default><geom mass='7' size='1 1 1'/></default>"
    bound = "<compiler boundmass='0.5' boundinertia='0.1'/>"
    scene = load_scene(scene_file(tmp_path, mjcf(bound, geom)))
    model, data = scene.model, scene.data
    assert model.body("tool").mass == 0.5
    assert model.body(HANDLE).mass == 0
    assert not model.body(HANDLE).inertia.any()
    # else the potential energy of the ledger would follow the hand
    mujoco.mj_energyPos(model, data)
    before = data.energy[0]
    data.mocap_pos[-1] += 1.0
    mujoco.mj_forward(model, data)
    assert data.energy[0] == before
    assert model.body(HANDLE).geomnum == 0


def test_scene_gives_the_handle_six_actuators_and_nothing_else(tmp_path: Path) -> None:
    path = scene_file(tmp_path, mjcf(body=TURNED))
    alone, model = mujoco.MjModel.from_xml_path(str(path)), load_scene(path).model
    added = {name: getattr(model, name) - getattr(alone, name) for name in ("nq", "nv", "ngeom")}
    assert not any(added.values())
    assert (model.nbody - alone.nbody, model.nsite - alone.nsite, model.nmocap) == (1, 1, 1)
    assert (model.nactuator, model.nu, model.neq, model.nsensor) == (6, 6, 0, 0)
    assert [model.actuator(i).name for i in range(6)] == list(COUPLING_ACTUATORS)


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


@pytest.mark.parametrize("default", ACTUATOR_DEFAULTS)
def test_default_does_not_reach_the_coupling(
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


def test_everything_of_the_users_scene_survives_unchanged(tmp_path: Path) -> None:
    path = scene_file(tmp_path, RICH)
    alone, scene = mujoco.MjModel.from_xml_path(str(path)), load_scene(path)
    model = scene.model
    kept = (
        "jnt_", "eq_", "tendon_", "wrap_", "sensor_", "numeric_", "text_", "exclude_", "geom_",
        "dof_", "key_qpos", "key_qvel", "key_act", "key_time", "qpos0", "qpos_spring",
    )  # fmt: skip
    # indices into the table of names and of bodies after ours may shift
    fields = [name for name in dir(alone) if name.startswith(kept) and "bodyid" not in name]
    arrays = [name for name in fields if isinstance(getattr(alone, name), np.ndarray)]
    assert len(arrays) > 100
    for name in arrays:
        assert np.array_equal(getattr(alone, name), getattr(model, name)), name
    counts = {"joint": 2, "geom": 4, "tendon": 2, "sensor": 3, "equality": 2, "key": 2}
    for kind, count in counts.items():
        for i in range(count):
            assert getattr(model, kind)(i).name == getattr(alone, kind)(i).name
    for name in ("drive", "torque", "winch"):
        a, b = alone.actuator(name), model.actuator(name)
        for field in ("id", "biasprm", "gainprm", "forcerange", "dyntype", "gear"):
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


INERTIAL = "<inertial pos='0 0 0' mass='1' diaginertia='1 1 1'/>"


@pytest.mark.parametrize(
    "text",
    [
        mjcf(body=f"<body><freejoint/>{INERTIAL}<site name='grip'/></body>"),
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = load_scene(scene_file(tmp_path, text))
    with hb.Bridge(scene, f"trajectory:{hand}", clock=hb.SimulatedClock()) as bridge:
        summary = bridge.run()
        last = bridge.latest_records(1)[0]
        carrying = bridge.session.parameters.handle_origin[:3]  # above the tool by its weight
    assert summary.environment == "strict"
    # 9.81 N on 2400 N/m is 4 mm
    assert last["tool_position"] == pytest.approx(last["handle_position"], abs=5e-3)
    expected = np.add(carrying, [0.01, 0.0, 0.01])
    assert last["handle_position"] == pytest.approx(expected, abs=1e-12)


FLAGS = (
    "constraint", "equality", "frictionloss", "limit", "contact", "spring", "damper", "clampctrl",
    "warmstart", "filterparent", "refsafe", "sensor", "eulerdamp", "midphase", "nativeccd",
    "island", "autoreset", "multiccd",
)  # fmt: skip


@pytest.mark.parametrize("flag", FLAGS)
def test_flag_leaves_a_free_tools_run_as_it_was(
    tmp_path: Path, plain_ticks: tuple[Path, NDArray[np.void]], flag: str
) -> None:
    hand, expected = plain_ticks
    option = f"<option><flag {flag}='disable'/></option>"
    got = ticks(scene_file(tmp_path, mjcf(option, body=GRIPPED)), hand)
    for name in ("tool_position", "tool_quaternion", "wrench_on_tool", "environment_energy"):
        assert np.array_equal(got[name], expected[name]), name
