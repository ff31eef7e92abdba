"""Parts of an open run, each by itself."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from audit_cases import ScriptedDevice
from bridge_runs import fast, still, sway

from hapticbridge.clock import SimulatedClock
from hapticbridge.commands import Switch
from hapticbridge.errors import CommandError, HapticBridgeError, SceneError
from hapticbridge.options import BridgeOptions, RunSetup
from hapticbridge.record import SAMPLE_DTYPE
from hapticbridge.scene import load_scene
from hapticbridge.session import MarkButton, RecordOutput, Session, StopRequest


def test_the_last_request_to_stop_is_the_reason() -> None:
    stop = StopRequest()
    assert stop.take() == ("", "")
    for by in ("", "page"):
        thread = threading.Thread(target=stop.request, args=(by,))
        thread.start()
        thread.join()
    assert [by for by, _ in stop.waiting] == ["caller", "page"]
    stop.request("signal", "SIGTERM")
    assert stop.take() == ("signal", "SIGTERM")
    assert not stop.waiting


def test_a_mark_button_notes_each_press_but_not_the_first_hold() -> None:
    presses: list[int] = []
    sample = np.zeros(1, SAMPLE_DTYPE)
    button = MarkButton(0b10, sample, lambda: presses.append(int(sample["buttons"][0])))
    for held in (2, 2, 0, 3, 3, 1, 2):
        sample["buttons"] = held
        button.look()
    assert presses == [3, 2]


def test_an_output_without_readers_keeps_the_newest_records_in_its_own_memory() -> None:
    stream = RecordOutput().open_stream(1e-3, None, may_wait=True)
    assert not stream.is_read
    assert stream.recorder is None
    stream.close()


def test_a_session_runs_without_a_bridge_and_releases_what_it_holds() -> None:
    scene, device, clock = load_scene("point_mass"), ScriptedDevice(sway), SimulatedClock()
    setup = RunSetup.resolve(scene, device.info, None, BridgeOptions(), clock)
    session = Session(setup, device, clock, RecordOutput(), StopRequest())
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
    setup = RunSetup.resolve(scene, device.info, None, BridgeOptions(), clock)
    with pytest.raises(HapticBridgeError, match="stuck"):
        Session(setup, device, clock, RecordOutput(), StopRequest())
    assert device.is_closed and not device.writes
    scene.claim()


def test_a_bridge_that_is_not_open_says_how_to_open_it() -> None:
    bridge = fast("point_mass", ScriptedDevice(still))
    message = r"the bridge is not open; open it with 'with Bridge\(...\)' first"
    with pytest.raises(HapticBridgeError, match=message):
        bridge.run(0.1)
    with pytest.raises(CommandError, match=message):
        bridge.command(Switch(force=False))
    with pytest.raises(HapticBridgeError, match=message):
        bridge.summary()
