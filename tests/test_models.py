"""The scenes of models/: their files, their contact, and the pegs on their own hand paths."""

from __future__ import annotations

import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import model_runs as runs
import mujoco
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import hapticbridge as hb
from hapticbridge.kernel.codes import HANDLE
from hapticbridge.scene import scene_names

SCENES = scene_names(1)
CONTACT_SCENES = set(SCENES) - {"point_mass"}

BRISK = {"hammer": (0.7, 25.0)}
"""Speed in m/s and acceleration in m/s² of a hand that is not to be ordinary: it strikes."""


@pytest.mark.parametrize("name", SCENES)
def test_scene_has_what_the_bridge_needs(name: str) -> None:
    model = runs.spec_of(name).compile()
    assert model.key("home").id == 0
    grip_body = model.site("grip").bodyid[0]
    assert model.body_dofnum[grip_body] > 0
    text = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, "about")
    start = model.text_adr[text]
    sentence = bytes(model.text_data[start : start + model.text_size[text] - 1]).decode()
    assert 20 < len(sentence) < 130
    assert sentence.endswith(".")
    assert all(model.geom(i).name for i in range(model.ngeom))
    assert model.opt.timestep == runs.T
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_DIAGEXACT


@pytest.mark.parametrize("name", SCENES)
def test_solver_settings_are_written_in_the_file_not_left_to_defaults(name: str) -> None:
    root = ET.parse(runs.MODELS / name / f"{name}.xml").getroot()
    option = root.find("option")
    assert option is not None
    assert {"timestep", "integrator", "cone", "gravity"} <= set(option.attrib)
    model = runs.spec_of(name).compile()
    colliding = (model.geom_contype | model.geom_conaffinity) != 0
    assert colliding.any() == (name in CONTACT_SCENES)
    assert (model.geom_solref[colliding] == [0.002, 1.0]).all()
    assert (model.geom_solimp[colliding] == [0.9, 0.95, 0.001, 0.5, 2.0]).all()
    collision = root.find(".//default[@class='collision']/geom")
    assert (collision is not None) == (name in CONTACT_SCENES)
    if collision is not None:
        assert {"condim", "solref", "solimp"} <= set(collision.attrib)


@pytest.mark.parametrize("name", SCENES)
def test_tool_starts_clear_of_everything_and_the_handle_at_its_grip(name: str) -> None:
    _, data = runs.scene_with_handle(name)
    assert data.ncon == 0
    assert np.array_equal(data.site("grip").xpos, data.site(HANDLE).xpos)
    # the pliers rest 2e-6 rad in their stop
    np.testing.assert_allclose(data.site("grip").xmat, data.site(HANDLE).xmat, atol=2.1e-6)


@pytest.mark.parametrize("name", SCENES)
def test_hand_path_starts_at_zero_and_ends_there_at_rest(name: str) -> None:
    file = runs.MODELS / name / f"{name}.csv"
    assert file.read_text().startswith("t,x,y,z,qw,qx,qy,qz\n")
    rows = runs.path_of(name)
    assert rows[-1, 0] == pytest.approx(8.0)
    assert np.diff(rows[:, 0]) == pytest.approx(0.01)
    for end in (rows[0], rows[-1]):
        assert np.array_equal(end[1:], [0, 0, 0, 1, 0, 0, 0])
    # the files hold ten digits of a quaternion
    assert np.linalg.norm(rows[:, 4:], axis=1) == pytest.approx(1.0, abs=1e-9)
    velocity = np.diff(rows[:, 1:4], axis=0) / 0.01
    assert np.abs(velocity[[0, -1]]).max() < 1e-4
    # a quick but ordinary hand: 0.3 m/s and 3 m/s²
    speed, acceleration = BRISK.get(name, (0.3, 3.0))
    assert np.linalg.norm(velocity, axis=1).max() < speed
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() / 0.01 < acceleration


def meshes_of(folder: Path) -> dict[tuple[str, str], np.ndarray]:
    """Returns the corners of every mesh of the scenes in a folder, shape (n, 3), in m."""
    return {
        (file.stem, mesh.attrib["name"]): np.loadtxt([mesh.attrib["vertex"]]).reshape(-1, 3)
        for file in sorted(folder.glob("*/*.xml"))
        for mesh in ET.parse(file).getroot().iter("mesh")
    }


