"""Scenes from outside models/, from the file to the verdict: what a user would do, and see."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import outside_scenes as outside
import pytest
from cli_cases import Called
from numpy.typing import NDArray
from outside_scenes import hand_file, scene_file
from scipy.spatial.transform import Rotation

import hapticbridge as hb
from hapticbridge.scene.rehearsal import holding_wrench, loaded_handle, static_load
from hapticbridge.scene.start import Start

Array = NDArray[np.float64]
Stops = list[tuple[float, tuple[float, float, float]]]

K = 2400.0  # of the coupling that a trajectory gets, in N/m


@dataclass
class Outcome:
    """A recorded run and its audit.

    Attributes:
        model: The scene's model.
        qpos: Positions before each tick.
        ticks: The records as they lie in the file.
        report: The audit's.
    """

    model: mujoco.MjModel
    qpos: Array
    ticks: NDArray[np.void]
    report: hb.AuditReport


def outcome(folder: Path, text: str, grip: str, stops: Stops) -> Outcome:
    path, hand = scene_file(folder, text), hand_file(folder, stops)
    scene = hb.load_scene(path, grip=grip)
    recording, qpos = folder / "run.mcap", []
    clock, device = hb.SimulatedClock(), f"trajectory:{hand}"
    with hb.Bridge(scene, device, clock=clock, recording=recording) as bridge:
        summary = bridge.run(on_tick=lambda _tick: qpos.append(scene.data.qpos.copy()))
    assert summary.ticks == round(sum(seconds for seconds, _ in stops) * 1000) + 1
    report = hb.audit(recording)
    assert report.resimulation == "bit for bit", report.reason
    assert report.verdict == "passive", report.reason
    assert report.environment == summary.environment
    assert report.certified is None
    return Outcome(scene.model, np.array(qpos), hb.read_recording(recording).ticks, report)


@pytest.fixture(scope="module")
def pointer(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    one, other, home = (-0.05, 0.03, 0.02), (-0.02, -0.05, 0.05), (0.0, 0.0, 0.0)
    stops = [*[(0.5, one)] * 2, *[(0.5, other)] * 2, (0.8, home), (0.2, home)]
    return outcome(tmp_path_factory.mktemp("pointer"), outside.BALL_JOINT_TOOL, "tip", stops)


@pytest.fixture(scope="module")
def pin(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    depth, beyond = -(outside.PIN_GAP + 0.005), -(outside.PIN_GAP + outside.PIN_DEPTH + 0.003)
    heights = (0.8, depth), (0.6, depth), (0.8, 0.0), (0.8, beyond), (0.4, beyond)
    stops = [(seconds, (0.0, 0.0, height)) for seconds, height in heights]
    return outcome(tmp_path_factory.mktemp("pin"), outside.SPRING_PIN, "stylus", stops)


@pytest.fixture(scope="module")
def drawer(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    half, wide, shut = (0.1, 0.0, 0.0), (0.125, 0.004, -0.002), (-0.005, 0.0, 0.0)
    stops = [(1.0, half), (0.4, half), (0.8, wide), (0.4, wide), (0.8, shut)]
    return outcome(tmp_path_factory.mktemp("drawer"), outside.DRAWER, "knob", stops)


def test_tool_on_ball_joint_is_strict_and_its_moments_about_joint_balance(pointer: Outcome) -> None:
    assert pointer.report.environment == "strict"
    data = mujoco.MjData(pointer.model)
    for tick in (980, 1980, 2980):
        row = pointer.ticks[tick]
        data.qpos[:] = pointer.qpos[tick]
        mujoco.mj_forward(pointer.model, data)
        weights = -9.81 * np.outer(pointer.model.body_mass[1:3], [0, 0, 1])
        weight = np.cross(data.xipos[1:3] - outside.SHOULDER, weights).sum(axis=0)
        wrench = row["wrench_on_tool"]
        hand = np.cross(row["tool_position"] - outside.SHOULDER, wrench[:3]) + wrench[3:]
        # all but at rest after 0.4 s of damping; the moments themselves are 0.1 N m
        assert np.linalg.norm(weight) > 0.05
        assert hand + weight == pytest.approx(np.zeros(3), abs=1e-3)


def test_tip_on_a_ball_joint_follows_the_hand_as_far_as_its_links_reach(pointer: Outcome) -> None:
    ticks = pointer.ticks
    assert np.ptp(ticks["handle_position"], axis=0) == pytest.approx([0.05, 0.08, 0.05], abs=1e-9)
    gap = np.linalg.norm(ticks["tool_position"] - ticks["handle_position"], axis=1)
    assert gap.max() < 0.01
    force = np.linalg.norm(ticks["wrench_on_tool"][:, :3], axis=1)
    assert force.max() < K * 0.01
    # the links keep their lengths: the elbow stays 0.15 m from the shoulder
    elbow = ticks["tool_position"] - 0.08 * down(ticks)
    assert np.linalg.norm(elbow - outside.SHOULDER, axis=1) == pytest.approx(0.15, abs=1e-9)


def down(ticks: NDArray[np.void]) -> Array:
    """Direction of the beak; the grip's own frame is turned by 30 degrees against it."""
    grip = Rotation.from_quat(ticks["tool_quaternion"], scalar_first=True)
    beak = grip * Rotation.from_euler("y", 30, degrees=True).inv()
    return np.asarray(beak.apply([0, 0, -1]))


