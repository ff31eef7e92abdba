"""Tasks for any engine: what they refuse, what a scene becomes, what an engine prints."""

from __future__ import annotations

import ctypes
import os
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from engine_tasks import COUPLING

from hapticbridge.device.trajectory import Motion
from hapticbridge.errors import StudyError
from hapticbridge.files import install_command
from hapticbridge.kernel.pose import quaternion_exp
from hapticbridge.lab.engines import base
from hapticbridge.lab.engines.base import (
    ENGINES,
    Body,
    Pose,
    Task,
    available_engines,
    caught_prints,
    composed,
    open_engine,
)
from hapticbridge.lab.engines.from_scene import task_from_scene
from hapticbridge.scene import Scene, load_scene

SCENE = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001" gravity="0.3 0 -9" integrator="implicitfast" {option}/>
  <asset><mesh name="wedge" vertex="0 0 0  0.02 0 0  0 0.02 0  0 0 0.02"/></asset>
  <default><geom condim="3" friction="0.2"/></default>
  <worldbody>
    <geom name="floor" type="box" size="1 1 0.1" pos="0 0 -0.5" {floor}/>
    <body pos="0.5 0 0" euler="0 0 0.4">
      <geom name="post" {post} size="0.02 0.1 0.1" pos="0 0.1 0" euler="0.3 0 0"/>
      <geom name="ball" type="sphere" size="0.03" pos="0 0.5 0"/>
    </body>
    <geom name="drawn" type="cylinder" size="0.1 0.1" contype="0" conaffinity="0"/>
    <body name="tool" pos="0 0 0.2" {tool}>
      <freejoint name="tool"/>
      <inertial pos="0.01 0.02 -0.03" euler="0.1 0.2 0.3" mass="0.2"
                diaginertia="1e-4 2e-4 2.5e-4"/>
      <geom name="handle" type="box" size="0.01 0.02 0.03" pos="0.05 0 0" euler="0 0.5 0" {geom}/>
      <geom name="tip" type="mesh" mesh="wedge" pos="0 0 -0.05"/>
      <site name="grip" pos="0.02 0 0.01" euler="0 0 0.7"/>
      {child}
    </body>
    {world}
  </worldbody>
  {top}
  <keyframe>
    <key name="home" qpos="0.1 0.2 0.3 0.9 0.1 0.3 -0.2" qvel="0.1 -0.2 0.3 3 1 2"/>
  </keyframe>