def test_the_scripts_make_the_hand_paths_and_the_meshes_that_are_here(tmp_path: Path) -> None:
    for name in scene_names():
        text = (runs.MODELS / name / f"{name}.xml").read_text(encoding="utf-8")
        (tmp_path / name).mkdir()
        blank = re.sub('vertex="[^"]*"', 'vertex=""', text)
        (tmp_path / name / f"{name}.xml").write_text(blank, encoding="utf-8")
    for script in ("make_hand_paths.py", "make_meshes.py"):
        command = [sys.executable, str(runs.ROOT / "scripts" / script), str(tmp_path)]
        subprocess.run(command, check=True)
    # one unit of the last written digit: processors differ in the last bit of a sine
    paths = sorted(runs.MODELS.glob("*/*.csv"))
    assert len(paths) == len(scene_names()) + 3  # fingers of the pliers; two paths of two scenes
    for path in paths:
        made, kept = (
            np.loadtxt(file, delimiter=",", skiprows=1)
            for file in (tmp_path / path.parent.name / path.name, path)
        )
        np.testing.assert_allclose(made, kept, rtol=0, atol=1.1e-8)
    meshes, here = meshes_of(tmp_path), meshes_of(runs.MODELS)
    assert meshes.keys() == here.keys()
    assert len(here) == 6
    for key, corners in here.items():
        np.testing.assert_allclose(meshes[key], corners, rtol=0, atol=1.1e-8)


def test_meshes_are_small_and_convex() -> None:
    for corners in meshes_of(runs.MODELS).values():
        assert len(corners) < 60
        # MuJoCo collides the hull: no corner may lie inside, or what is drawn would not be touched
        faces = ConvexHull(corners).equations
        assert ((corners @ faces[:, :3].T + faces[:, 3]).max(axis=1) > -1e-9).all()


@pytest.mark.parametrize("name", runs.LOOP_SCENES)
def test_own_path_stays_below_ten_newtons_and_gains_no_more_than_the_slack(name: str) -> None:
    run = runs.run_of_own_path(name)
    assert run.warnings == 0
    assert np.isfinite(run.tool).all() and np.isfinite(run.gained).all()
    assert np.linalg.norm(run.force, axis=1).max() < 10.0
    # default limit of the simulated device
    assert np.linalg.norm(run.torque, axis=1).max() < 0.5
    strict = 1e-9 + 1e-9 * run.work
    assert (run.gained <= strict + run.slack * (name in CONTACT_SCENES)).all()
    # it moved: a scene that stands still would pass the above
    assert run.work[-1] > 1e-4


def test_wall_is_pressed_with_seven_newtons_and_tapped_three_times() -> None:
    run = runs.run_of_own_path("virtual_wall")
    touching = run.touched["wall"]
    ticks = np.arange(len(touching))
    held = (ticks > 2400) & (ticks < 3300)
    assert touching[held].all()
    assert ((run.force[held, 0] > 6.0) & (run.force[held, 0] < 9.0)).all()
    # 7 N against 1.2e5 N/m
    assert run.deepest[held] == pytest.approx(60e-6, rel=0.25)
    assert run.tool[held, 0] == pytest.approx(0.01 + run.deepest[held], abs=1e-6)
    # apart by more than 1 mm between taps
    away = run.tool[4200:7000, 0] < 0.009
    assert np.count_nonzero(~away[1:] & away[:-1]) == 3
    assert touching[4200:7000].any()


def without_friction(spec: Any) -> None:
    for geom in spec.geoms:
        geom.condim = 1


def with_default_contact(spec: Any) -> None:
    plain = mujoco.MjSpec().worldbody.add_geom()
    for geom in spec.geoms:
        geom.solref, geom.solimp = plain.solref, plain.solimp


