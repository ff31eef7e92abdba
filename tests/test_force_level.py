"""One force level on both ports: no hand gets energy out, and the level holds inside a step."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from adversary import UNPAID, Attack
from audit_cases import AnsweringDevice, balance_of
from numpy.typing import NDArray

import hapticbridge as hb
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.codes import OK
from hapticbridge.run.description import parameters_of

ATTACKS = 40
"""Number of random attacks; ``scripts/attack`` makes as many as it is asked for."""


@pytest.mark.parametrize("start", range(0, ATTACKS, 20))
def test_no_hand_gets_energy_out(start: int) -> None:
    for seed in range(start, start + 20):
        attack = Attack.at_random(seed)
        energy, _, code = attack.run()
        assert code == OK
        assert energy <= UNPAID, attack


def test_no_hand_gets_energy_out_of_late_samples() -> None:
    for seed in range(1000, 1006):
        attack = Attack.at_random(seed, late=3.0)
        energy, _, _ = attack.run()
        assert energy <= UNPAID, attack


def test_hands_saturate_the_coupling() -> None:
    saturated = sum(Attack.at_random(seed).run(500)[1] for seed in range(20))
    assert saturated > 2000


@pytest.mark.parametrize(
    ("seed", "scene", "ticks"), [(52, "point_mass", 8000), (68, "peg_in_hole", 2000)]
)
def test_a_limit_on_the_device_alone_is_seen_to_fail_where_the_level_holds(
    seed: int, scene: str, ticks: int
) -> None:
    own: dict[str, Any] = {"scene": scene, "kind": 1, "presses": False, "tunes": False}
    alone = Attack.at_random(seed, is_limited_alone=True, **own).run(ticks)[0]
    level = Attack.at_random(seed, **own).run(ticks)[0]
    assert level <= UNPAID < 1e-3 < alone, (level, alone)


STRETCHING, DAMPING = 100, 2.0
"""Ticks for which a hand stretches the spring, and the damping of its device in N s/m."""


def test_at_the_level_no_slack_hides_what_a_scene_creates(tmp_path: Path) -> None:
    # the tool runs away at 1 m/s whatever the coupling does: the scene creates 1 W at 1 N
    def yielding(tick: int, force: float) -> float:  # at the speed that gets most of a held force
        return 0.1 if 0 < tick < STRETCHING else force / (2.0 * DAMPING)

    path = tmp_path / "run.mcap"
    limits = hb.Limits(force=1.0, torque=0.5, hold_force=100.0, energy=math.inf, stretch=math.inf)
    with hb.Bridge(
        "point_mass",
        AnsweringDevice(yielding, damping=DAMPING, force_limit=1.0),
        method="implicit",
        controller="off",
        limits=limits,
        clock=hb.SimulatedClock(),
        recording=path,
    ) as bridge:

        def push(tick: int) -> None:
            if tick >= STRETCHING:
                bridge.scene.data.qvel[0] = -1.0

        summary = bridge.run(1.0, on_tick=push)
    recording = hb.read_recording(path)
    ticks = recording.ticks
    moved = np.diff(ticks["device_position"][:, 0])
    work = ticks["wrench_on_device"][:-1, 0] * moved - DAMPING * moved**2 / 1e-3
    assert work.sum() > 0.05  # the hand got it
    created = ticks["environment_energy"][-1]
    # ½ (K + B'/T) ‖δx‖² would cover all of it
    whole = 0.5 * (2400.0 + 0.5 / 1e-3) * np.sum(np.diff(ticks["tool_position"][:, 0]) ** 2)
    assert 0.5 < created < whole
    # that a program moved the tool past its inputs is told, and hides nothing of what was metered
    assert (summary.environment, summary.verdict) == ("active", "unverified")
    audited = balance_of(recording, parameters_of(recording.meta))[1]
    assert audited.slack[-1] < 1e-3
    assert audited.slack[-1] == pytest.approx(summary.energies["slack"], rel=1e-9)


WRENCH = """
<mujoco>
  <compiler angle="radian"/>
  <option cone="elliptic"/>
  <worldbody>
    <body>
      <joint name="nut" type="hinge" axis="0 0 1" frictionloss="0.6" armature="1e-4"
             solreffriction="0.002 1" solimpfriction="0.9999 0.9999 0.001 0.5 2"/>
      <geom type="box" size="0.08 0.01 0.004" pos="0.08 0 0" mass="0.15" contype="0"
            conaffinity="0"/>
      <site name="grip" pos="0.15 0 0"/>
    </body>
  </worldbody>