</mujoco>
"""
PARTS = dict.fromkeys(("option", "floor", "post", "tool", "geom", "child", "world", "top"), "") | {
    "post": 'type="capsule"'
}


def scene_with(tmp_path: Path, **parts: str) -> Scene:
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.format(**{**PARTS, **parts}))
    return load_scene(path)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return scene_with(tmp_path)


def test_a_scenes_tool_has_mujocos_numbers(scene: Scene) -> None:
    motion = Motion([0, 1], [(0, 0, 0), (0.1, 0, 0)], [(1, 0, 0, 0), quaternion_exp((0, 0, 0.5))])
    task = task_from_scene(scene, motion, COUPLING)
    data, body_id = scene.data, scene.model.body("tool").id
    assert task.name == "scene"
    assert task.coupling is COUPLING
    assert task.body.mass == scene.model.body_mass[body_id]
    assert task.body.inertia == tuple(scene.model.body_inertia[body_id])
    assert task.gravity == (0.3, 0, -9)
    centre = composed(task.start, task.body.inertia_frame)
    assert centre.position == pytest.approx(data.xipos[body_id])
    axes = np.empty(4)
    mujoco.mju_mat2Quat(axes, data.ximat[body_id])
    assert abs(np.dot(centre.quaternion, axes)) == pytest.approx(1)
    grip = composed(task.start, task.grip)
    assert grip.position == pytest.approx(data.site("grip").xpos)
    velocity = np.empty(6)
    mujoco.mj_objectVelocity(scene.model, data, mujoco.mjtObj.mjOBJ_BODY, body_id, velocity, 0)
    assert task.start_velocity.linear == pytest.approx(velocity[3:])
    assert task.start_velocity.angular == pytest.approx(velocity[:3])
    # the motion, counted from its first pose, begins at the grip and turns in the world's axes
    first, second = task.handle_poses(1.0, 1)
    assert first.position == pytest.approx(grip.position)
    assert first.quaternion == pytest.approx(grip.quaternion)
    assert np.subtract(second.position, first.position) == pytest.approx([0.1, 0, 0])
    turned = composed(
        Pose(quaternion=quaternion_exp((0, 0, 0.5))), Pose(quaternion=grip.quaternion)
    )
    assert second.quaternion == pytest.approx(turned.quaternion)


def test_a_scenes_shapes_are_where_mujoco_has_them(scene: Scene) -> None:
    task = task_from_scene(scene)
    assert [shape.kind for shape in task.fixed] == ["box", "capsule", "sphere"]
    assert [shape.kind for shape in task.body.shapes] == ["box", "mesh"]
    assert task.fixed[1].size == (0.02, 0.1)
    placed = [
        *zip(("floor", "post", "ball"), (shape.pose for shape in task.fixed), strict=True),
        *zip(
            ("handle", "tip"),
            (composed(task.start, shape.pose) for shape in task.body.shapes),
            strict=True,
        ),
    ]
    for name, pose in placed:
        axes = np.empty(4)
        mujoco.mju_mat2Quat(axes, scene.data.geom(name).xmat)
        assert pose.position == pytest.approx(scene.data.geom(name).xpos)
        assert abs(np.dot(axes, pose.quaternion)) == pytest.approx(1)
    tip = task.body.shapes[1]
    placed_corners = (composed(tip.pose, Pose(tuple(v))) for v in np.asarray(tip.vertices))
    corners = [tuple(round(value, 6) for value in pose.position) for pose in placed_corners]
    wedge = ((0, 0, -0.05), (0.02, 0, -0.05), (0, 0.02, -0.05), (0, 0, -0.03))
    assert sorted(corners) == sorted(wedge)
    assert task.body.friction == 0.2


def test_other_free_bodies_of_a_scene_are_others_of_the_task(tmp_path: Path) -> None:
    weight = """<body name="weight" pos="0.3 0 0.1" euler="0 0 0.2"><freejoint/>
      <inertial pos="0 0 0.01" mass="0.4" diaginertia="1e-4 1e-4 1e-4"/>
      <geom name="brick" type="box" size="0.01 0.02 0.03" pos="0 0.01 0"/></body>"""
    qpos = "0.1 0.2 0.3 0.9 0.1 0.3 -0.2"
    two = SCENE.replace(qpos, f"{qpos} 0.4 0 0.2 1 0 0 0")

    def load(speed: float) -> Scene:
        text = two.replace("3 1 2", f"3 1 2 0 0 {speed} 0 0 0")
        path = tmp_path / "two.xml"
        path.write_text(text.format(**PARTS | {"world": weight}))
        return load_scene(path)

    scene = load(0.0)
    task = task_from_scene(scene)
    (other,) = task.others
    assert task.body.mass == 0.2
    assert other.body.mass == 0.4
    assert other.start.position == pytest.approx((0.4, 0, 0.2))
    assert other.principal.position == pytest.approx(scene.data.body("weight").xipos)
    assert other.body.shapes[0].position == pytest.approx((0, 0.01, 0))
    assert other.body.friction == task.body.friction == 0.2
    assert [shape.kind for shape in task.fixed] == ["box", "capsule", "sphere"]
    with pytest.raises(StudyError, match="that is not the tool moves at the start"):
        task_from_scene(load(0.1))


def test_mujoco_as_a_peer_moves_a_scene_as_mujoco_does(scene: Scene, tmp_path: Path) -> None:
    task = task_from_scene(scene)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    simulation = open_engine("mujoco").open(task, 1e-3)
    for _ in range(100):
        mujoco.mj_step(model, data)
        simulation.advance((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert data.ncon == 0
    assert simulation.pose().position == pytest.approx(data.qpos[:3], abs=1e-12)
    quaternion = np.array(simulation.pose().quaternion)
    assert abs(quaternion @ data.qpos[3:]) == pytest.approx(1, abs=1e-12)


TENDON = '<tendon><spatial><site site="grip"/><site site="o"/></spatial></tendon>'
REFUSED = {
    "joints": ({"child": '<body><joint/><geom size="0.01"/></body>'}, "2 joint"),
    "bodies": ({"child": '<body><geom size="0.01"/></body>'}, "several bodies"),
    "mocap": ({"world": '<body mocap="true"><geom size="0.01"/></body>'}, "mocap"),
    "tendon": ({"top": TENDON, "world": '<site name="o"/>'}, "tendons"),
    "equality": ({"top": '<equality><weld body1="tool"/></equality>'}, "constraints"),
    "actuator": ({"top": '<actuator><motor joint="tool"/></actuator>'}, "actuators"),
    "pair": ({"top": '<contact><pair geom1="handle" geom2="floor"/></contact>'}, "pairs"),
    "gravcomp": ({"tool": 'gravcomp="1"'}, "gravity compensation"),
    "fluid": ({"option": 'density="1.2"'}, "fluid"),
    "kind": ({"post": 'type="ellipsoid"'}, "ellipsoid; they share box, sphere, capsule, mesh"),
    "margin": ({"geom": 'margin="0.001"'}, "'handle' has a margin"),
    "masks": ({"geom": 'contype="2" conaffinity="2"', "floor": 'contype="3"'}, "not every geom"),
    "friction": ({"floor": 'friction="0.4"'}, "differ in friction"),
    "condim": ({"floor": 'condim="4"'}, "condim 4"),
}


@pytest.mark.filterwarnings("ignore::UserWarning")  # what the bridge would say of such a scene
@pytest.mark.parametrize(("parts", "clause"), REFUSED.values(), ids=REFUSED)
def test_what_other_engines_do_not_share_is_refused(
    tmp_path: Path, parts: dict[str, str], clause: str
) -> None:
    scene = scene_with(tmp_path, **parts)
    with pytest.raises(StudyError, match="cannot be given to other engines") as caught:
        task_from_scene(scene)
    assert clause in str(caught.value)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_friction_follows_priority_and_condim_as_in_mujoco(tmp_path: Path) -> None:
    # all of the tool's geoms have priority over one that is rougher
    rough = 'friction="0.9" priority="-1"'
    assert task_from_scene(scene_with(tmp_path, floor=rough)).body.friction == 0.2
    smooth = SCENE.replace('condim="3"', 'condim="1"')
    (tmp_path / "smooth.xml").write_text(smooth.format(**PARTS))
    assert task_from_scene(load_scene(tmp_path / "smooth.xml")).body.friction == 0


def test_a_handle_without_motion_rests_at_the_grip() -> None:
    task = Task("task", Body(1.0, (1.0,) * 3), grip=Pose((0.0, 0.0, 1.0)), start=Pose((1.0, 0, 0)))
    assert task.handle_poses(1e-3, 2) == [Pose((1.0, 0.0, 1.0))] * 3


def test_every_engine_is_available_or_says_in_a_sentence_why_not() -> None:
    found = available_engines()
    assert "mujoco" in found.available
    assert {*found.available, *found.missing} == set(ENGINES)
    assert all(engine.name == name for name, engine in found.available.items())
    assert all("not installed" in sentence for sentence in found.missing.values())


def test_an_engine_that_is_not_there_names_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(_name: str) -> None:
        raise ImportError("No module named 'pydrake'")

    monkeypatch.setattr(base, "import_module", missing)
    hint = re.escape(install_command("peers"))
    with pytest.raises(StudyError, match=rf"'drake_point' is not installed .*{hint}"):
        open_engine("drake_point")
    with pytest.raises(StudyError, match=r"no engine 'havok'; engines: 'drake_hydroelastic'"):
        open_engine("havok")


BUFFER = ctypes.create_string_buffer(4096)
"""C's stdout keeps it as long as the process lives."""


