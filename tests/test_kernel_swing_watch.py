"""The watch for a late or reversed force: false alarms of honest hands, words, audit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faults.catalogue import FINGERS
from random_hands import random_motion
from swing_cases import GRIPS, alarms, taps

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.device import Motion, SimulatedDevice
from hapticbridge.guard import Limits
from hapticbridge.record import TickFlag
from hapticbridge.scene import scene_names


@pytest.mark.parametrize("name", scene_names())
def test_random_hands_are_no_alarm(name: str) -> None:
    """One hand per grip here, 20 with ``scripts/swing_report``."""
    for seed, grip in enumerate(GRIPS.values()):
        assert not alarms(name, random_motion(seed + 9), grip)


@pytest.mark.parametrize(
    ("amplitude", "grip"), [(2e-3, "firm"), (5e-3, "arm"), (1e-2, "arm"), (1e-2, "fingers")]
)
def test_taps_of_8_hz_are_no_alarm(amplitude: float, grip: str) -> None:
    assert not alarms("virtual_wall", taps(8.0, amplitude), GRIPS[grip])


@pytest.mark.parametrize("name", ["hammer", "virtual_wall", "ratchet", "peg_in_hole"])
def test_a_scenes_own_task_is_no_alarm(name: str) -> None:
    assert not alarms(name, None, None)


def test_a_firm_hand_that_shakes_as_a_late_device_does_loses_half_of_the_ratio() -> None:
    """The limit of the method: force and motion are those of a swing, 10 N and 12 mm at 8 Hz."""
    assert alarms("virtual_wall", taps(8.0, 5e-3), GRIPS["firm"]) == int(TickFlag.SWINGING)


class LateDevice:
    """A simulated device whose motors act 10 ticks after they are told."""

    def __init__(self) -> None:
        path = Motion([0.0, 0.2, 0.9, 9.0], [(x, 0.0, 0.0) for x in (0.0, 0.0, 0.181, 0.181)])
        self.inner = SimulatedDevice(path=path, hand=FINGERS, delay=10)
        self.info = replace(self.inner.info, delay=0.0)  # a data sheet that is wrong
        self.start, self.read = self.inner.start, self.inner.read
        self.write, self.close = self.inner.write, self.inner.close


def pressed(path: Path, *, is_watched: bool) -> hb.Summary:
    limits = Limits(force=10.0, torque=0.5)
    bridge = hb.Bridge(
        "virtual_wall", LateDevice(), clock=hb.SimulatedClock(), recording=path, limits=limits
    )
    if not is_watched:
        guard = replace(bridge.setup.guard, swing_energy=np.inf, runaway_speed=np.inf)
        bridge.setup = replace(bridge.setup, guard=guard)
    with bridge:
        return bridge.run(1.5)


def test_summary_and_audit_say_what_the_watch_did(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    summary = pressed(path, is_watched=True)
    sentence = summary.timekeeping.fault
    assert sentence.startswith("the force was")
    assert summary.is_certified is False
    report = audit(path)
    assert sentence in report.reason
    assert report.certified is False
    assert report.exit_code == 1
    assert report.verdict != "invalid"
    assert report.resimulation == "bit for bit"
    ticks = hb.read_recording(path).ticks
    is_on = (ticks["flags"] & int(TickFlag.SWINGING | TickFlag.RUNS_AWAY)) != 0
    first = int(np.argmax(is_on))
    assert is_on[first:].all()
    assert (np.diff(ticks["share"][first:]) <= 0.0).all()
    assert ticks["share"][-1] <= 0.5


def test_without_the_watch_nothing_is_said(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    assert not pressed(path, is_watched=False).timekeeping.fault
    assert "the force was" not in audit(path).reason
