"""Inputs of the scene act, are recorded, and repeat."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded
from bridge_runs import fast, still, sway

from hapticbridge.audit import audit
from hapticbridge.errors import SceneError
from hapticbridge.kernel.codes import COUPLING_ACTUATORS, HANDLE
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge

INPUTS = """<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="discrete"/>
  <worldbody>
    <body name="tool">
      <freejoint name="tool"/>
      <geom size="0.01" mass="0.1"/>
      <site name="grip"/>
    </body>
    <body name="arm" pos="0.2 0 0">
      <joint name="arm" type="slide" axis="0 0 1" stiffness="50" damping="0.5"/>
      <geom size="0.01" mass="0.2"/>
    </body>
    <body name="plate" mocap="true" pos="0.2 0 -0.05">
      <geom type="box" size="0.05 0.05 0.01" solref="0.002 1"/>
    </body>
  </worldbody>
  <actuator><motor name="lift" joint="arm"/></actuator>
</mujoco>
"""


@pytest.fixture
def inputs_scene(tmp_path: Path) -> Path:
    path = tmp_path / "inputs.xml"
    path.write_text(INPUTS)
    return path


SCRIPT: dict[int, dict[str, Any]] = {
    10: {"ctrl": {"lift": 1.0}},
    20: {"joint_force": {"arm": -0.5, "tool": [0, 0, 0.1, 0, 0, 1e-4]}},
    30: {"body_wrench": {"arm": [0, 0, 0.3, 0, 0, 0]}, "ctrl": {"lift": [0.2]}},
    40: {"mocap": {"plate": [0.2, 0, -0.03]}},
    50: {"mocap": {"plate": [0.2, 0.001, -0.035, 0.9999, 0, 0.0141, 0]}},
    60: {"body_wrench": {"arm": np.zeros(6)}},
}


def test_inputs_act_are_recorded_and_repeat_bit_for_bit(inputs_scene: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def play(bridge: Bridge, tick: int) -> None:
        if tick in SCRIPT:
            bridge.set_input(**SCRIPT[tick])

    recorded(path, inputs_scene, ScriptedDevice(sway), duration=0.1, on_tick=play)
    recording = read_recording(path)
    inputs = [event for event in recording.events if event["event"] == "input"]
    assert [event["tick"] for event in inputs] == list(SCRIPT)
    ticks = recording.ticks
    # the coupling's own share is taken out of the sum of all actuators: rounding is left
    assert np.abs(ticks["actuator_work"][:10]).max() < 1e-15
    assert abs(ticks["actuator_work"][10]) > 1e-9
    assert (ticks["external_work"][:20] == 0).all()
    assert ticks["external_work"][20] != 0
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ({"ctrl": {"lft": 1.0}}, "'lift'"),
        ({"ctrl": {COUPLING_ACTUATORS[0]: 1.0}}, "'lift'"),
        ({"ctrl": {"lift": [1.0, 2.0]}}, "1 finite"),
        ({"ctrl": {"lift": float("nan")}}, "1 finite"),
        ({"mocap": {HANDLE: [0, 0, 0]}}, "'plate'"),
        ({"mocap": {"arm": [0, 0, 0]}}, "'plate'"),
        ({"mocap": {"plate": [0, 0]}}, "3 or 7"),
        ({"mocap": {"plate": [0, 0, 0, 2, 0, 0, 0]}}, "norm 2"),
        ({"joint_force": {"hinge": 1.0}}, "'arm', 'tool'"),
        ({"joint_force": {"tool": [1.0]}}, "6 finite"),
        ({"joint_force": {"arm": float("inf")}}, "1 finite"),
        ({"body_wrench": {HANDLE: [0] * 6}}, "'arm', 'plate', 'tool'"),
        ({"body_wrench": {"world": [0] * 6}}, "'arm', 'plate', 'tool'"),
        ({"body_wrench": {"arm": [0] * 5}}, "6 finite"),
        ({"ctrl": {"lift": "fast"}}, "'fast'; it must be numbers"),
        ({"ctrl": [1.0]}, r"ctrl is \[1.0\]; it must be values by name"),
    ],
)
def test_bad_inputs_are_refused_and_change_nothing(
    inputs_scene: Path, inputs: dict[str, Any], message: str
) -> None:
    with fast(inputs_scene, ScriptedDevice(still)) as bridge:
        with pytest.raises(SceneError, match=message):
            bridge.set_input(**inputs)
        bridge.run(0.01)
        assert bridge.ledger.actuator_work == bridge.ledger.external_work == 0