def test_single_contact_gives_by_twelve_micrometres_under_three_newtons() -> None:
    # the peg stands on one corner, its space diagonal upright, on the rim east of the hole
    diagonal = np.array([-0.01, 0.01, -0.03])
    upright, _ = Rotation.align_vectors([[0, 0, -1]], [diagonal / np.linalg.norm(diagonal)])
    vector = tuple(upright.as_rotvec())
    length = float(np.linalg.norm(diagonal))
    above = length - runs.HOME_HEIGHT
    # the coupling carries nothing once the tool rests; it presses with 2.8 N
    press = above - 2.8 / runs.K
    model, data = runs.scene_with_handle("peg_in_hole")
    heights = (0.3, 0.02), (0.3, above + 0.002), (0.3, press), (0.4, press)
    run = runs.moved_through(model, data, [(s, (0.02, 0, z), vector) for s, z in heights])
    assert data.ncon == 1
    wrench = np.zeros(6)
    mujoco.mj_contactForce(model, data, 0, wrench)
    assert wrench[0] == pytest.approx(2.8, rel=0.02)
    assert run.deepest[-1] == pytest.approx(12e-6, rel=0.5)


@pytest.mark.parametrize(
    ("edit", "least", "most"), [(None, 5e-6, 25e-6), (with_default_contact, 300e-6, 1e-3)]
)
def test_peg_sinks_in_by_default(edit: runs.Edit | None, least: float, most: float) -> None:
    model, data = runs.scene_with_handle("peg_in_hole", edit)
    stops = (0.8, 0.0), (0.4, 0.0015), (0.6, 0.0015)
    run = runs.moved_through(model, data, [(s, (x, 0, -0.04), (0, 0, 0)) for s, x in stops])
    assert least < run.deepest[-1] < most
    assert least < run.tool[-1, 0] - 0.0002 < most


def rigid_optimum(handle: runs.Array, vector: runs.Array) -> tuple[runs.Array, Rotation]:
    """Least coupling energy of a rigid, frictionless peg that is inside the hole.

    The part of the peg in the hole is the convex hull of its four lower corners and of the points
    where its long edges cross the mouth, so it is inside exactly if these eight points are.
    """
    corners = np.array([[x, y, -0.03] for x in (-0.01, 0.01) for y in (-0.01, 0.01)])
    along = np.array([0.0, 0.0, 0.06])

    def pose(p: runs.Array) -> tuple[runs.Array, Rotation]:
        # millimetres and hundredths of a radian, so that the optimiser sees numbers near one
        return 1e-3 * p[:3], Rotation.from_rotvec(1e-2 * p[3:])

    def energy(p: runs.Array) -> float:
        x, rotation = pose(p)
        angle = (Rotation.from_rotvec(vector) * rotation.inv()).as_rotvec()
        springs = runs.K * ((handle - x) ** 2).sum() + runs.K_R * (angle**2).sum()
        return float(0.5e3 * springs)

    def room(p: runs.Array) -> runs.Array:
        x, rotation = pose(p)
        low = x + rotation.apply(corners)
        edge = rotation.apply(along)
        mouth = low - np.outer(low[:, 2] / edge[2], edge)
        sides = np.concatenate([low[:, :2], mouth[:, :2]]).ravel()
        return 1e3 * np.concatenate([0.0102 - sides, 0.0102 + sides, low[:, 2] + 0.04])

    guess = np.array([0.0, 0.0, 1e3 * max(handle[2], runs.BOTTOMED_HEIGHT), 0.0, 0.0, 0.0])
    for _ in range(2):
        found = minimize(
            energy, guess, method="SLSQP", constraints={"type": "ineq", "fun": room},
            options={"maxiter": 300, "ftol": 1e-12},
        )  # fmt: skip
        assert found.success
        guess = found.x
    assert room(guess).min() > -1e-6
    return pose(guess)


