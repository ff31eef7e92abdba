"""Scenes for two hands: nut and spanner, plug and socket, on their own hand paths."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import hapticbridge as hb
from hapticbridge.cli.main import main
from hapticbridge.scene import scene_names

Array = NDArray[np.float64]


class TwoHands(NamedTuple):
    """Run of a scene: the records of each hand, and joints and bodies before each tick.

    Bodies are positions in m and rotation matrices, (n, body, 12).
    """

    hands: tuple[NDArray[np.void], NDArray[np.void]]
    joints: Array
    bodies: Array


def run_of(name: str, folder: Path, joints: tuple[str, ...], bodies: tuple[str, ...]) -> TwoHands:
    """Runs a scene with simulated hands that follow its own paths; its audit must be clean."""
    path, seen, poses = folder / "run.mcap", [], []
    scene = hb.load_scene(name)
    hands = [hb.Grasp(grip) for grip in (scene.grip, *scene.other_grips)]

    def look(_: int) -> None:
        seen.append([float(scene.data.joint(each).qpos[0]) for each in joints])
        of = [scene.data.body(each) for each in bodies]
        poses.append([[*each.xpos, *each.xmat] for each in of])

    with hb.Bridge(scene, hands, clock=hb.SimulatedClock(), recording=path) as bridge:
        bridge.run(on_tick=look)
    report = hb.audit(path, in_process=True)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert report.environment == "strict"
    ticks = tuple(hb.read_recording(path, hand=each).ticks for each in (0, 1))
    return TwoHands((ticks[0], ticks[1]), np.array(seen), np.array(poses))


def moment(ticks: NDArray[np.void]) -> Array:
    """Returns the moment of a hand's wrench on its tool about the origin of the world, (n, 3)."""
    arm, wrench = ticks["tool_position"], ticks["wrench_on_tool"]
    return np.asarray(np.cross(arm, wrench[:, :3]) + wrench[:, 3:])


@pytest.fixture(scope="module")
def nut(tmp_path_factory: pytest.TempPathFactory) -> TwoHands:
    folder = tmp_path_factory.mktemp("nut")
    return run_of("nut_and_wrench", folder, ("turn", "advance"), ("screw", "spanner"))


@pytest.fixture(scope="module")
def plug(tmp_path_factory: pytest.TempPathFactory) -> TwoHands:
    folder = tmp_path_factory.mktemp("plug")
    return run_of("plug_and_socket", folder, ("ball",), ("connector", "housing"))


def test_two_strokes_turn_the_nut_by_a_third_of_a_turn(nut: TwoHands) -> None:
    turned = np.degrees(nut.joints[:, 0])
    assert turned[2000] == pytest.approx(60.0, abs=1.5)
    # lifted off and turned back, the spanner leaves the nut where it is
    assert np.ptp(turned[2000:3700]) < 0.1
    assert turned[-1] == pytest.approx(120.0, abs=2.0)


def test_the_nut_advances_along_its_thread(nut: TwoHands) -> None:
    turn, advance = nut.joints.T
    assert advance == pytest.approx(1.5e-3 * turn / (2.0 * np.pi), abs=2e-6)


def test_what_the_spanner_turns_the_other_hand_holds(nut: TwoHands) -> None:
    turning = slice(900, 1300)
    spanner, bolt = (moment(ticks)[turning] for ticks in nut.hands)
    # the thread's friction, 0.15 N m, is all that passes from one to the other
    assert spanner[:, 2] == pytest.approx(0.15, rel=0.03)
    assert bolt[:, 2] == pytest.approx(-0.15, rel=0.03)
    # and nothing floats away: the two wrenches are in balance
    force = sum(ticks["wrench_on_tool"][turning, :3] for ticks in nut.hands)
    assert np.abs(force).max() < 0.1
    axes = Rotation.from_matrix(nut.bodies[turning, 0, 3:].reshape(-1, 3, 3))
    # K_r of the coupling, and of the hand behind it
    expected = 0.15 / 2.4 + 0.15 / 10.0
    assert axes.as_rotvec()[:, 2].mean() == pytest.approx(expected, rel=0.05)


def test_the_bolt_stays_in_its_hand(nut: TwoHands) -> None:
    assert np.abs(nut.bodies[:, 0, :3]).max() < 3e-3


def test_the_plug_seats_with_its_collar_on_the_socket(plug: TwoHands) -> None:
    height = plug.bodies[:, 0, 2] - plug.bodies[:, 1, 2]
    # collar's underside at 24 mm of the plug, socket's face at 14 mm of its own
    assert height[3000:4000] == pytest.approx(-10e-3, abs=0.05e-3)
    assert height[-1] == pytest.approx(22e-3, abs=0.5e-3)


def test_the_ball_yields_and_snaps_behind_the_shoulder(plug: TwoHands) -> None:
    ball, push = plug.joints[:, 0], -plug.hands[0]["wrench_on_tool"][:, 2]
    seated = slice(3000, 4000)
    assert ball.max() == pytest.approx(0.7e-3, abs=0.15e-3)
    assert ball[seated].max() < 0.05e-3
    # the click: a peak on the way in, less under the plug's cylinder, nothing once it snapped
    way_in, under = push[1500:2100].max(), push[2200:2400].mean()
    assert way_in > 1.2 * under
    # under the plug the hand feels friction alone: 0.2 times the spring's force, ball and wall
    bent = 0.7e-3 + ball[2200:2400].mean()
    assert under == pytest.approx(2.0 * 0.2 * 2900.0 * bent, rel=0.15)
    # pulled out, the shoulder holds
    assert push[4300:5200].min() < -1.5


def test_what_one_hand_pushes_the_other_holds(plug: TwoHands) -> None:
    first, second = (ticks["wrench_on_tool"][:, 2] for ticks in plug.hands)
    slow = slice(3000, 4200)
    assert np.abs(first[slow]).max() > 0.5
    assert first[slow] == pytest.approx(-second[slow], abs=0.1)


def test_scenes_for_two_hands_are_listed_by_their_number() -> None:
    two = set(scene_names(2))
    assert two == {"nut_and_wrench", "plug_and_socket"}
    assert set(scene_names()) == two | set(scene_names(1))


@pytest.mark.parametrize("name", scene_names(2))
def test_solver_settings_are_written_in_the_file(name: str) -> None:
    model = hb.load_scene(name).model
    colliding = (model.geom_contype | model.geom_conaffinity) != 0
    assert (model.geom_solref[colliding] == [0.002, 1.0]).all()
    assert (model.geom_solimp[colliding] == [0.9, 0.95, 0.001, 0.5, 2.0]).all()
    assert all(model.geom(each).name for each in range(model.ngeom))
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE


def test_the_command_gives_each_grip_a_device(capsys: pytest.CaptureFixture[str]) -> None:
    run = ["run", "plug_and_socket", "--fast", "--duration", "0.1"]
    for more in ([], ["--hand", "socket=simulated:damping=3"]):
        assert main([*run, *more]) == 0
        printed = capsys.readouterr().out
        assert "hand at 'plug' on simulated" in printed
        assert "hand at 'socket' on simulated" in printed
    assert main([*run, "--grip", "plug"]) == 0
    assert "hand at" not in capsys.readouterr().out
    assert main(["run", "plug_and_socket", "--device", "mouse"]) == 2
    assert "name the device of each, as in --hand plug=mouse" in capsys.readouterr().err


def test_a_command_for_one_hand_says_what_to_hold(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "nut_and_wrench"]) == 2
    assert "choose one (--grip" in capsys.readouterr().err