def test_pin_gives_way_by_what_its_spring_says_and_comes_back(pin: Outcome) -> None:
    travel = pin.qpos[:, 0]
    # the upper stop is soft: it holds the preload 13 µm further up
    assert np.abs(travel[:300]).max() < 50e-6
    assert pin.ticks["contacts"][:300].max() == 0
    pressed = 1390
    force = -pin.ticks["wrench_on_tool"][pressed, 2]
    # spring at rest: preload + k · travel, and the coupling's own stretch of force / K
    spring = outside.PIN_PRELOAD - outside.PIN_STIFFNESS * travel[pressed]
    assert force == pytest.approx(spring, rel=1e-4)
    # beyond that, the contact of so light a pin gives way by 36 µm
    assert -travel[pressed] == pytest.approx(0.005 - force / K, abs=60e-6)
    assert travel[2100] == pytest.approx(0.0, abs=60e-6)
    assert pin.ticks["contacts"][2190] == 0
    # pushed beyond its stop it holds the hand: contact, spring and stop carry 3 mm · K
    assert travel[-1] == pytest.approx(-outside.PIN_DEPTH, abs=0.2e-3)
    last = pin.ticks[-1]
    assert -last["wrench_on_tool"][2] == pytest.approx(0.003 * K, rel=0.15)


def test_pin_run_stays_within_slack_and_meters_the_springs_energy(pin: Outcome) -> None:
    assert pin.report.environment in {"strict", "within slack"}
    assert pin.ticks["contacts"].max() >= 1
    pressed = pin.ticks[1390]
    rest = outside.PIN_PRELOAD / outside.PIN_STIFFNESS

    def stored(q: float) -> float:
        return 0.5 * outside.PIN_STIFFNESS * (rest - q) ** 2

    assert pin.ticks["potential"][0] == pytest.approx(stored(pin.qpos[1, 0]), rel=1e-9)
    assert pressed["potential"] == pytest.approx(stored(pin.qpos[1391, 0]), rel=1e-9)


def test_drawer_opens_against_its_friction_and_ends_at_its_stops(drawer: Outcome) -> None:
    assert drawer.report.environment in {"strict", "within slack"}
    opening = drawer.qpos[:, 0]
    assert opening[1390] == pytest.approx(0.1, abs=outside.DRAWER_FRICTION / K + 1e-5)
    force = drawer.ticks["wrench_on_tool"]
    # in mid-motion, without acceleration; frictionloss is soft by a few per cent
    assert force[500, 0] == pytest.approx(outside.DRAWER_FRICTION, rel=0.05)
    assert opening[2590] == pytest.approx(outside.DRAWER_LENGTH, abs=50e-6)
    stretched = [0.005 * K, 0.004 * K, -0.002 * K, 0, 0, 0]
    assert force[2590] == pytest.approx(stretched, rel=0.01, abs=1e-9)
    assert opening[-1] == pytest.approx(0.0, abs=3e-3)
    assert opening.max() < outside.DRAWER_LENGTH + 50e-6


def test_work_on_the_drawer_is_its_friction_times_its_way(drawer: Outcome) -> None:
    way = np.abs(np.diff(drawer.qpos[:, 0])).sum()
    assert way > 0.22
    last = drawer.ticks[-1]
    assert last["coupling_work"] == pytest.approx(outside.DRAWER_FRICTION * way, rel=0.03)
    assert last["external_work"] == last["actuator_work"] == 0


def test_handle_starts_in_the_frame_of_a_turned_grip(pointer: Outcome, drawer: Outcome) -> None:
    for run, grip in ((pointer, "tip"), (drawer, "knob")):
        data = mujoco.MjData(run.model)
        mujoco.mj_forward(run.model, data)
        quaternion = data.site_xquat[run.model.site(grip).id]
        first = run.ticks[0]
        # the handle stands where the coupling carries the tool, which does not fall
        offset = first["handle_position"] - data.site(grip).xpos
        assert first["wrench_on_tool"][:3] == pytest.approx(K * offset, abs=2e-4)
        assert first["tool_position"] == pytest.approx(data.site(grip).xpos, abs=1e-7)
        assert first["tool_quaternion"] == pytest.approx(quaternion, abs=1e-6)


