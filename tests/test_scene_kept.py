"""What the user's scene holds survives, and strange but legal scenes run."""

from __future__ import annotations

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from outside_scenes import (
    hand_file,
    mjcf,
    scene_file,
)
from scene_cases import GRIPPED, RICH, ticks

import hapticbridge as hb
from hapticbridge.scene import Scene, load_scene


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
