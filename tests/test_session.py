"""Parts of an open run, each by itself."""

from __future__ import annotations

import pytest
from audit_cases import ScriptedDevice
from bridge_runs import still, sway

from hapticbridge.clock import SimulatedClock
from hapticbridge.errors import HapticBridgeError, SceneError
from hapticbridge.recording.recorder import RecordOutput
from hapticbridge.run.hands import Grasp
from hapticbridge.run.options import BridgeOptions
from hapticbridge.run.request import RunRequest
from hapticbridge.run.session import Session, StopRequest
from hapticbridge.scene import load_scene


def test_a_session_runs_without_a_bridge_and_releases_what_it_holds() -> None:
    scene, device, clock = load_scene("point_mass"), ScriptedDevice(sway), SimulatedClock()
    request = RunRequest.of(scene, [Grasp("grip")], [device.info], BridgeOptions(), clock)
    setups = request.resolve(scene, clock)
    session = Session(request, setups, device, clock, RecordOutput(), StopRequest())
    with pytest.raises(SceneError, match="in use by another bridge"):
        scene.claim()
    session.begin(0.05)
    assert (session.end, session.summary().ticks) == (50, 0)
    session.close(None)
    assert device.is_closed and not device.writes[-1].any()
    scene.claim()


def test_a_session_that_cannot_open_closes_the_device_and_frees_the_scene() -> None:
    def fail() -> None:
        raise HapticBridgeError("stuck")

    scene, clock = load_scene("point_mass"), SimulatedClock()
    device = ScriptedDevice(still)
    device.start = lambda _period: fail()  # type: ignore[method-assign,assignment,return-value]
    request = RunRequest.of(scene, [Grasp("grip")], [device.info], BridgeOptions(), clock)
    setups = request.resolve(scene, clock)
    with pytest.raises(HapticBridgeError, match="stuck"):
        Session(request, setups, device, clock, RecordOutput(), StopRequest())
    assert device.is_closed and not device.writes
    scene.claim()
