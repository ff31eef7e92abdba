"""An over-modelled peg is found out; what is written can be read, run, and does its task."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import model_runs
import mujoco
import numpy as np
import pytest
from outside_scenes import mjcf, obj_bytes, scene_file
from over_modelled import ITERATIONS, over_modelled_peg

from hapticbridge.check import lean
from hapticbridge.check.case import motion_for
from hapticbridge.check.cost import CHUNKS, VariantRun, one_pass, processor_costs
from hapticbridge.check.lean import IS_FELT, MAY_GO, Judge, Lean, find_lean
from hapticbridge.check.lean_output import lean_facts, write_lean
from hapticbridge.check.perception import felt_error
from hapticbridge.check.simplify import (
    contact_simplifications,
    freedom_simplifications,
    shape_simplifications,
)
from hapticbridge.check.version import SceneVariant, name_everything, witness
from hapticbridge.cli import main
from hapticbridge.coupling import Coupling
from hapticbridge.demand.rehearsal import RunPoint
from hapticbridge.device import Motion
from hapticbridge.errors import SceneError
from hapticbridge.scene import load_scene, read_scene
from hapticbridge.scene.contacts import meeting_pairs

COUPLING = Coupling(2400.0, 0.5, 2.4, 5e-4)

Capsys = pytest.CaptureFixture[str]


def count(draft: SceneVariant) -> float:
    """Counts what a version models, so that no test hangs on a clock."""
    model = draft.compiled().model
    colliding = [g for g in range(model.ngeom) if model.geom_contype[g]]
    meshes = {int(model.geom_dataid[g]) for g in colliding} - {-1}
    corners = sum(int(model.mesh_graph[model.mesh_graphadr[mesh]]) for mesh in meshes)
    pairs = len(list(meeting_pairs(model)))
    rows = sum(int(model.geom_condim[g]) ** 2 for g in colliding)
    tight = 500.0 if draft.spec.option.tolerance < 1e-8 else 0.0
    work = model.nv**2 + model.ngeom + pairs + rows + corners + model.opt.iterations + tight
    return float(work) / draft.setting.period


def planted(first: SceneVariant, second: SceneVariant, _: Motion) -> tuple[float, float]:
    return count(first), count(second)


def own_motion(name: str, seconds: float = np.inf, speed: float = 1.0) -> Motion:
    motion = motion_for(load_scene(name))
    assert motion is not None
    table = motion.table[motion.table[:, 0] <= seconds]
    return Motion(table[:, 0] / speed, table[:, 1:4], table[:, 4:])


@pytest.fixture(scope="module")
def found() -> Lean:
    # four times as fast as the path on which the outcome is judged, to save time
    motion = own_motion("peg_in_hole", speed=4.0)
    return find_lean(
        SceneVariant(over_modelled_peg(), "grip", RunPoint(COUPLING)), motion, cost=planted
    )


@pytest.fixture(scope="module")
def written(found: Lean, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = tmp_path_factory.mktemp("lean") / "lean.xml"
    trial = write_lean(found, path)
    assert trial.verdict == MAY_GO
    return path


def test_over_modelled_peg_is_three_times_cheaper_within_one_jnd(found: Lean) -> None:
    assert found.result.cost and found.result.cost < 1 / 3
    assert found.result.error and found.result.error.jnd <= 1.0
    assert found.result.environment == "strict"
    taken = {trial.name for trial in found.together}
    assert {"primitives", "nothing only seen", "usual tolerance", "condim 3"} <= taken


def test_solver_of_the_lean_peg_works_three_times_less(found: Lean) -> None:
    """Counted by MuJoCo, not by the test's own price list."""
    before = found.judge.rehearsal.records
    after = found.draft.rehearsed(found.judge.motion).records
    assert before["solver_iterations"].max() == ITERATIONS
    assert before["solver_iterations"].sum() > 3 * after["solver_iterations"].sum()


def test_lean_peg_does_its_task(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model_runs, "spec_of", lambda name: mujoco.MjSpec.from_file(str(written)))
    run = model_runs.run_of_own_path.__wrapped__("peg_in_hole")
    height = run.tool[:, 2]
    assert height.min() == pytest.approx(model_runs.BOTTOMED_HEIGHT, abs=5e-5)
    assert run.touched["hole_bottom"].any()
    assert run.touched["hole_east"][4600:5300].any()
    assert (run.force[5050:5200, 0] > 4.0).all()
    assert height[-1] == pytest.approx(model_runs.HOME_HEIGHT, abs=1e-3)
    assert run.warnings == 0


