"""A start in which the tool is inside something, or that MuJoCo would not step, is refused."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from outside_scenes import (
    FREE_TOOL,
    mjcf,
    scene_file,
)
from scene_cases import HINGE_TOOL, refusal, refusal_of

import hapticbridge as hb
from hapticbridge.inputs import input_writes
from hapticbridge.scene import load_scene

TABLE = "<geom name='table' type='plane' size='1 1 1'/>"


def resting(height: float) -> str:
    body = FREE_TOOL.replace('name="tool">', f'name="tool" pos="0 0 {height}">', 1)
    return mjcf(body=body, world=TABLE)


def test_tool_inside_something_is_refused_with_pair_and_depth(tmp_path: Path) -> None:
    message = refusal_of(tmp_path, resting(0.0098))
    assert "overlap by 0.2 mm" in message
    assert "geom 'table' and geom 'ball'" in message
    unnamed = resting(0.005).replace('name="ball"', "").replace("name='table'", "")
    message = refusal_of(tmp_path, unnamed)
    assert "overlap by 5 mm" in message
    assert "geom 0 of the world and geom 1 of body 'tool'" in message


@given(depth=st.floats(1e-5, 5e-3))
@example(depth=0.05e-3)
@example(depth=0.099e-3)
@example(depth=0.101e-3)
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_start_is_refused_exactly_beyond_a_tenth_of_a_millimetre(
    tmp_path: Path, depth: float
) -> None:
    path = scene_file(tmp_path, resting(0.01 - depth))
    if depth > 1.0001e-4:
        assert "starts in penetration" in refusal(path)
    elif depth < 0.9999e-4:
        load_scene(path)


def test_start_is_judged_at_keyframe_home(tmp_path: Path) -> None:
    deep = "<keyframe><key name='{}' qpos='0 0 0.005 1 0 0 0'/></keyframe>"
    text = resting(1.0).replace("</mujoco>", deep + "</mujoco>")
    load_scene(scene_file(tmp_path, text.format("other")))
    assert "overlap by 5 mm" in refusal_of(tmp_path, text.format("home"))


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
    "key", ["qpos='0 0 1e11 1 0 0 0 0'", "qvel='0 0 1e11 0 0 0 0'", "ctrl='1e11'"]
)
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
