"""A recorder that is started in mid-run does not make the guard forget what it has counted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded, rewritten, without_model

from hapticbridge.audit import audit
from hapticbridge.bridge import Bridge
from hapticbridge.commands import Command, Record, Switch
from hapticbridge.coupling import Coupling
from hapticbridge.errors import HapticBridgeError, SafetyTrip
from hapticbridge.guard import USUAL_ENERGY, Limits
from hapticbridge.kernel.counts import Counts
from hapticbridge.kernel.layout import STATE_DTYPE
from hapticbridge.recording import read_recording

T = 1e-3

MOTOR = """<mujoco><compiler angle="radian"/>
<option timestep="0.001" integrator="discrete" gravity="0 0 0" cone="elliptic"/>
<worldbody>
  <body name="tool"><joint name="rail" type="slide" axis="1 0 0" damping="1"/>
    <geom type="sphere" size="0.01" mass="0.05"/><site name="grip"/></body>
</worldbody>
<actuator><motor name="push" joint="rail" ctrlrange="-40 40"/></actuator>
<keyframe><key name="home" qpos="0" ctrl="2"/></keyframe></mujoco>
"""
"""A motor in the scene that pushes the tool, and with it the hand, with 2 N."""

CYCLE, WAY = 2600, 0.015
FORWARD, CLUTCHED, BACK = (300, 600), (650, 1050), (700, 1000)

COUPLING = Coupling(2000.0, 0.5, 2.0, 5e-4)


def pushed(tick: int) -> tuple[float, ...]:
    """Goes 15 mm with the push, and back without the handle: 29 mJ a cycle."""
    k = tick % CYCLE
    gone = np.clip((k - FORWARD[0]) / (FORWARD[1] - FORWARD[0]), 0, 1)
    back = np.clip((k - BACK[0]) / (BACK[1] - BACK[0]), 0, 1)
    return (WAY * float(gone - back), 0, 0, 1, 0, 0, 0)


def cycle(at: int) -> dict[int, Command]:
    return {
        at + CLUTCHED[0]: Switch(clutch=True),
        at + CLUTCHED[1]: Switch(clutch=False),
        at + 1150: Record(on=False),
        at + 2200: Record(on=True),
    }


class Run:
    """Goes through cycles, with a recorder started anew in each, and meters the device."""

    def __init__(
        self, folder: Path, *, energy: float = USUAL_ENERGY, is_alone: bool = False, **options: Any
    ) -> None:
        (folder / "motor.xml").write_text(MOTOR)
        self.commands = cycle(0) | cycle(CYCLE) | cycle(2 * CYCLE)
        if is_alone:
            self.commands = {k: c for k, c in self.commands.items() if isinstance(c, Switch)}
        self.kicked: list[float] = []
        self.tripped = ""
        limits = Limits(force=10.0, torque=0.5, ramp=0.05, energy=energy)
        try:
            recorded(
                folder / "run.mcap",
                folder / "motor.xml",
                ScriptedDevice(pushed, damping=options.pop("damping", 2.0)),
                COUPLING,
                duration=3 * CYCLE * T,
                on_tick=self,
                limits=limits,
                **options,
            )
        except SafetyTrip as trip:
            self.tripped = str(trip)

    def __call__(self, bridge: Bridge, _: int) -> None:
        done = len(self.kicked)
        bridge._commands._now = lambda: done * T
        if done in self.commands:
            bridge.command(self.commands[done])
        self.kicked.append(float(bridge._binding.state["kicked"][0]))


def test_the_energy_limit_counts_on_over_a_recorder_that_starts(tmp_path: Path) -> None:
    run = Run(tmp_path)
    # 29 mJ in the first cycle, so the limit of 40 mJ is reached in the second
    assert "more energy beyond what the hand put in" in run.tripped
    assert CYCLE + FORWARD[0] < len(run.kicked) < CYCLE + FORWARD[1]
    assert max(run.kicked[:CYCLE]) == pytest.approx(2.0 * WAY, rel=0.1)
    second = tmp_path / "run-2.mcap"
    report = audit(second)
    assert report.verdict != "invalid", report.reason
    assert report.resimulation == "bit for bit"
    assert "energy" in report.reason


def test_a_guard_that_forgets_lets_three_limits_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other side: what the counts are kept for."""
    monkeypatch.setattr("hapticbridge.commanded.Counts.of", lambda _state: None)
    run = Run(tmp_path)
    assert not run.tripped
    assert len(run.kicked) >= 3 * CYCLE  # a pause asks twice before one tick
    assert 3 * max(run.kicked) > 2 * USUAL_ENERGY


def test_what_is_counted_is_what_a_run_without_recorders_counts(tmp_path: Path) -> None:
    run, alone = Run(tmp_path, energy=1.0), Run(tmp_path, energy=1.0, is_alone=True)
    assert len(run.kicked) > len(alone.kicked) == 3 * CYCLE
    # the force fades for a recorder while nothing moves, and is there again before anything does
    assert max(run.kicked) == pytest.approx(max(alone.kicked), rel=0.02)
    assert max(run.kicked) > 1.9 * USUAL_ENERGY


@pytest.mark.parametrize("controller", ["damper", "environment", "tank"])
@pytest.mark.parametrize("is_blind", [False, True])
def test_counts_that_were_changed_are_found(
    tmp_path: Path, controller: str, is_blind: bool
) -> None:
    Run(tmp_path, energy=1.0, controller=controller, damping=2.0)
    recording = read_recording(tmp_path / "run-2.mcap")
    counts = json.loads(recording.meta["counts"])
    assert counts["given"] > 0.02
    changes: dict[str, Any] = {"axes": [1.0] * 6, "account": 1.0}
    if controller == "environment":
        changes = {"axes": [1.0] * 6, "excess": 1.0}
    whole = without_model(recording) if is_blind else recording
    changed = tmp_path / "changed.mcap"
    assert audit(rewritten(whole, changed)).verdict != "invalid"
    lies = [changes]
    if not is_blind:  # what only a re-simulation can tell
        lies += [{"given": 1.1}, {"stored": counts["stored"] + 1e-3}]
    for lie in lies:
        told = {"counts": json.dumps(counts | lie)}
        assert audit(rewritten(whole, changed, meta=told)).verdict == "invalid", lie


COUNTS = Counts(given=0.1, stored=-0.2, account=1e-3, axes=(1e-3,) * 6, excess=-1e-4, unfelt=0.3)


def test_all_that_was_counted_is_put_and_read_again() -> None:
    state = np.zeros(1, STATE_DTYPE)
    COUNTS.put(state)
    assert Counts.of(state) == COUNTS


def test_what_are_no_counts_is_refused() -> None:
    counts = COUNTS
    assert Counts.from_json(counts.to_json()) == counts
    plain = json.loads(counts.to_json())
    wrong = [{"given": "x"}, {"axes": [0.0] * 5}, {"excess": None}, {"account": True}, {"new": 0}]
    texts = ["", "1", "[]", *(json.dumps(plain | change) for change in wrong)]
    for text in (*texts, counts.to_json().replace("0.1", "NaN")):
        with pytest.raises(HapticBridgeError, match="counts"):
            Counts.from_json(text)