def test_each_step_together_is_cheaper_than_the_one_before_and_within_budget(found: Lean) -> None:
    costs = [1.0, *(trial.cost or 0.0 for trial in found.together)]
    assert all(later < 0.96 * earlier for earlier, later in itertools.pairwise(costs))
    assert all(trial.error and trial.error.jnd <= 1.0 for trial in found.together)
    assert found.result.cost == pytest.approx(costs[-1])


def test_smaller_budget_takes_less(found: Lean, monkeypatch: pytest.MonkeyPatch) -> None:
    felt = {trial.name: trial.error.jnd for trial in found.alone if trial.error}
    assert 0.1 < felt["primitives"] < 1.0
    motion, every = own_motion("peg_in_hole", 2.0, speed=2.0), lean.all_simplifications
    two = "primitives", "usual tolerance"
    chosen = lambda *told: [each for each in every(*told) if each.name in two]  # noqa: E731
    monkeypatch.setattr(lean, "all_simplifications", chosen)
    how: Any = {"budget": 0.01, "cost": planted}
    strict = find_lean(SceneVariant(over_modelled_peg(), "grip", RunPoint(COUPLING)), motion, **how)
    verdicts = {trial.name: trial.verdict for trial in strict.alone}
    assert verdicts == {"primitives": IS_FELT, "usual tolerance": MAY_GO}


def test_written_scene_says_what_was_changed_and_runs(written: Path, capsys: Capsys) -> None:
    text = written.read_text(encoding="utf-8")
    assert "Made leaner from peg_in_hole.xml" in text
    assert "Taken: primitives (" in text
    assert "What it models: a square peg" in text  # the scene's own comment
    assert main(["run", str(written), "--fast", "--duration", "0.3"]) == 0
    assert "passive (strict)" in capsys.readouterr().out


TOOL = """<body name="tool"><freejoint name="tool"/>
  <geom name="bar" type="box" size="0.02 0.01 0.01" mass="0.1"/><site name="grip"/></body>"""


def planar(sideways: float = 0.0) -> Motion:
    """Moves along x and z and turns about y; sideways in m along y."""
    time = np.linspace(0.0, 1.0, 101)
    s = time**3 * (10 - 15 * time + 6 * time**2)
    path = np.stack([0.02 * s, sideways * s, -0.01 * s], axis=1)
    turn = 0.3 * s
    quaternions = np.stack([np.cos(turn / 2), 0 * s, np.sin(turn / 2), 0 * s], axis=1)
    return Motion(time, path, quaternions)


PLANAR = "'tool' slides along xz and turns about y"


def free_draft(tmp_path: Path, extra: str = "", body: str = TOOL) -> SceneVariant:
    text = mjcf('<option gravity="0 0 0"/>', body=body).replace("</mujoco>", f"{extra}</mujoco>")
    source = read_scene(scene_file(tmp_path, text))
    name_everything(source.spec)
    return SceneVariant(source, "grip", RunPoint(COUPLING))


def freedoms(draft: SceneVariant, motion: Motion) -> dict[str, Callable[[SceneVariant], bool]]:
    seen = witness(draft, motion)
    return {each.name: each.edit for each in freedom_simplifications(draft, seen)}


def felt_of(draft: SceneVariant, motion: Motion, name: str) -> float:
    changed = draft.copy()
    assert freedoms(draft, motion)[name](changed)
    before, after = (each.rehearsed(motion).records for each in (draft, changed))
    return felt_error(before, after).jnd


def test_free_tool_keeps_the_axes_that_it_uses(tmp_path: Path) -> None:
    draft = free_draft(tmp_path)
    # 0.4 mm sideways are 1 N on the coupling, if the tool cannot follow
    assert felt_of(draft, planar(0.0004), PLANAR) > 1.0
    assert PLANAR not in freedoms(draft, planar(0.004))


@pytest.mark.parametrize("joint", ["", "<joint damping='50' stiffness='500'/>"])
def test_joints_that_replace_a_free_one_are_not_felt(tmp_path: Path, joint: str) -> None:
    draft = free_draft(tmp_path, f"<default>{joint}</default>")
    assert felt_of(draft, planar(), PLANAR) < 0.05


KEYS = """<keyframe>
  <key name="home" qpos="0.01 0 0.02 0.8 0 0.6 0" qvel="0.1 0 0.2 0 0.5 0"/>
  <key name="far" qpos="0.05 0 -0.03 0.96 0 0.28 0"/>
</keyframe>"""