</mujoco>"""
"""A wrench of 0.15 m on a nut with 0.6 N m of friction: 4 N at the grip."""


class Circling:
    """A device that turns the wrench by 1.2 rad in 2.4 s, and has no motors for rotation."""

    info = hb.DeviceInfo(
        name="circling", axes=("x", "y", "z"), force_limit=20.0, damping=2.0, is_real=False
    )

    def __init__(self) -> None:
        self.forces: list[float] = []

    def start(self, period: float) -> NDArray[np.void]:
        self.time, self.period = 0.0, period
        sample = np.zeros(1, hb.SAMPLE_DTYPE)
        sample["quaternion"][0, 0] = 1.0
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        angle = min(0.5 * self.time, 1.2)
        sample["position"][0] = 0.15 * (math.cos(angle) - 1.0), 0.15 * math.sin(angle), 0.0
        self.time += self.period
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        self.forces.append(float(np.linalg.norm(wrench[:3])))

    def close(self) -> None:
        pass


def turned_by(device: Circling, **limits: float) -> float:
    """Returns the median force in N on the hand while the nut turns."""
    chosen = hb.Limits(force=20.0, torque=0.5, **limits)
    scene = hb.load_scene(mujoco.MjSpec.from_string(WRENCH))
    with hb.Bridge(scene, device, clock=hb.SimulatedClock(), limits=chosen) as bridge:
        bridge.run(2.2)
    return float(np.median(device.forces[500:]))


def test_a_handle_that_cannot_turn_leaves_the_wrench_its_four_newtons() -> None:
    assert turned_by(Circling()) == pytest.approx(4.0, rel=0.1)


def test_without_slip_the_coupling_that_holds_the_orientation_adds_its_torque() -> None:
    assert turned_by(Circling(), hold_torque=10.0) > 6.0


class Leaning(Circling):
    """A hand that pushes along y, 1 N more each second, on a device without motors for rotation."""

    def start(self, period: float) -> NDArray[np.void]:
        self.place = self.speed = self.answer = 0.0
        return super().start(period)

    def read(self, sample: NDArray[np.void]) -> int:
        self.time += self.period
        force = self.time + self.answer - 20.0 * self.speed
        self.speed += self.period * force / 0.3
        self.place += self.period * self.speed
        sample["position"][0, 1] = self.place
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        self.answer = float(wrench[1])


@pytest.mark.parametrize("breakaway", [0.3, 0.5])
@pytest.mark.parametrize("hold_torque", [0.005, 0.05])
def test_a_nut_breaks_away_at_its_torque_and_the_hold_torque_over_the_lever(
    breakaway: float, hold_torque: float
) -> None:
    """The wrench is gripped 0.1 m from its nut: 3.5 N as it comes, of which 0.5 N hold it."""
    needed = (breakaway + hold_torque) / 0.1
    scene = hb.load_scene("open_wrench", breakaway=breakaway)
    limits = hb.Limits(force=20.0, torque=0.5, hold_torque=hold_torque)
    with hb.Bridge(scene, Leaning(), clock=hb.SimulatedClock(), limits=limits) as bridge:
        ticks = bridge.run(needed + 0.5).ticks
        turned = bridge.latest_records(ticks)["tool_quaternion"][:, 3]
    # the jaws have 1.3 degrees of play, and the nut creeps by 0.2
    at = np.argmax(turned > math.sin(math.radians(0.8)))
    assert 1e-3 * at == pytest.approx(needed, rel=0.05)


HANGING = """
<mujoco>
  <worldbody>
    <body><freejoint/><geom type="sphere" size="0.02" mass="0.2"/><site name="grip"/></body>
  </worldbody>
</mujoco>"""


def test_the_first_tick_carries_the_weight_of_the_tool() -> None:
    weight = 0.2 * 9.81
    scene = hb.load_scene(mujoco.MjSpec.from_string(HANGING))
    with hb.Bridge(scene, Still(), clock=hb.SimulatedClock()) as bridge:
        summary = bridge.run(0.5)
        forces = bridge.latest_records(500)["wrench_on_tool"][:, 2]
    assert forces == pytest.approx(weight, rel=1e-3)
    assert summary.peak_force == pytest.approx(weight, rel=1e-3)


class Still(Circling):
    """A device that does not move."""

    def read(self, sample: NDArray[np.void]) -> int:
        return 0


def test_a_device_far_from_its_workspace_is_refused_before_force() -> None:
    device = Still()
    begin = device.start

    def astray(period: float) -> NDArray[np.void]:
        sample = begin(period)
        sample["position"][0] = 5.0, 0.0, 0.0
        return sample

    device.start = astray  # type: ignore[method-assign]
    with (
        pytest.raises(DeviceError, match=r"5 m from the middle of its workspace; it reaches 2 m"),
        hb.Bridge("point_mass", device, clock=hb.SimulatedClock()),
    ):
        pass
    assert not device.forces or max(device.forces) == 0.0


MOTOR = """<mujoco><option timestep="0.001" integrator="discrete" gravity="0 0 0"/><worldbody>
<body name="tool"><joint name="rail" type="slide" axis="1 0 0"/>
<geom size="0.01" mass="0.1"/><site name="grip"/></body></worldbody>
<actuator><motor name="pull" joint="rail" ctrllimited="false"/></actuator></mujoco>
"""
"""A motor on the tool's own joint, stronger than the force level."""


@pytest.mark.parametrize("method", ["lossless", "implicit"])
def test_a_motors_work_is_that_of_the_step_that_counted(method: str) -> None:
    scene = hb.load_scene(mujoco.MjSpec.from_string(MOTOR))
    limits = hb.Limits(force=1.0, torque=0.1, stretch=math.inf)
    clock = hb.SimulatedClock()
    with hb.Bridge(scene, Still(), clock=clock, limits=limits, method=method) as bridge:
        bridge.set_input(ctrl={"pull": 3.0})
        summary = bridge.run(0.2)
        x = bridge.latest_records(200)["tool_position"][:, 0]
    assert summary.limits_reached == ("force",)
    assert summary.energies["actuator_work"] == pytest.approx(3.0 * x[-1], rel=1e-9)
    assert summary.environment == "strict"
