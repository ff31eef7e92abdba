"""A device that knows how far it reaches feels nothing beyond; one that does not is never cut."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice
from bridge_runs import fast

from hapticbridge.audit import audit
from hapticbridge.demand.guard import Limits
from hapticbridge.device import DeviceInfo
from hapticbridge.device.profile import SHIPPED, profile_named, profiles
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.record import TickFlag
from hapticbridge.recording import read_recording
from hapticbridge.run.options import Workspace

REACH = 0.02
HOME = 0.01
"""Position of the device along x at the start: its frame's origin is not the scene's."""


def there_and_back(tick: int) -> tuple[float, ...]:
    """From 10 mm to 30 mm along x within 0.3 s, and back."""
    return (HOME + 0.02 * math.sin(math.pi * min(tick / 600, 1.0)), 0, 0, 1, 0, 0, 0)


def device(reach: float | None) -> ScriptedDevice:
    made = ScriptedDevice(there_and_back)
    made.info = replace(made.info, reach=reach)
    return made


def clutched(path: Path, reach: float | None, asked: float | None = None, **options: Any) -> Any:
    limits = Limits(force=10.0, torque=0.5, ramp=0.05, reach=asked)
    with fast("point_mass", device(reach), recording=path, limits=limits, **options) as bridge:
        summary = bridge.run(0.7)
    ticks = read_recording(path).ticks
    is_out = np.linalg.norm(ticks["device_position"], axis=1)
    return summary, is_out, (ticks["flags"] & int(TickFlag.CLUTCH)) != 0


@pytest.mark.parametrize("scale", [0.2, 1.0, 5.0])
def test_a_device_that_knows_its_reach_is_let_go_beyond_it(tmp_path: Path, scale: float) -> None:
    """It counts the device's own metres: a scale moves the handle, not the stops."""
    path = tmp_path / "run.mcap"
    summary, distance, is_clutched = clutched(path, REACH, workspace=Workspace(scale=scale))
    assert is_clutched.tolist() == (distance > REACH).tolist()
    assert 100 < np.count_nonzero(is_clutched) < 600
    assert summary.reach == REACH
    recording = read_recording(path)
    assert json.loads(recording.meta["guard"])["reach"] == REACH
    assert DeviceInfo.from_json(recording.meta["device"]).reach == REACH
    assert audit(path).resimulation == "bit for bit"


def test_a_device_that_does_not_know_it_is_never_cut(tmp_path: Path) -> None:
    summary, distance, is_clutched = clutched(tmp_path / "run.mcap", None)
    assert distance.max() > 1.4 * REACH
    assert not is_clutched.any()
    assert summary.reach is None


@pytest.mark.parametrize(("asked", "is_cut"), [(0.015, True), (math.inf, False), (0.04, False)])
def test_who_asks_for_another_reach_gets_it(tmp_path: Path, asked: float, is_cut: bool) -> None:
    summary, distance, is_clutched = clutched(tmp_path / "run.mcap", REACH, asked)
    assert is_clutched.tolist() == (distance > asked).tolist()
    assert is_clutched.any() == is_cut
    assert summary.reach == (None if asked == math.inf else asked)


def test_a_profile_tells_a_device_its_reach() -> None:
    info = ScriptedDevice(there_and_back).info
    assert profile_named("falcon").fill(info).reach == pytest.approx(0.0867)
    assert profile_named("inverse3").fill(info).reach is None
    known = replace(info, reach=0.07)  # what the driver knows goes first
    assert profile_named("falcon").fill(known).reach == 0.07
    text = DeviceInfo.to_json(known)
    assert DeviceInfo.from_json(text) == known
    with pytest.raises(DeviceError, match=r"reach is 0 m; it must be finite and > 0"):
        replace(info, reach=0)


def test_no_shipped_reach_cuts_what_the_maker_calls_the_workspace() -> None:
    """A ball that holds the corners of the box; only where the frame begins in its middle."""
    shipped = [profile_named(name) for name, path in profiles().items() if path.parent == SHIPPED]
    told = [profile for profile in shipped if "reach" in profile.quantities]
    assert {profile.device for profile in told} == {"falcon", "forcedimension"}
    for profile in told:
        reach, box = profile.quantities["reach"].value, profile.quantities["workspace"].value
        assert isinstance(reach, float) and isinstance(box, tuple)
        assert 0 <= reach - 0.5 * math.hypot(*box) < 1e-4