def test_keyframes_show_the_same_poses_and_velocities_with_fewer_freedoms(tmp_path: Path) -> None:
    draft = free_draft(tmp_path, KEYS)
    changed = draft.copy()
    assert freedoms(draft, planar())[PLANAR](changed)
    models = [each.compiled().model for each in (draft, changed)]
    assert [model.nq for model in models] == [7, 3]
    for key in ("home", "far"):
        shown = []
        for model in models:
            data = mujoco.MjData(model)
            mujoco.mj_resetDataKeyframe(model, data, model.key(key).id)
            mujoco.mj_forward(model, data)
            site = model.site("grip").id
            speed = np.zeros(6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, site, speed, 0)
            shown.append(np.concatenate([data.site_xpos[site], data.site_xmat[site], speed]))
        np.testing.assert_allclose(shown[1], shown[0], atol=1e-12)


JOINTED = """<frame euler="0 0 30"><body name="post" pos="0.1 0 0">
  <joint name="post" type="hinge" axis="0 0 1" stiffness="100" springref="22.9183"/>
  <geom name="post" size="0.01" mass="0.5"/>
  <body name="tool" pos="0.05 0 0">
    <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
    <geom size="0.01" mass="0.1"/><site name="grip"/></body></body></frame>"""


def test_joint_that_hardly_moves_is_fixed_where_it_started(tmp_path: Path) -> None:
    key = '<keyframe><key name="home" qpos="0.4 0.01 0.02"/></keyframe>'
    draft = free_draft(tmp_path, key, JOINTED)
    up = Motion(np.linspace(0, 1, 11), np.outer(np.arange(11.0) / 1e3, [0, 0, 1]))
    changed = draft.copy()
    assert freedoms(draft, up)["'post' fixed"](changed)
    scenes = [each.compiled() for each in (draft, changed)]
    assert [scene.model.nv for scene in scenes] == [3, 2]
    np.testing.assert_allclose(scenes[1].grip_pose(), scenes[0].grip_pose(), atol=1e-12)
    # a joint away from its reference cannot be taken out from among others of its body
    assert not freedoms(draft, up)["'x' fixed"](draft.copy())


def test_joint_that_something_refers_to_stays(tmp_path: Path) -> None:
    still = Motion(np.linspace(0, 0.1, 11), np.zeros((11, 3)))
    key = '<keyframe><key name="home" qpos="0.4 0 0"/></keyframe>'
    extra = '<sensor><jointpos joint="post"/></sensor>'
    free = free_draft(tmp_path, key, JOINTED)
    assert freedoms(free, still)["'post' fixed"](free.copy())
    draft = free_draft(tmp_path, key + extra, JOINTED)
    assert not freedoms(draft, still)["'post' fixed"](draft.copy())


@pytest.fixture
def with_files(tmp_path: Path) -> Path:
    """A scene of two files and a mesh, whose folders the compiler names."""
    scene_file(tmp_path / "meshes", obj_bytes(), "tool.obj")
    mesh = '<mujoco><asset><mesh name="m" file="tool.obj"/></asset></mujoco>'
    scene_file(tmp_path, mesh, "a.xml")
    tool = """<body name="tool"><freejoint/><geom name="skin" type="mesh" mesh="m" mass="0.1"
      contype="0" conaffinity="0"/><geom name="ball" size="0.01" mass="0.1" condim="6"/>
      <geom name="seen" size="0.01" mass="0.1" contype="0" conaffinity="0"/>
      <site name="tip"/></body><geom name="floor" type="plane" size="1 1 1" pos="0 0 -0.011"
      condim="6" solref="0.002 1"/>"""
    head = '<compiler meshdir="meshes"/><option gravity="0 0 0" iterations="50"/>'
    return scene_file(tmp_path, mjcf(head, '<include file="a.xml"/>', body=tool))


def lean_of(path: Path) -> Lean:
    down = np.zeros((21, 3))
    down[:, 2] = -0.004 * np.sin(np.linspace(0, np.pi, 21))
    motion = Motion(np.linspace(0, 0.5, 21), down)
    return find_lean(
        SceneVariant(read_scene(path), "tip", RunPoint(COUPLING)), motion, cost=planted
    )


