"""Axes that a device senses without a motor: they move the tool, and are not felt."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from cli_cases import Called
from numpy.typing import NDArray

import hapticbridge as hb
from hapticbridge.cli import run as command
from hapticbridge.device import AXES, DeviceInfo
from hapticbridge.errors import SafetyTrip

PLATE = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <geom name="floor" type="box" size="0.2 0.2 0.01" pos="0 0 -0.01"/>
    <body name="plate" pos="0 0 0.02">
      <freejoint/>
      <geom type="box" size="0.05 0.01 0.005" mass="0.1"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>
"""


class Wrist:
    """A device that obeys three forces, whose hand lets itself be pumped up by turning its wrist.

    Tilted, the plate presses its end on the floor and pushes the hand up. The hand follows it up,
    turns the plate flat without effort, and goes down again. So each turn pays it work.

    Args:
        sensed: Axes that the device senses.
        lift: Height in m by which the hand goes up and down.
    """

    def __init__(self, sensed: tuple[str, ...] = AXES[3:], lift: float = 6e-3) -> None:
        self.info = DeviceInfo(
            name="wrist", axes=AXES[:3], sensed=sensed, force_limit=10.0, damping=2.0, mass=0.2,
            delay=0.0, is_real=False,
        )  # fmt: skip
        self.lift, self.energy, self.burned = lift, 0.0, 0.0

    def start(self, period: float) -> NDArray[np.void]:
        self.period, self.tick, self.force, self.before = period, 0, np.zeros(3), np.zeros(3)
        sample = np.zeros(1, hb.SAMPLE_DTYPE)
        sample["quaternion"][0] = 1.0, 0.0, 0.0, 0.0
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        phase = 2.0 * math.pi * self.tick * self.period  # a cycle a second
        begun = min(self.tick * self.period, 1.0)
        angle = 0.5 * begun * (0.5 - 0.5 * math.cos(phase))
        height = 0.5 * self.lift * begun * math.sin(phase - math.pi)
        sample["position"][0] = 0.0, 0.0, height
        turned = math.cos(0.5 * angle), 0.0, math.sin(0.5 * angle), 0.0
        sample["quaternion"][0] = turned if self.info.sensed else (1.0, 0.0, 0.0, 0.0)
        sample["buttons"][0] = 0
        place = sample["position"][0].copy()
        step = place - self.before
        self.energy += float(self.force @ step)
        self.burned += 2.0 * float(step @ step) / self.period
        self.before = place
        self.tick += 1
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        self.force = wrench[:3].copy()

    def close(self) -> None:
        self.force = np.zeros(3)


def plate(folder: Path) -> hb.Scene:
    path = folder / "plate.xml"
    path.write_text(PLATE)
    return hb.load_scene(path, grip="grip")


def test_the_tool_turns_with_the_wrist_and_no_torque_is_sent(tmp_path: Path) -> None:
    recording = tmp_path / "run.mcap"
    bridge = hb.Bridge(
        plate(tmp_path), Wrist(lift=1e-4), clock=hb.SimulatedClock(), recording=recording
    )
    with bridge:
        summary = bridge.run(0.9)
    ticks = hb.read_recording(recording).ticks
    tilt = 2.0 * np.arccos(np.clip(ticks["tool_quaternion"][:, 0], -1, 1))
    assert tilt.max() > 0.15
    assert not ticks["wrench_on_device"][:, 3:].any()
    assert np.linalg.norm(ticks["wrench_on_tool"][:, 3:], axis=1).max() > 1e-4
    report = hb.audit(recording)
    assert (report.verdict, report.resimulation, report.certified) == (
        "passive", "bit for bit", None,
    )  # fmt: skip
    assert any("rx, ry, rz: sensed without a motor" in each for each in report.conditions)
    assert summary.is_certified is None
    assert hb.DeviceInfo.from_json(hb.read_recording(recording).meta["device"]).sensed == AXES[3:]


def test_what_turning_pays_the_hand_is_bounded_by_the_energy_limit(tmp_path: Path) -> None:
    wrist = Wrist()
    with (
        hb.Bridge(plate(tmp_path), wrist, clock=hb.SimulatedClock()) as bridge,
        pytest.raises(
            SafetyTrip,
            match="more than it put in and the scene released, by more than the energy limit",
        ),
    ):
        bridge.run(60.0)
    # beyond what the device's own damping burns, in J
    assert wrist.energy - wrist.burned == pytest.approx(0.04, abs=1e-3)
    still = Wrist(sensed=())
    with hb.Bridge(plate(tmp_path), still, clock=hb.SimulatedClock()) as bridge:
        bridge.run(20.0)
    assert still.energy < 1e-3


def test_the_run_says_what_is_not_felt(
    call: Called, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(command, "device_for", lambda *_: Wrist(lift=1e-4))
    plate(tmp_path)
    code, _, err = call(
        "run", str(tmp_path / "plate.xml"), "--grip", "grip", "--fast", "--duration", "0.1"
    )
    assert code in (0, 1)
    assert "the device senses rx, ry, rz without a motor: the tool follows up to" in err
    assert "the device has no motor for" not in err