def test_prints_of_c_are_told_once_and_kept_from_stdout(capfd: pytest.CaptureFixture[str]) -> None:
    told: list[str] = []
    libc = ctypes.CDLL(None)
    # as where stdout is a pipe: C writes when its memory is full (_IOFBF), or when it is told to
    libc.setvbuf(ctypes.c_void_p.in_dll(libc, "stdout"), BUFFER, 0, len(BUFFER))
    with caught_prints(told.append):
        ctypes.CDLL(None).puts(b"switched solver")
        ctypes.CDLL(None).puts(b"switched solver")
        os.write(1, b"\xff raw\n\n")
    ctypes.CDLL(None).puts(b"after")
    ctypes.CDLL(None).fflush(None)
    assert sorted(told) == ["switched solver", "\ufffd raw"]
    assert capfd.readouterr().out == "after\n"


def test_stdout_is_itself_again_after_an_error_and_what_was_printed_is_told(
    capfd: pytest.CaptureFixture[str],
) -> None:
    told: list[str] = []
    descriptors = len(list(Path("/dev/fd").iterdir()))
    with pytest.raises(ZeroDivisionError), caught_prints(told.append):
        os.write(1, b"last words\n")
        raise ZeroDivisionError
    os.write(1, b"after\n")
    assert told == ["last words"]
    assert capfd.readouterr().out == "after\n"
    assert len(list(Path("/dev/fd").iterdir())) == descriptors