def test_scene_with_includes_and_meshes_is_written_elsewhere(with_files: Path) -> None:
    lean = lean_of(with_files)
    # what is only seen is still in it, so that the path of its mesh is used
    kept = lean.judge.original.copy()
    for geom in kept.spec.geoms:
        geom.condim = 1
    target = with_files.parent / "deep" / "er" / "lean.xml"
    target.parent.mkdir(parents=True)
    trial = write_lean(replace(lean, draft=kept), target)
    asked = lean.judge.judge("", "", kept)
    assert trial.error and asked.error
    assert trial.error.jnd == pytest.approx(asked.error.jnd, abs=1e-3)
    text = target.read_text(encoding="utf-8")
    assert 'file="../../meshes/tool.obj"' in text
    assert "<include" not in text
    load_scene(target, grip="tip")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("scene.xml", "is a file of the scene itself"),
        ("a.xml", "is a file of the scene itself"),
        ("meshes/tool.obj", "must end in .xml"),
        ("there.xml", "exists; choose another file"),
        ("no/where.xml", "cannot write .*the folder .* does not exist"),
    ],
)
def test_files_not_to_be_written_are_refused(with_files: Path, name: str, message: str) -> None:
    lean, there = lean_of(with_files), with_files.parent / "there.xml"
    there.write_text("kept")
    with pytest.raises(SceneError, match=message):
        write_lean(lean, with_files.parent / name)
    assert there.read_text() == "kept"
    write_lean(lean, there, overwrite=True)
    load_scene(there, grip="tip")


def test_facts_hold_every_trial_by_name(found: Lean) -> None:
    facts = json.loads(json.dumps(lean_facts(found), allow_nan=False))
    assert [trial["name"] for trial in facts["alone"]] == [each.name for each in found.alone]
    assert [trial["name"] for trial in facts["together"]] == [each.name for each in found.together]
    assert facts["result"]["felt_jnd"] == found.result.error.jnd  # type: ignore[union-attr]


def test_processor_time_of_more_work_is_more_and_both_are_positive() -> None:
    """No time is asserted: a hundred substeps are simply more than one."""
    source = read_scene("virtual_wall")
    light = SceneVariant(source, "grip", RunPoint(COUPLING))
    heavy = SceneVariant(source, "grip", RunPoint(COUPLING, substeps=100))
    costs = processor_costs(light, heavy, own_motion("virtual_wall", 0.1))
    assert 0.0 < costs[0] < costs[1]


def test_motion_is_timed_whole_and_as_it_is_rehearsed() -> None:
    draft = SceneVariant(read_scene("virtual_wall"), "grip", RunPoint(COUPLING))
    motion = own_motion("virtual_wall", 1.2)
    stages = [VariantRun(draft, motion) for _ in range(2)]
    for _ in range(2):  # the second time from the start again
        assert one_pass(stages).shape == (2, CHUNKS)
    for stage in stages:
        np.testing.assert_array_equal(stage.rows, draft.rehearsed(motion).records)


REASONS = {
    "in this motion": "what a shipped scene's own motion does not visit, another one does",
    "with the picture": "a shipped scene is to be looked at, too",
}
KEPT = {
    "bench_pliers": {"no friction": "it saves 1 % of the time, less than counts"},
    "pliers": {"no friction": "the jaws touch the wire only where a grip axis closes them"},
    "screwdriver": {"no friction": "how much there is can be set in this scene"},
}
"""Parts that may go by the planted price, and the reason why they stay in a shipped scene."""


@pytest.mark.parametrize("name", model_runs.LOOP_SCENES)
def test_shipped_scenes_model_nothing_that_may_go(name: str) -> None:
    """No freedom, contact dimension, pair, cone or hull, but for the reasons above.

    The motion is its own, three times as fast to save time.
    """
    source = read_scene(name)
    name_everything(source.spec)
    draft, motion = (
        SceneVariant(source, "grip", RunPoint(COUPLING)),
        own_motion(name, speed=3.0),
    )
    judge = Judge(draft, motion, 0.1, 2.0, planted)
    seen, trials = witness(draft, motion), []
    shapes = *contact_simplifications(seen), *shape_simplifications()
    for each in (*shapes, *freedom_simplifications(draft, seen)):
        changed = draft.copy()
        try:
            if each.edit(changed):
                trials.append(judge.judge(each.name, "", changed, loses=each.loses))
        except SceneError:  # as a primitive in place of a hollow that starts inside the tool
            continue
    may_go = {trial.name for trial in trials if trial.verdict == MAY_GO and not trial.loses}
    assert may_go <= set(KEPT.get(name, ()))
    assert {trial.loses for trial in trials} <= {*REASONS, ""}


def test_progress_ends_and_where_nothing_may_go_nothing_is_written(tmp_path: Path) -> None:
    told: list[tuple[float, float, str]] = []
    source, motion = read_scene("virtual_wall"), own_motion("virtual_wall", 2.0)
    how: Any = {"cost": lambda *_: (1.0, 1.0), "progress": lambda *news: told.append(news)}
    lean = find_lean(SceneVariant(source, "grip", RunPoint(COUPLING)), motion, **how)
    done = [part for part, _, _ in told]
    assert (done, done[-1]) == (sorted(done), told[-1][1])
    assert lean.together == ()
    with pytest.raises(SceneError, match="no simplification may be made"):
        write_lean(lean, tmp_path / "lean.xml")
