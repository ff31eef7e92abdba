"""Every simplification from both sides: taken where it cannot be felt, refused where it can."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from outside_scenes import mjcf, scene_file
from over_modelled import tessellated_box
from scipy.spatial.transform import Rotation

from hapticbridge.check import lean, simplify
from hapticbridge.check.case import motion_for
from hapticbridge.check.lean import IS_FELT, MAY_GO, Judge, VariantVerdict
from hapticbridge.check.simplify import Simplification
from hapticbridge.check.version import CLEARANCE, SceneVariant, name_everything, witness
from hapticbridge.coupling import Coupling
from hapticbridge.demand.rehearsal import RunPoint
from hapticbridge.device import Motion
from hapticbridge.errors import SceneError
from hapticbridge.kernel.mujoco_c import quiet
from hapticbridge.scene import read_scene

COUPLING = Coupling(2400.0, 0.5, 2.4, 5e-4)
OWN_CONTACT = RunPoint(COUPLING, contact="scene")
OPTION = '<option gravity="0 0 0" cone="elliptic"/>'
CONTACT = 'solref="0.002 1" solimp="0.9 0.95 0.001"'

Stop = tuple[float, Sequence[float], Sequence[float]]


def through(*stops: Stop) -> Motion:
    """Moves smoothly through (seconds, offset in m, rotation vector), 100 poses a second."""
    times, poses = [np.zeros(1)], [np.zeros((1, 6))]
    for seconds, offset, turn in stops:
        s = np.linspace(0.0, 1.0, round(100 * seconds) + 1)[1:, None]
        last = poses[-1][-1]
        poses.append(last + s**3 * (10 - 15 * s + 6 * s**2) * (np.array([*offset, *turn]) - last))
        times.append(times[-1][-1] + seconds * s[:, 0])
    table = np.vstack(poses)
    quaternions = Rotation.from_rotvec(table[:, 3:]).as_quat(scalar_first=True)
    return Motion(np.concatenate(times), table[:, :3], quaternions)


NOWHERE = (0.0, 0.0, 0.0)
DOWN: Stop = (0.3, (0, 0, -0.004), NOWHERE)
PRESS = through(DOWN, (0.2, (0, 0, -0.004), NOWHERE))
SLIDE = through(DOWN, (0.4, (0.01, 0.006, -0.004), NOWHERE))
TWIST = through(DOWN, (0.4, (0, 0, -0.004), (0, 0, 0.4)))
ROLL = through(DOWN, (0.4, (0, 0, -0.004), (0.4, 0, 0)))


def half_price(first: SceneVariant, second: SceneVariant, _: Motion) -> tuple[float, float]:
    """Calls every change a saving, so that only what is felt decides."""
    texts = [draft.spec.copy().to_xml() for draft in (first, second)]  # to_xml compiles in place
    return 1.0, 1.0 if texts[0] == texts[1] else 0.5


def draft_of(tmp_path: Path, text: str, setting: RunPoint | None = None) -> SceneVariant:
    return variant(scene_file(tmp_path, text), setting)


def variant(scene: str | Path, setting: RunPoint | None = None) -> SceneVariant:
    source = read_scene(scene)
    name_everything(source.spec)
    return SceneVariant(source, "grip", setting or RunPoint(COUPLING))


def judged(*arguments: Any, **options: Any) -> VariantVerdict:
    """Returns how a simplification was judged that there is."""
    trial = tried(*arguments, **options)
    assert trial is not None
    return trial


def all_of(draft: SceneVariant, motion: Motion) -> dict[str, Simplification]:
    return {each.name: each for each in lean.all_simplifications(draft, motion)}


def tried(
    draft: SceneVariant, motion: Motion, name: str, budget: float = 1.0, damping: float = 2.0
) -> VariantVerdict | None:
    """Returns how a simplification was judged; None where there was nothing to change."""
    with quiet():
        judge = Judge(draft, motion, budget, damping, half_price)
        each, changed = all_of(draft, motion)[name], draft.copy()
        if not each.edit(changed):
            return None
        if changed.setting != draft.setting:
            cost = lambda a, b, _: (1.0, 0.5 + 0.5 * (a is b))  # noqa: E731
            judge = Judge(draft, motion, budget, damping, cost)
            judge.min_saving = lean.MIN_SAVING
        return judge.judge(name, "", changed, loses=each.loses)


def ball_on_floor(condim: int = 6) -> str:
    """A ball of 1 cm above a plane, with friction of every kind."""
    friction = f'condim="{condim}" friction="0.5 0.01 0.01" {CONTACT}'
    tool = f"""<body name="tool"><freejoint name="tool"/>
      <geom name="ball" size="0.01" mass="0.1" {friction}/><site name="grip"/></body>"""
    floor = f'<geom name="floor" type="plane" size="1 1 1" pos="0 0 -0.011" {friction}/>'
    return mjcf(OPTION, body=tool, world=floor)


@pytest.mark.parametrize(
    ("name", "motion", "expected"),
    [
        ("no friction", PRESS, MAY_GO),
        ("no friction", SLIDE, IS_FELT),
        ("condim 3", SLIDE, MAY_GO),
        ("condim 3", TWIST, IS_FELT),
        ("condim 4", TWIST, MAY_GO),
        ("condim 4", ROLL, IS_FELT),
    ],
)
def test_unfelt_friction_goes(tmp_path: Path, name: str, motion: Motion, expected: str) -> None:
    assert judged(draft_of(tmp_path, ball_on_floor()), motion, name).verdict == expected


def test_unfelt_cone_goes_and_stays_where_the_run_makes_it_elliptic(tmp_path: Path) -> None:
    draft = draft_of(tmp_path, ball_on_floor(), OWN_CONTACT)
    assert judged(draft, PRESS, "pyramidal cone").verdict == MAY_GO
    assert judged(draft, SLIDE, "pyramidal cone").verdict == IS_FELT
    assert tried(draft_of(tmp_path, ball_on_floor()), PRESS, "pyramidal cone") is None


def test_contact_dimensions_that_are_not_there_cannot_be_taken(tmp_path: Path) -> None:
    draft = draft_of(tmp_path, ball_on_floor(condim=1), OWN_CONTACT)
    for name in ("no friction", "condim 3", "condim 4", "pyramidal cone"):
        assert tried(draft, PRESS, name) is None


def with_obstacle(height: float) -> str:
    """A tool that comes as near to a box as the height, on its way 10 mm down."""
    tool = '<body name="tool"><freejoint/><geom name="ball" size="0.01"/><site name="grip"/></body>'
    box = f'<geom name="box" type="box" size="0.1 0.1 0.01" pos="0 0 {-0.03 - height}"/>'
    return mjcf(OPTION, body=tool, world=f'<body name="table">{box}</body>')


TEN_DOWN = through((0.4, (0, 0, -0.01), NOWHERE), (0.1, (0, 0, -0.01), NOWHERE))


@pytest.mark.parametrize("name", ["idle geoms", "idle pairs"])
def test_what_stays_clear_may_go_and_what_comes_near_stays(tmp_path: Path, name: str) -> None:
    clear = judged(draft_of(tmp_path, with_obstacle(2 * CLEARANCE)), TEN_DOWN, name)
    assert clear.verdict == MAY_GO
    assert clear.error is not None
    assert clear.error.force_peak == 0.0
    assert clear.loses == "in this motion"
    # not touched, but too near to promise anything
    assert tried(draft_of(tmp_path, with_obstacle(0.5 * CLEARANCE)), TEN_DOWN, name) is None


def test_plane_without_bounding_sphere_is_seen_to_be_near(tmp_path: Path) -> None:
    seen = witness(draft_of(tmp_path, ball_on_floor()), PRESS)
    assert seen.near == {frozenset(("ball", "floor"))}
    # 1 mm below the tool, though its centre is far away
    aside = ball_on_floor().replace('pos="0 0 -0.011"', 'pos="0.5 0 -0.011"')
    above = through((0.2, (0, 0, 0.004), NOWHERE))
    assert witness(draft_of(tmp_path, aside), above).near == {frozenset(("ball", "floor"))}


def test_motion_that_a_scene_does_not_survive_is_refused(tmp_path: Path) -> None:
    tool = """<body name="tool"><joint type="slide" damping="{}"/><geom size="0.01" mass="0.1"/>
      <site name="grip"/></body>"""
    up = through((0.3, (0, 0, 1e-3), NOWHERE))
    with quiet(), pytest.raises(SceneError, match="not finite after tick"):
        witness(draft_of(tmp_path, mjcf(OPTION, body=tool.format("-1e3"))), up)
    assert witness(draft_of(tmp_path, mjcf(OPTION, body=tool.format("1"))), up).near == set()


def shipped(name: str, setting: RunPoint | None = None) -> tuple[SceneVariant, Motion]:
    draft = variant(name, setting)
    motion = motion_for(draft.compiled())
    assert motion is not None
    return draft, motion


def test_solver_may_stop_where_it_has_arrived_and_nothing_may_be_less_passive() -> None:
    draft, motion = shipped("peg_in_hole", OWN_CONTACT)
    assert judged(draft, motion, "5 iterations", budget=0.1).verdict == MAY_GO
    assert judged(draft, motion, "1 iteration", budget=0.1).verdict == IS_FELT
    trial = judged(draft, motion, "no friction", budget=10.0)
    assert (trial.verdict, trial.environment) == (lean.CREATES, "within slack")


def test_solver_limit_stays_where_the_run_raises_it() -> None:
    draft, motion = shipped("peg_in_hole")
    limits = [name for name in all_of(draft, motion) if "iteration" in name]
    assert limits
    assert not any(tried(draft, motion, name) for name in limits)


def test_what_makes_mujoco_warn_is_refused_though_within_budget() -> None:
    draft, motion = shipped("hammer", OWN_CONTACT)
    trial = judged(draft, motion, "2 iterations", budget=10.0)
    assert trial.verdict == lean.WARNS
    assert trial.warnings > 0


def test_tight_tolerance_may_be_the_usual_one(tmp_path: Path) -> None:
    tight = ball_on_floor().replace("<option", '<option tolerance="1e-14"')
    trial = judged(draft_of(tmp_path, tight), SLIDE, "usual tolerance")
    assert trial.verdict == MAY_GO
    assert tried(draft_of(tmp_path, ball_on_floor()), SLIDE, "usual tolerance") is None


def block_of_mesh(points: np.ndarray, visuals: str = "") -> str:
    """A free mesh that stands 1 mm above a plane."""
    numbers = " ".join(f"{value:.9g}" for value in points.ravel())
    asset = f'<asset><mesh name="mesh" vertex="{numbers}"/></asset>'
    tool = f"""<body name="tool"><freejoint/>
      <geom name="block" type="mesh" mesh="mesh" mass="0.1" {CONTACT}/>{visuals}
      <site name="grip"/></body>"""
    low = float(points[:, 2].min()) - 0.001
    floor = f'<geom name="floor" type="plane" size="1 1 1" pos="0 0 {low}" {CONTACT}/>'
    return mjcf(OPTION, asset, body=tool, world=floor)


BOX = tessellated_box(np.array([0.01, 0.01, 0.02]), 1e-6)[0]
DIRECTIONS = np.random.default_rng(3).normal(size=(200, 3))
BALL = 0.02 * DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
SPIKE = np.vstack([np.array([[1, 0, 1], [-1, 1, 1], [-1, -1, 1]]) * 0.01, [[0, 0, -0.01]]])


def test_corners_of_a_hull_go_where_they_carry_nothing(tmp_path: Path) -> None:
    # the corner on which it stands is kept, those on which it rolls are not
    ball = draft_of(tmp_path, block_of_mesh(BALL))
    assert judged(ball, PRESS, "hulls of 8").verdict == MAY_GO
    assert judged(ball, ROLL, "hulls of 8").verdict == IS_FELT
    assert tried(draft_of(tmp_path, block_of_mesh(SPIKE)), PRESS, "hulls of 8") is None


def test_mesh_that_is_a_primitive_becomes_one_and_a_spike_does_not(tmp_path: Path) -> None:
    assert judged(draft_of(tmp_path, block_of_mesh(BOX)), PRESS, "primitives").verdict == MAY_GO
    assert judged(draft_of(tmp_path, block_of_mesh(SPIKE)), TWIST, "primitives").verdict != MAY_GO
    assert tried(draft_of(tmp_path, ball_on_floor()), PRESS, "primitives") is None


def test_primitive_stands_where_mesh_stood_in_frames_and_classes_and_files(tmp_path: Path) -> None:
    numbers = " ".join(f"{value:.9g}" for value in (BOX + np.array([0.03, 0.0, 0.01])).ravel())
    head = f"""<asset><mesh name="mesh" vertex="{numbers}"/></asset>
      <default><default class="m"><geom type="mesh" mesh="mesh" mass="0.1"/></default></default>"""
    tool = """<body name="tool"><freejoint/><frame pos="0.1 0 0" euler="0 0 90">
      <geom name="block" class="m" pos="0 0.02 0" euler="0 90 0"/></frame>
      <site name="grip"/></body>"""
    draft = draft_of(tmp_path, mjcf(OPTION, head, body=tool))
    changed = draft.copy()
    assert all_of(draft, PRESS)["primitives"].edit(changed)
    read_back = mujoco.MjSpec.from_string(changed.spec.copy().to_xml())
    # the block's centre goes by its own turn, the frame's turn and both offsets; its edges likewise
    own, frame = (Rotation.from_euler("xyz", a, degrees=True) for a in ((0, 90, 0), (0, 0, 90)))
    inner = np.array([0, 0.02, 0]) + own.apply([0.03, 0, 0.01])
    centre = np.array([0.1, 0, 0]) + frame.apply(inner)
    extent = np.abs((frame * own).apply([0.01, 0.01, 0.02]))
    for model in (changed.compiled().model, read_back.compile()):
        geom = model.geom("block")
        assert model.geom_type[geom.id] == mujoco.mjtGeom.mjGEOM_BOX
        np.testing.assert_allclose(geom.pos, centre, atol=2e-6)
        turn = Rotation.from_quat(geom.quat, scalar_first=True)
        np.testing.assert_allclose(np.abs(turn.apply(geom.size)), extent, atol=2e-6)
        assert model.nmesh == 0


def test_what_is_only_seen_goes_and_its_mass_stays(tmp_path: Path) -> None:
    weight = '<geom size="0.02" pos="0.05 0 0" mass="0.5" contype="0" conaffinity="0"/>'
    draft = draft_of(tmp_path, block_of_mesh(BOX, weight))
    changed = draft.copy()
    assert all_of(draft, PRESS)["nothing only seen"].edit(changed)
    before, after = draft.compiled().model, changed.compiled().model
    assert after.ngeom == before.ngeom - 1
    np.testing.assert_allclose(after.body_mass, before.body_mass)
    np.testing.assert_allclose(after.body_inertia, before.body_inertia)
    swing = through((0.2, (0.02, 0, 0.01), (0, 0.2, 0)))
    trial = judged(draft, swing, "nothing only seen")
    assert (trial.verdict, trial.loses) == (MAY_GO, "with the picture")
    # without its mass it would be felt
    changed.spec.body("tool").mass = 0.1
    judge = Judge(draft, swing, 1.0, 2.0, half_price)
    assert judge.judge("", "", changed).verdict == IS_FELT


def test_mass_stays_where_geoms_overrule_what_is_written(tmp_path: Path) -> None:
    weight = '<geom size="0.02" pos="0.05 0 0" mass="0.5" contype="0" conaffinity="0"/>'
    overruled = '<inertial pos="0 0 0" mass="9" diaginertia="1 1 1"/>'
    compiler = '<mujoco><compiler inertiafromgeom="true"/>'
    text = block_of_mesh(BOX, weight + overruled).replace("<mujoco>", compiler)
    draft = draft_of(tmp_path, text)
    changed = draft.copy()
    assert all_of(draft, PRESS)["nothing only seen"].edit(changed)
    before, after = draft.compiled().model, changed.compiled().model
    np.testing.assert_allclose(after.body_mass, before.body_mass)
    np.testing.assert_allclose(after.body_ipos, before.body_ipos)


def test_mass_stays_where_bodies_are_fused(tmp_path: Path) -> None:
    weight = (
        '<body><geom size="0.02" pos="0.05 0 0" mass="0.5" contype="0" conaffinity="0"/></body>'
    )
    fused = '<mujoco><compiler fusestatic="true"/>'
    draft = draft_of(tmp_path, block_of_mesh(BOX, weight).replace("<mujoco>", fused))
    changed = draft.copy()
    assert all_of(draft, PRESS)["nothing only seen"].edit(changed)
    before, after = draft.compiled().model, changed.compiled().model
    assert (before.nbody, after.ngeom) == (after.nbody, before.ngeom - 1)
    np.testing.assert_allclose(after.body_mass, before.body_mass)
    np.testing.assert_allclose(after.body_inertia, before.body_inertia, rtol=1e-6)


def test_what_a_sensor_refers_to_is_not_taken_away(tmp_path: Path) -> None:
    weight = '<geom name="weight" size="0.02" mass="0.5" contype="0" conaffinity="0"/>'
    sensor = '<sensor><framepos objtype="geom" objname="weight"/></sensor>'
    text = block_of_mesh(BOX, weight).replace("</mujoco>", f"{sensor}</mujoco>")
    assert tried(draft_of(tmp_path, text), PRESS, "nothing only seen") is None


def test_rate_goes_down_only_as_far_as_device_and_hand_allow(tmp_path: Path) -> None:
    soft = RunPoint(Coupling(400.0, 0.3, 1.0, 6e-4))
    free = mjcf(OPTION)
    aside = (0.03, 0, 0)
    slow, fast = (through((s, aside, NOWHERE), (s, NOWHERE, NOWHERE)) for s in (2.0, 0.08))
    draft = draft_of(tmp_path, free, soft)
    assert judged(draft, slow, "half the rate").verdict == MAY_GO
    assert judged(draft, fast, "half the rate", budget=0.1).verdict == IS_FELT
    weak = judged(draft, slow, "half the rate", damping=0.35)
    # at 2 ms K T/2 = 0.4 > B: B' = 0
    assert weak.verdict == lean.NOT_BORNE
    assert weak.needed_damping == pytest.approx(0.4)
    assert judged(draft, slow, "half the rate", damping=0.4).verdict == MAY_GO


def test_substeps_go_where_they_were_not_needed(tmp_path: Path) -> None:
    setting = RunPoint(COUPLING, substeps=4)
    draft = draft_of(tmp_path, ball_on_floor(), setting)
    slow = through((1.0, (0.02, 0, 0.01), NOWHERE))
    assert judged(draft, slow, "1 substep").verdict == MAY_GO
    strike = through((0.03, (0, 0, -0.004), NOWHERE), (0.1, (0.01, 0.006, -0.004), NOWHERE))
    assert judged(draft, strike, "1 substep", budget=0.1).verdict == IS_FELT


def test_change_that_saves_nothing_is_not_taken(tmp_path: Path) -> None:
    draft = draft_of(tmp_path, ball_on_floor())
    judge = Judge(draft, PRESS, 1.0, 2.0, lambda *_: (1.0, 0.97))
    judge.min_saving = lean.MIN_SAVING
    changed = draft.copy()
    assert all_of(draft, PRESS)["no friction"].edit(changed)
    assert judge.judge("", "", changed).verdict == lean.SAVES_NOTHING


def test_noise_of_the_measurement_raises_what_counts_as_a_saving(tmp_path: Path) -> None:
    draft = draft_of(tmp_path, ball_on_floor())
    assert Judge(draft, PRESS, 1.0, 2.0, lambda *_: (1.0, 1.0)).min_saving == lean.MIN_SAVING
    noisy = Judge(draft, PRESS, 1.0, 2.0, lambda *_: (1.0, 0.9))
    assert noisy.min_saving == pytest.approx(0.3)


@pytest.mark.parametrize("turn", [Rotation.identity(), Rotation.from_rotvec([0.3, -0.8, 0.5])])
def test_best_primitive_of_a_primitive_is_itself(turn: Rotation) -> None:
    frame = turn.as_matrix()
    angle = np.linspace(0.0, 2 * np.pi, 64, endpoint=False)
    ring = 0.01 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    cylinder = np.vstack([ring + np.array([0, 0, 0.03]), ring - np.array([0, 0, 0.03])])
    ball = np.vstack([0.5 * BALL, -0.5 * BALL])
    upper = ball * np.array([1, 1, 0]) + np.abs(ball) * np.array([0, 0, 1])
    upper[:, 2] += 0.03
    shapes = {
        "BOX": BOX,
        "CYLINDER": cylinder,
        "SPHERE": ball,
        "CAPSULE": np.vstack([upper, -upper]),
    }
    for name, points in shapes.items():
        moved = points @ frame.T + [0.1, -0.2, 0.3]
        found = simplify.best_primitive(moved, [frame])
        assert found.kind == getattr(mujoco.mjtGeom, f"mjGEOM_{name}")
        np.testing.assert_allclose(found.position, [0.1, -0.2, 0.3], atol=1e-3)
        local = (moved - found.position) @ found.axes
        assert np.abs(simplify.signed_distance(found.kind, found.size, local)).max() < 1.1e-3
        assert np.linalg.det(found.axes) == pytest.approx(1.0)