def test_command_runs_scene(tmp_path: Path, call: Called, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "Meine Szenen – größer"
    scene_file(folder, outside.DRAWER, "Schublade 1.xml")
    hand_file(folder, [(0.3, (0.02, 0.0, 0.0))])
    monkeypatch.chdir(folder)
    how = ("--grip", "knob", "--device", "trajectory:hand.csv", "--fast", "--duration", "0.5")
    code, out, err = call("run", "Schublade 1.xml", *how, "--record", "lauf 1.mcap")
    assert (code, "passive" in out) == (0, True), err
    report, recording = hb.audit("lauf 1.mcap"), hb.read_recording("lauf 1.mcap")
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert recording.attachments["scene/Schublade 1.xml"] == outside.DRAWER.encode()


# Starts that are not at rest

BEYOND_ITS_LIMIT = """<mujoco>
  <worldbody>
    <body pos="0 0 1">
      <joint axis="0 1 0" range="-70 -30" armature="0.01" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.3"/>
      <site name="grip" pos="0.3 0 0"/>
    </body>
  </worldbody>
</mujoco>"""
"""A lever that starts 30 degrees beyond a limit, with MuJoCo's default options."""


def leave_start(patch: pytest.MonkeyPatch) -> None:
    """Leaves starts as they are in the files, violated constraints included."""
    name = "hapticbridge.scene.load.start_on_constraints"
    patch.setattr(name, lambda model, is_moved: Start(None, (), ()))


def started(folder: Path, text: str, **options: Any) -> hb.Bridge:
    scene = hb.load_scene(scene_file(folder, text), as_is=options.pop("as_is", False))
    device = options.pop("device", "simulated")
    options.setdefault("recording", folder / "run.mcap")
    return hb.Bridge(scene, device, clock=hb.SimulatedClock(), **options)


def test_start_beyond_a_limit_pushes_nothing_with_rigid_limits_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_start(monkeypatch)
    with started(tmp_path, BEYOND_ITS_LIMIT) as bridge:
        offset = np.subtract(bridge.session.parameters.handle_origin, bridge.scene.grip_pose())
        bridge.run(duration=0.5)
    # the limit holds the lever's weight, and does not push
    assert np.linalg.norm(offset[:3]) * K < 0.1
    assert hb.audit(tmp_path / "run.mcap").verdict == "passive"
    with (
        started(tmp_path, BEYOND_ITS_LIMIT, contact="scene") as bridge,
        pytest.raises(hb.SafetyTrip, match=r"energy|stretch"),
    ):
        bridge.run(duration=0.5)


WEIGHT = 9.81
"""Weight in N per kg."""


@pytest.mark.parametrize(("mass", "is_carried"), [(0.9, False), (1.1, True)])
def test_tool_that_the_device_cannot_hold_is_carried(
    tmp_path: Path, mass: float, *, is_carried: bool
) -> None:
    """The simulated device holds 10 N."""
    text = outside.mjcf(body=outside.FREE_TOOL.replace('mass="0.1"', f'mass="{mass}"'))
    with started(tmp_path, text) as bridge:
        scene = bridge.scene
        bridge.run(duration=1.0)
        ticks = bridge.latest_records(1000)
    said = [change for change in scene.changes if change.startswith("weight of the tool")]
    in_hand = ticks["wrench_on_tool"][-1, 2]
    if is_carried:
        assert re.fullmatch(
            r"weight of the tool: felt → carried \(within 1 s it pulls with up to 1[01]\.\d N, "
            r"and the device holds 10 N\)",
            said[0],
        )
        assert abs(in_hand) < 0.2  # it has inertia still, and the hand moves
        model = mujoco.MjModel.from_xml_string(text)
        assert scene.model.body_mass[1] == model.body_mass[1]
    else:
        assert not said
        assert in_hand > 0.3 * WEIGHT * mass  # the hand sags and swings
    report = hb.audit(tmp_path / "run.mcap")
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    run = hb.read_recording(tmp_path / "run.mcap")
    assert json.loads(run.meta["scene_changes"])[-len(said) :] == (said or list(scene.changes))
    assert run.meta["tool_weight"] == ("carried" if is_carried else "felt")


FREE = outside.mjcf(body=outside.FREE_TOOL.replace('"0.1"', '"{}"'))

HAMMER = """<mujoco><option timestep="0.001"/><worldbody><body pos="0 0 0.2"><freejoint/>
<geom type="box" pos="0.3 0 0" size="0.015 0.015 0.04" mass="{}"/><site name="grip"/></body>
</worldbody></mujoco>"""
"""A head 0.3 m from the grip at the end of its handle, which weighs nothing."""


@pytest.mark.parametrize(
    ("mass", "dof", "is_carried"),
    [
        (0.12, 6, False),  # m g l is 0.35 N m
        (0.2, 6, True),  # 0.59 N m, but 2 N
        (0.2, 3, False),  # the head sinks until it hangs, as from any device that cannot turn
    ],
)
def test_tool_whose_torque_the_device_cannot_hold_is_carried(
    tmp_path: Path, mass: float, dof: int, *, is_carried: bool
) -> None:
    """The simulated device holds 10 N and 0.5 N m."""
    torque = mass * WEIGHT * 0.3
    with started(tmp_path, HAMMER.format(mass), device=f"simulated:dof={dof}") as bridge:
        scene, parameters = bridge.scene, bridge.session.parameters
        assert scene.is_carried == is_carried
        if torque < 0.5:  # nothing swings where the coupling carries it from the start
            force, held = holding_wrench(scene, parameters)
            assert (force, held) == pytest.approx((mass * WEIGHT, torque), rel=0.02)
        bridge.run(duration=1.0)
    if is_carried:
        words = r"within 1 s it turns with up to (\d+) mN m, and the device holds 500 mN m\)"
        found = re.search(words, scene.changes[-1])
        assert found
        assert torque < 1e-3 * float(found[1]) < 2.0 * torque  # it falls from rest
    report = hb.audit(tmp_path / "run.mcap")
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


@pytest.mark.parametrize(
    ("text", "gains", "limits", "words"),
    [
        # 0.4 kg weigh 3.92 N
        (FREE.format(0.4), {"stiffness": 25.0}, {}, ""),
        (FREE.format(0.4), {"stiffness": 15.0}, {}, "stretches .* by 26. mm, .* limit is 200 mm"),
        (FREE.format(0.4), {"stiffness": 99.0}, {"stretch": 0.03}, "by 39.. mm, .* is 30 mm"),
        # it hangs where m g l cos(a) = K_r a
        (HAMMER.format(0.1), {"rotational_stiffness": 0.5}, {}, ""),
        (HAMMER.format(0.1), {"rotational_stiffness": 0.5}, {"angle": 0.4}, "turns .* by 513 mrad"),
    ],
)
def test_tool_that_hangs_beyond_a_limit_of_the_run_is_carried(
    tmp_path: Path, text: str, gains: dict[str, float], limits: dict[str, float], words: str
) -> None:
    """It was stopped at tick 0, before the hand had moved."""
    limited = hb.Limits(**limits)
    with started(tmp_path, text, coupling=gains, limits=limited) as bridge:
        bridge.run(duration=0.05)
        said = [change for change in bridge.scene.changes if change.startswith("weight of")]
    assert bool(said) == bool(words)
    assert re.search(words, "".join(said))


def test_motor_that_turns_the_tool_is_not_taken_for_its_weight(tmp_path: Path) -> None:
    text = """<mujoco><option timestep="0.001"/><worldbody><body><joint name="j" axis="0 0 1"/>
    <geom size="0.02" mass="0.1"/><site name="grip"/></body></worldbody>
    <actuator><motor joint="j"/></actuator>
    <keyframe><key name="home" ctrl="0.6"/></keyframe></mujoco>"""
    with started(tmp_path, text) as bridge:
        assert holding_wrench(bridge.scene, bridge.session.parameters)[1] > 0.5
        assert not bridge.scene.is_carried


def test_weight_is_carried_on_request_and_not_as_is(tmp_path: Path) -> None:
    with started(tmp_path, outside.mjcf(), tool_weight=False) as bridge:
        bridge.run(duration=0.1)
        assert bridge.scene.changes[-1].endswith("(--no-tool-weight)")
        assert abs(bridge.latest_records(1)["wrench_on_tool"][0, 2]) < 0.02
    heavy = outside.mjcf(body=outside.FREE_TOOL.replace('mass="0.1"', 'mass="1.1"'))
    with (
        pytest.raises(
            hb.SceneError, match=r"1[01]\.\d N, .* holds 10 N\): let its weight be carried"
        ),
        started(tmp_path, heavy, as_is=True),
    ):
        pass


LIFT = """<mujoco><worldbody><body><joint name="lift" type="slide" axis="0 0 1" damping="20" {}/>
<geom size="0.02" mass="{}"/><site name="grip"/></body></worldbody>
<actuator><motor joint="lift"/></actuator>
<keyframe><key name="home" ctrl="{}"/></keyframe></mujoco>"""
"""A tool that can go up and down, with a spring and a motor."""


@pytest.mark.parametrize(
    ("spring", "mass", "motor", "is_carried"),
    [
        ("", 0.6, -6.0, False),  # without the motor, the device holds the weight of 6 N
        ('stiffness="100" springref="-0.15"', 0.1, 0.0, False),  # the spring pulls with 15 N
        ("", 1.2, -2.0, True),  # the weight alone is 12 N
    ],
    ids=["motor", "spring", "weight"],
)
def test_what_is_carried_is_the_weight_not_a_push(
    tmp_path: Path, spring: str, mass: float, motor: float, *, is_carried: bool
) -> None:
    """The simulated device holds 10 N."""
    with started(tmp_path, LIFT.format(spring, mass, motor)) as bridge:
        assert bridge.scene.is_carried == is_carried


@pytest.mark.parametrize(
    ("mass", "end", "is_carried"), [(5.0, 0.6, True), (0.5, 0.6, False), (5.0, -0.6, False)]
)
def test_heavy_pole_that_topples_in_the_hand_is_carried(
    tmp_path: Path, mass: float, end: float, *, is_carried: bool
) -> None:
    """A rod of 0.6 m on a hinge, held at its middle, and its pull 0.1 m beside."""
    text = f"""<mujoco><worldbody><body><joint axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 {end}" size="0.02" mass="{mass}"/>
      <site name="grip" pos="0 0 {end / 2}"/></body></worldbody></mujoco>"""
    with started(tmp_path, text) as bridge:
        said = [change for change in bridge.scene.changes if "weight" in change]
        bridge.run(duration=2.0)
    assert bool(said) == is_carried
    if is_carried:
        reason = re.search(
            r"stands upright and topples: 0\.1 m beside, .* ([\d.]+) N, and", said[0]
        )
        assert reason
        pull = mass * WEIGHT * np.tan(np.arcsin(0.1 / 0.3))
        assert float(reason[1]) == pytest.approx(pull, rel=0.15)
        with pytest.raises(hb.SceneError, match="topples"), started(tmp_path, text, as_is=True):
            pass


def test_a_cart_that_its_motor_repels_neither_stands_upright_nor_topples(tmp_path: Path) -> None:
    """Across gravity a motor gives 200 N/m away from the middle: 20 N at 0.1 m, not by weight."""
    text = """<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>
      <geom size=".02" mass=".5"/><site name="grip"/></body></worldbody><actuator>
      <general joint="rail" biastype="affine" biasprm="0 200 0"/></actuator></mujoco>"""
    with started(tmp_path, text) as bridge:
        assert not [change for change in bridge.scene.changes if "weight" in change]


@pytest.mark.parametrize(("mass", "boulder", "is_carried"), [(0.05, 0.6, False), (2.0, 0.6, True)])
def test_a_body_that_falls_on_the_tool_is_not_the_weight_of_the_tool(
    tmp_path: Path, mass: float, boulder: float, *, is_carried: bool
) -> None:
    """A blow of far over 10 N comes to a tool whose weight is carried, too."""
    text = f"""<mujoco><worldbody><body><freejoint/><geom size=".02" mass="{mass}"/>
      <site name="grip"/></body><body pos="0 0 .3"><freejoint/>
      <geom size=".05" mass="{boulder}"/></body></worldbody></mujoco>"""
    with started(tmp_path, text) as bridge:
        assert bridge.scene.is_carried == is_carried


def test_hovering_quadrotor_does_not_topple(tmp_path: Path) -> None:
    """Thrust turns with the tool, so a tilt makes it drift, ever faster but not exponentially."""
    arms = [(0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1)]
    sites = "".join(f'<site name="r{i}" pos="{x} {y} 0"/>' for i, (x, y) in enumerate(arms))
    rotors = "".join(
        f'<motor site="r{i}" gear="0 0 1 0 0 {0.1 * (-1) ** i}"/>' for i in range(len(arms))
    )
    hover = " ".join([str(WEIGHT / len(arms))] * len(arms))
    text = f"""<mujoco><worldbody><body pos="0 0 1"><freejoint/>
      <geom type="box" size="0.1 0.1 0.02" mass="1"/><site name="grip"/>{sites}</body></worldbody>
      <actuator>{rotors}</actuator>
      <keyframe><key name="home" ctrl="{hover}"/></keyframe></mujoco>"""
    with started(tmp_path, text) as bridge:
        assert not bridge.scene.is_carried
        summary = bridge.run(duration=0.5)
    assert summary.stopped_by == "duration"
    assert summary.peak_force < 1.5


FLOPPY = """<mujoco>
  <worldbody>
    <body name="trunk" pos="0 0 1">
      <freejoint/>
      <geom size="0.1" mass="2"/>
      <body pos="0.1 0 0">
        <joint axis="0 1 0" damping="0.01"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.1"/>
        <site name="grip" pos="0.3 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""
"""A trunk that falls while the end of its leg is held."""


def test_handle_starts_at_grip_of_a_robot_that_falls_beside_it(tmp_path: Path) -> None:
    device = "simulated:force_limit=1000,torque_limit=1000"
    with started(tmp_path, FLOPPY, device=device) as bridge:
        parameters = bridge.session.parameters
        assert parameters.handle_origin == bridge.scene.grip_pose()
        load = static_load(bridge.scene, parameters)
        # when all has come to rest, the leg hangs from the grip and the trunk from the leg
        assert np.linalg.norm(load[:3]) == pytest.approx(2.1 * 9.81, rel=0.02)
        bridge.run(duration=0.05)
        # that load would throw the light end of the leg
        loaded = loaded_handle(bridge.scene.grip_pose(), load, parameters)
        assert loaded[2] - bridge.scene.grip_pose()[2] > 5e-3
        assert np.linalg.norm(bridge.latest_records(1)["wrench_on_tool"][0, :3]) < 10.0


SERVO_ARM = """<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="elbow" axis="0 1 0" damping="0.5"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="1"/>
      <site name="grip" pos="0.3 0 0"/>
    </body>
  </worldbody>
  <actuator><position name="elbow" joint="elbow" kp="200"/></actuator>
  <keyframe><key name="home" qpos="1.5"{}/></keyframe>
</mujoco>"""


def test_servo_holds_the_pose_of_a_keyframe_without_controls(tmp_path: Path) -> None:
    with started(tmp_path, SERVO_ARM.format("")) as bridge:
        bridge.run(duration=0.5)
        assert bridge.scene.changes[-1] == "ctrl of 1 servo in keyframe 'home': 0 → its pose"
        assert bridge.scene.data.qpos[0] == pytest.approx(1.5, abs=0.02)
    assert hb.audit(tmp_path / "run.mcap").verdict == "passive"
    # controls of the file, and the file as it is, stay
    for text, as_is in ((SERVO_ARM.format(' ctrl="0.1"'), False), (SERVO_ARM.format(""), True)):
        with (
            started(tmp_path, text, as_is=as_is) as bridge,
            pytest.raises(hb.SafetyTrip, match=r"energy|stretch"),
        ):
            bridge.run(duration=0.5)


# Equality constraints and limits of tendons that are in error at the start

_BAR = '<geom type="capsule" fromto="0 0 0 {}" size=".01" mass=".1" contype="0" conaffinity="0"/>'
_BALL = (
    '<body name="t" pos="0 0 .1"><freejoint/><geom size=".02" mass=".1"/><site name="grip"/></body>'
)
_STRETCHED = {
    "connect": (
        f"""<body><joint axis="0 1 0"/>{_BAR.format("0 0 .2")}
          <body pos="0 0 .2"><joint axis="0 1 0"/>{_BAR.format(".2 0 0")}
            <site name="grip" pos=".1 0 0"/>
            <body pos=".2 0 0"><joint axis="0 1 0"/>{_BAR.format("0 0 -.2")}
              <site name="a" pos=".005 0 -.2"/></body></body></body>
          <site name="b" pos=".2 0 0"/>""",
        '<equality><connect site1="a" site2="b" {0}/></equality>',
    ),
    "joint": (
        """<body pos="0 0 .1"><joint name="j" type="slide"/><geom size=".02" mass=".1"/>
             <site name="grip"/></body>
           <body pos="0 .2 .1"><joint name="k" type="slide"/><geom size=".02" mass=".3"/></body>""",
        '<equality><joint joint1="j" joint2="k" polycoef=".005 1 3 0 0" {0}/></equality>',
    ),
    "weld": (
        f'{_BALL}<body name="x" pos="0 .1 .1"><freejoint/><geom size=".02" mass=".2"/></body>',
        '<equality><weld body1="t" body2="x" relpose=".005 .1 0 1 0 0 0" {0}/></equality>',
    ),
    "limit of a tendon": (
        f'{_BALL}<site name="w" pos="0 0 .3"/>',
        """<tendon><spatial range="0 .195" {1}><site site="w"/><site site="grip"/></spatial>
           </tendon>""",
    ),
    "tendon": (
        f'{_BALL}<site name="w" pos="0 0 .3"/>',
        """<tendon><spatial name="T"><site site="w"/><site site="grip"/></spatial></tendon>
           <equality><tendon tendon1="T" polycoef="-.005 0 0 0 0" {0}/></equality>""",
    ),
}


@pytest.mark.parametrize("kind", _STRETCHED)
@pytest.mark.parametrize("solref", ["0.02 1", "-20000 -50"])
def test_error_at_the_start_creates_no_energy_with_rigid_constraints_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, solref: str
) -> None:
    leave_start(monkeypatch)
    body, constraint = _STRETCHED[kind]
    constraint = constraint.format(f'solref="{solref}"', f'solreflimit="{solref}"')
    text = f'<mujoco><option gravity="0 0 0"/><worldbody>{body}</worldbody>{constraint}</mujoco>'
    with started(tmp_path, text) as bridge:
        assert bridge.run(duration=0.5).environment == "strict"
    assert hb.audit(tmp_path / "run.mcap").resimulation == "bit for bit"
    # MuJoCo's own constraint pulls the error together, which no port pays
    for is_open in (True, False):
        with started(tmp_path, text, contact="scene", recording=None) as bridge:
            with suppress(hb.SafetyTrip):
                bridge.run(duration=0.5)
            pulled = bridge.ledger.first_active is not None
        assert pulled == is_open
        monkeypatch.undo()  # a start on its constraints has no error


def test_body_welded_to_a_moved_mocap_body_follows_and_its_mover_pays(tmp_path: Path) -> None:
    text = f"""<mujoco><worldbody><body name="m" mocap="true" pos="0 .2 .1"/>{_BALL}
      <body name="x" pos="0 .2 .1"><freejoint/><geom size=".02" mass=".2"/></body></worldbody>
      <equality><weld body1="m" body2="x"/></equality></mujoco>"""
    with started(tmp_path, text) as bridge:

        def lift(tick: int) -> None:
            if tick < 1000:
                bridge.set_input(mocap={"m": [0.0, 0.2, 0.1 + 1e-4 * tick]})

        summary = bridge.run(duration=1.2, on_tick=lift)
        assert summary.environment == "strict"
        # 0.1 m/s over the five steps in which a share of 0.2 removes an error
        assert bridge.scene.data.body("x").xpos[2] == pytest.approx(0.1999, abs=6e-4)
        weight = 0.2 * 9.81 * 0.0999
        assert bridge.ledger.external_work == pytest.approx(weight, rel=0.02)


@pytest.mark.parametrize(("solref", "solimp", "hertz"), [("0.01 1", 0.25, 9.2), ("0.02 1", 0.9, 0)])
def test_equality_meant_as_a_spring_is_announced_where_it_becomes_rigid(
    tmp_path: Path, solref: str, solimp: float, hertz: float
) -> None:
    """ω² = d/(1 − d)/(timeconst dampratio)²; MuJoCo's default is stiffer."""
    text = f"""<mujoco><worldbody><body name="m" mocap="true" pos="1 .1 .1"/>{_BALL}
      <body name="u" pos="1 0 .1"><freejoint/><geom size=".02" mass=".1"/></body></worldbody>
      <equality><weld name="spring" body1="m" body2="u" relpose="0 -.1 0 1 0 0 0"
        solref="{solref}" solimp="{solimp} {solimp} 0.001"/></equality></mujoco>"""
    with started(tmp_path, text) as bridge:
        said = [change for change in bridge.scene.changes if "equality" in change]
        bridge.run(duration=0.1)
    assert hb.audit(tmp_path / "run.mcap").resimulation == "bit for bit"
    assert len(said) == bool(hertz)
    if hertz:
        assert f"'spring': a spring of {hertz:g} Hz → rigid (--contact scene keeps it" in said[0]
        with started(tmp_path, text, contact="scene") as bridge:
            assert not any("equality" in change for change in bridge.scene.changes)


SERVO = """<mujoco><option timestep="0.001"/><worldbody><body>
<joint name="z" type="slide" axis="0 0 1"/><geom type="box" size=".02 .02 .02" mass="0.11"/>
<site name="grip"/></body></worldbody><actuator><position joint="z" kp="95"/></actuator>
<keyframe><key name="home" ctrl="-0.1"/></keyframe></mujoco>"""
"""A tool of 1.1 N that a servo pulls down with 9.5 N."""


def test_the_force_of_a_servo_is_not_taken_for_the_weight_of_the_tool(tmp_path: Path) -> None:
    with started(tmp_path, SERVO, device="simulated:force_limit=1000") as bridge:
        scene, parameters = bridge.scene, bridge.session.parameters
        limits = scene.model.actuator_forcelimited.copy()
        weight = holding_wrench(scene, parameters, has_motors=False)[0]
        assert 1.0 < weight / (0.11 * 9.81) < 2.0  # the first swing included, damped
        assert holding_wrench(scene, parameters)[0] > 10.0
        assert np.array_equal(scene.model.actuator_forcelimited, limits)


ARM = """<body name="arm" pos="0.3 0 0"><joint name="j" axis="0 0 1" damping="0.1"/>
<geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01"/></body>"""
MOTORS = """<actuator><position name="near" joint="j" kp="1" group="0"/>
<motor name="push" joint="j" group="1"/>
<motor name="high" joint="j" group="40"/></actuator>"""


@pytest.mark.parametrize(
    ("option", "active"),
    [
        ("<option gravity='0 0 0'/>", (1, 1, 1)),
        ("<option gravity='0 0 0' actuatorgroupdisable='1'/>", (1, 0, 1)),
        (
            f"<option gravity='0 0 0' actuatorgroupdisable='{' '.join(map(str, range(31)))}'/>",
            (0, 0, 1),
        ),
        ("<option gravity='0 0 0'><flag actuation='disable'/></option>", (0, 0, 0)),
    ],
)
def test_actuators_that_a_scene_disables_stay_so_and_the_hand_is_felt(
    tmp_path: Path, option: str, active: tuple[int, ...]
) -> None:
    path = scene_file(
        tmp_path, outside.mjcf(option, world=ARM).replace("</mujoco>", f"{MOTORS}</mujoco>")
    )
    scene = hb.load_scene(path)
    hand = hb.open_device(f"trajectory:{hand_file(tmp_path, [(0.5, (0.02, 0, 0))])}")
    record = tmp_path / "run.mcap"
    with hb.Bridge(scene, hand, clock=hb.SimulatedClock(), recording=record) as bridge:
        bridge.set_input(ctrl={"near": 0.3, "push": 0.01, "high": 0.02})
        bridge.run(duration=0.4)
        forces = scene.data.actuator_force[:3].copy()
        ticks = bridge.latest_records(400)
    plain = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(plain)
    data.qpos[:], data.qvel[:] = scene.data.qpos, scene.data.qvel
    data.ctrl[:] = 0.3, 0.01, 0.02
    mujoco.mj_forward(plain, data)
    assert (forces != 0.0).tolist() == [bool(each) for each in active]
    np.testing.assert_allclose(forces, data.actuator_force, atol=2e-3)
    assert ticks["tool_position"][-1, 0] - ticks["tool_position"][0, 0] > 0.01
    assert hb.audit(record).resimulation == "bit for bit"


MARGIN_WALL = """<mujoco><option timestep="0.001" gravity="0 0 -9.81">{override}</option><worldbody>
<geom name="wall" type="box" size="0.1 0.1 0.01" pos="0 0 -0.01" {wall}/>
<body name="tool" pos="0 0 0.03" gravcomp="1"><joint type="slide" axis="0 0 1"/>
<geom name="tip" type="sphere" size="0.01" mass="0.05" {tip}/><site name="grip"/></body>
<body name="block" pos="0.05 0 0.03"><freejoint/>
<geom name="block" type="box" size="0.01 0.01 0.01" mass="0.1" {tip}/></body>
</worldbody><contact>{pairs}</contact></mujoco>"""


@pytest.mark.parametrize(
    ("parts", "rest"),
    [
        ({}, 0.0),
        ({"wall": 'margin="0.005"'}, 0.005),
        ({"wall": 'margin="0.002"', "tip": 'margin="0.001"'}, 0.003),
        ({"wall": 'margin="0.002" gap="0.003"'}, 0.002),
        ({"wall": 'margin="0.002" gap="-0.001"'}, 0.002),
        (
            {
                "wall": 'margin="0.002"',
                "pairs": '<pair geom1="tip" geom2="wall" margin="0.004"/>'
                '<pair geom1="block" geom2="wall" margin="0.004"/>',
            },
            0.004,
        ),
    ],
    ids=["none", "one geom's", "the sum of two", "a gap is none", "a gap below 0", "of a pair"],
)
def test_contacts_rest_at_the_margins_of_the_file_as_in_mujoco(
    tmp_path: Path, parts: dict[str, str], rest: float
) -> None:
    text = MARGIN_WALL.format(**{"override": "", "wall": "", "tip": "", "pairs": ""} | parts)
    path = scene_file(tmp_path, text)
    stiffness, depth = 2400.0, 0.025
    hand = hb.open_device(f"trajectory:{hand_file(tmp_path, [(0.5, (0.0, 0.0, -depth))])}")
    record = tmp_path / "run.mcap"
    coupling = {"stiffness": stiffness}
    with hb.Bridge(
        hb.load_scene(path), hand, coupling, clock=hb.SimulatedClock(), recording=record
    ) as bridge:
        bridge.run(duration=1.0)
        summary, tick = bridge.summary(), bridge.latest_records(1)[0]
        block = bridge.scene.data.body("block").xpos[2]
    plain = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(plain)
    mujoco.mj_step(plain, data, 1000)
    assert tick["tool_position"][2] == pytest.approx(0.01 + rest, abs=1e-5)
    pressed = stiffness * (depth - (0.03 - 0.01 - rest))
    assert tick["wrench_on_tool"][2] == pytest.approx(-pressed, rel=0.01)
    assert block == pytest.approx(0.01 + rest, abs=1e-5)
    if 'gap="-' not in text:  # there MuJoCo lets the block fall in before it pushes
        assert block == pytest.approx(data.body("block").xpos[2], abs=2e-4)
    assert summary.environment == "strict"
    assert hb.audit(record).resimulation == "bit for bit"