@pytest.mark.parametrize(
    ("offset", "vector"),
    [
        ((0.002, 0.0, -0.04), (0.0, 0.01, 0.0)),
        ((0.0015, 0.0, -0.04), (0.0, 0.02, 0.0)),
        ((-0.001, 0.001, -0.045), (0.0, -0.04, 0.03)),
        ((0.001, 0.0015, -0.053), (0.02, 0.01, 0.0)),
    ],
    ids=["2 mm, tilted", "1.5 mm, more tilted", "into a corner, turned", "onto the bottom"],
)
def test_settled_frictionless_pose_is_within_20_micrometres_of_the_rigid_optimum(
    offset: tuple[float, float, float], vector: tuple[float, float, float]
) -> None:
    model, data = runs.scene_with_handle("peg_in_hole", without_friction)
    poses = [(0.5, (0, 0, offset[2]), (0, 0, 0)), (0.4, offset, vector), (0.8, offset, vector)]
    run = runs.moved_through(model, data, poses)
    assert np.abs(data.qvel).max() < 1e-5
    position, rotation = rigid_optimum(run.handle[-1], np.array(vector))
    assert np.linalg.norm(run.tool[-1] - position) < 20e-6
    # contact that gives by 20 µm at the ends of a peg of 60 mm
    assert (run.rotation[-1] * rotation.inv()).magnitude() < 2e-3
    # the coupling really pushed: the peg is not where the handle is
    assert np.linalg.norm(run.handle[-1] - run.tool[-1]) > 5e-4


def depth_at(scene: hb.Scene, radius: float, angle: float, height: float = 0.0) -> float:
    """Returns how deep an upright peg's deepest contact is, off centre by a radius in m."""
    data = mujoco.MjData(scene.model)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    data.qpos[:] = [x, y, height, 1, 0, 0, 0]
    mujoco.mj_forward(scene.model, data)
    return max((-float(contact.dist) for contact in data.contact), default=-np.inf)


@pytest.mark.parametrize("clearance", [5e-6, 0.2e-3, 1e-3])
def test_play_of_the_peg_is_the_dodecagon_around_the_clearance(clearance: float) -> None:
    scene = hb.load_scene("round_peg", clearance=clearance)
    for angle in np.radians(np.arange(0.0, 360.0, 7.5)):
        from_middle = (angle + np.pi / 12) % (np.pi / 6) - np.pi / 12
        play = clearance / np.cos(from_middle)
        # the ten corners of a sector are written to a micrometre; the walls they make are exact
        assert depth_at(scene, play - 1e-6, angle) < 0
        assert 0 < depth_at(scene, play + 2e-6, angle) < 2.1e-6


def test_chamfer_is_a_millimetre_at_45_degrees() -> None:
    scene = hb.load_scene("round_peg")
    for off in (0.4e-3, 0.7e-3, 1.1e-3):
        # the lower rim of a peg that is off centre by 0.2 mm + s touches the chamfer s above its
        # foot, which lies 1 mm below the mouth; 0.03 m from the rim to the peg's centre
        touching = 0.03 - 0.001 + (off - 0.2e-3)
        assert depth_at(scene, off, 0.0, touching + 3e-6) < 0
        assert depth_at(scene, off, 0.0, touching - 3e-6) > 0


def test_scripted_path_finds_the_hole_over_the_chamfer_and_reaches_the_bottom() -> None:
    run = runs.run_of_own_path("round_peg")
    height, axis = run.tool[:, 2], np.hypot(run.tool[:, 0], run.tool[:, 1])
    on_the_chamfer = slice(1700, 2500)
    touched = np.any([run.touched[f"sector_{i:02d}"] for i in range(12)], axis=0)
    assert touched[on_the_chamfer].mean() > 0.9
    # it came down beside the hole and slid in along the chamfer
    assert axis[1250] > 0.6e-3
    assert height[on_the_chamfer].min() > 0.028
    assert axis[3000] < 0.2e-3
    assert height.min() == pytest.approx(runs.BOTTOMED_HEIGHT, abs=2e-5)
    assert run.touched["hole_bottom"][6400:6700].all()
    # pushed against the east wall with more than 4 N, the peg 0.2 mm off centre and no further
    assert (run.force[5050:5200, 0] > 4.0).all()
    assert run.tool[5050:5200, 0] == pytest.approx(0.2e-3, abs=30e-6)
    met = {name for name, touches in run.touched.items() if touches.any()}  # it goes all round
    assert met == {name for name in run.touched if name[:6] == "sector"} | {"hole_bottom", "peg"}
    assert height[-1] == pytest.approx(runs.HOME_HEIGHT, abs=1e-3)
    assert run.warnings == 0
