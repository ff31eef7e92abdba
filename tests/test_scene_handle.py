"""The handle and its actuators, whatever the scene's defaults say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from outside_scenes import (
    FREE_TOOL,
    mjcf,
    scene_file,
)
from scene_cases import GRIPPED, ticks

from hapticbridge.kernel.codes import COUPLING_ACTUATORS
from hapticbridge.scene import load_scene


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
    before = keyed.model.key_qpos[1].copy()
    keyed.model.key_qpos[1] = [7, 7, 7, 1, 0, 0, 0]
    keyed.reset()
    assert handle_pose(keyed.data) == pytest.approx(grip_pose(keyed.data), abs=1e-15)
    keyed.model.key_qpos[1] = before
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
