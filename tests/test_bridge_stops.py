"""Stops and delays of a run: zero force comes first, and the recording is whole."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, SlowClock, recorded
from bridge_runs import fast, still, sway
from numpy.typing import NDArray
from waiting import until

from hapticbridge.audit import audit
from hapticbridge.errors import (
    DeviceError,
    DeviceLost,
    HapticBridgeError,
    RecordingError,
    SafetyTrip,
)
from hapticbridge.kernel.record import TickFlag
from hapticbridge.recording import Recorder, Ring, read_recording
from hapticbridge.recording import recorder as stream_module
from hapticbridge.recording.writer import RecordingWriter
from hapticbridge.run.bridge import Bridge


def fail(number: int) -> None:
    if number > 60:
        raise DeviceError("unplugged")


def unplugged(tick: int) -> tuple[float, ...]:
    fail(tick + 1)
    return sway(tick)


def interfere(_bridge: Bridge, tick: int) -> None:
    if tick == 60:
        raise ZeroDivisionError("tick 60: the caller's own")


FAILURES: dict[str, tuple[dict[str, Any], str]] = {
    "pose": ({"pose": lambda k: (np.nan if k == 60 else 0, *sway(k)[1:])}, "the device's pose"),
    "read": ({"pose": unplugged}, "unplugged"),
    "write": ({"pose": sway, "on_write": fail}, "unplugged"),
    "caller": ({"pose": sway}, "the caller's own"),
}


@pytest.mark.parametrize("name", FAILURES)
def test_whatever_fails_zero_force_comes_first_and_the_recording_is_whole(
    name: str, tmp_path: Path
) -> None:
    (given, words), path = FAILURES[name], tmp_path / "run.mcap"
    device = ScriptedDevice(**given)
    act = interfere if name == "caller" else None
    with pytest.raises((SafetyTrip, ZeroDivisionError), match=f"tick 60: {words}") as caught:
        recorded(path, "point_mass", device, on_tick=act)
    assert np.linalg.norm(device.writes[59]) > 1e-3
    assert len(device.writes) > 61  # zero force was tried after the failure
    assert not any(wrench.any() for wrench in device.writes[60 + (name == "write") :])
    assert device.is_closed
    recording = read_recording(path)
    assert not recording.is_cut and not recording.problems
    report = audit(path)
    assert (report.verdict, report.ticks) == ("passive", len(recording.ticks))
    if name in ("pose", "read"):
        assert isinstance(caught.value, SafetyTrip)
        assert caught.value.records["tick"].tolist() == list(range(60))
        assert recording.ticks["tick"].tolist() == list(range(60))
        assert [event["event"] for event in recording.events] == ["start", "trip", "stop"]
        assert recording.events[1]["tick"] == 60 and words in recording.events[1]["reason"]


def test_last_second_of_records_comes_with_a_trip() -> None:
    device = ScriptedDevice(lambda k: (np.nan if k == 1500 else 0, 0, 0, 1, 0, 0, 0))
    with fast("point_mass", device) as bridge, pytest.raises(SafetyTrip) as caught:
        bridge.run(2.0)
    assert caught.value.records["tick"].tolist() == list(range(500, 1500))


def test_overruns_are_flagged_counted_and_pass_the_audit(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    clock = SlowClock({0: 2, 50: 1, 51: 7})
    summary = recorded(path, "virtual_wall", clock=clock, duration=0.1)
    assert (summary.overruns, summary.skipped) == (3, 10)
    ticks = read_recording(path).ticks
    flagged = np.flatnonzero(ticks["flags"] & TickFlag.OVERRUN)
    assert flagged.tolist() == [0, 50, 51]
    assert ticks["deadline_ns"][-1] == 100_000_000
    assert len(ticks) == 90
    assert audit(path).verdict == "passive"
    assert read_recording(path).events[-1]["overruns"] == 3
    assert read_recording(path).events[-1]["skipped"] == 10


@pytest.fixture
def rings(monkeypatch: pytest.MonkeyPatch) -> list[Ring]:
    """Rings in shared memory that a test has made."""
    made: list[Ring] = []
    shared = Ring.shared

    def kept(capacity: int) -> Ring:
        made.append(shared(capacity))
        return made[-1]

    monkeypatch.setattr(Ring, "shared", kept)
    return made


def test_full_ring_drops_rows_in_real_time_and_the_audit_calls_the_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rings: list[Ring]
) -> None:
    path = tmp_path / "run.mcap"
    monkeypatch.setattr(stream_module, "RING_SECONDS", 0.064)
    device = ScriptedDevice(sway)
    with Bridge("point_mass", device, recording=path, clock=SlowClock({})) as bridge:
        recorder = bridge.session.stream.recorder
        assert isinstance(recorder, Recorder)
        pid = recorder.pid
        os.kill(pid, signal.SIGSTOP)

        def resume(tick: int) -> None:
            if tick == 100:
                os.kill(pid, signal.SIGCONT)
                until(lambda: not rings[0].pending())

        summary = bridge.run(0.15, resume)
    assert summary.dropped == 36
    ticks = read_recording(path).ticks
    assert ticks["tick"].tolist() == [*range(64), *range(100, 150)]
    flagged = np.flatnonzero(ticks["flags"] & TickFlag.DROPPED_BEFORE)
    assert ticks["tick"][flagged].tolist() == [100]
    report = audit(path)
    assert report.verdict == "invalid"
    assert "63 is followed by 100" in report.reason


def test_full_ring_loses_nothing_in_simulated_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream_module, "RING_SECONDS", 0.008)
    summary = recorded(tmp_path / "run.mcap", "point_mass", duration=0.3)
    assert summary.dropped == 0
    assert audit(tmp_path / "run.mcap").ticks == 300


def test_no_shared_memory_is_left_whatever_happens(tmp_path: Path, rings: list[Ring]) -> None:
    recorded(tmp_path / "run.mcap", "point_mass", duration=0.01)
    assert len(rings) == 1
    device = ScriptedDevice(still)
    with pytest.raises(HapticBridgeError, match="does not exist"):
        recorded(tmp_path / "no" / "run.mcap", "point_mass", device, duration=0.01)
    assert device.is_closed
    assert not any(Path(ring.name).exists() for ring in rings if ring.name)


def test_a_run_whose_last_zero_force_cannot_be_sent_trips(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def fail(count: int) -> None:
        if count == 51:
            raise DeviceLost("unplugged")

    with pytest.raises(SafetyTrip, match="zero force could not be sent: unplugged"):
        recorded(path, "point_mass", ScriptedDevice(sway, on_write=fail), duration=0.05)
    assert len(read_recording(path).ticks) == 50


def test_what_the_device_repeats_is_flagged_and_must_be_the_same(tmp_path: Path) -> None:
    class Slow(ScriptedDevice):
        is_honest = True

        def read(self, sample: NDArray[np.void]) -> int:
            repeats, self.tick = self.tick % 3, self.tick + 1
            self.report(sample, self.tick - (repeats if self.is_honest else 0))
            return int(TickFlag.STALE_SAMPLE) if repeats else 0

    path = tmp_path / "run.mcap"
    recorded(path, "point_mass", Slow(sway), duration=0.03)
    is_stale = (read_recording(path).ticks["flags"] & TickFlag.STALE_SAMPLE) != 0
    assert is_stale.tolist() == [bool(k % 3) for k in range(30)]
    assert audit(path).verdict == "passive"
    Slow.is_honest = False
    recorded(path, "point_mass", Slow(sway), duration=0.03)
    report = audit(path)
    assert report.verdict == "invalid"
    assert "tick 1 says that the device had nothing new" in report.reason


def test_recording_is_closed_although_the_device_cannot_be(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def fail() -> None:
        raise DeviceError("stuck")

    device = ScriptedDevice(sway, on_close=fail)
    with pytest.raises(DeviceError, match="stuck"):
        recorded(path, "point_mass", device, duration=0.05)
    assert not read_recording(path).is_cut


def test_a_stop_ends_a_run_whose_recorder_stalls(tmp_path: Path) -> None:
    with fast("point_mass", recording=tmp_path / "run.mcap") as bridge:
        recorder = bridge.session.stream.recorder
        assert isinstance(recorder, Recorder)
        pid = recorder.pid
        os.kill(pid, signal.SIGSTOP)
        timer = threading.Timer(1.0, bridge.stop)
        timer.start()
        try:
            summary = bridge.run(1000.0)
        finally:
            timer.cancel()
            os.kill(pid, signal.SIGCONT)
    assert summary.stopped_by == "caller"
    assert summary.ticks < 100_000


def test_the_device_is_closed_before_the_recorder_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    usual = Recorder.close

    def noted(recorder: Recorder) -> None:
        order.append("recorder")
        usual(recorder)

    monkeypatch.setattr(Recorder, "close", noted)
    device = ScriptedDevice(sway, on_close=lambda: order.append("device"))
    recorded(tmp_path / "run.mcap", "point_mass", device, duration=0.01)
    assert order[:2] == ["device", "recorder"]
    assert not device.writes[-1].any()


def test_a_recorder_that_takes_no_record_ends_a_simulated_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("RING_PATIENCE", 0.2), ("RING_SECONDS", 0.05), ("STANDSTILL", 0.2)):
        monkeypatch.setattr(stream_module, name, value)
    device, path = ScriptedDevice(sway), tmp_path / "run.mcap"
    with (
        pytest.raises(RecordingError, match="is left to finish"),
        fast("point_mass", device, recording=path) as bridge,
    ):
        recorder = bridge.session.stream.recorder
        assert isinstance(recorder, Recorder)
        os.kill(recorder.pid, signal.SIGSTOP)
        with pytest.raises(RecordingError, match=r"has taken no record for 0\.2 s"):
            bridge.run(1000.0)
        assert not device.writes[-1].any()
    assert recorder is not None
    os.kill(recorder.pid, signal.SIGKILL)


@pytest.mark.parametrize("is_recorded_to", [True, False])
def test_a_run_that_never_began_leaves_a_file_alone_that_its_recorder_did_not_open(
    is_recorded_to: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.mcap"
    if is_recorded_to:
        other = RecordingWriter(path, {"by": "another bridge"}, (), 0)
        with pytest.raises(RecordingError, match="another bridge is recording to it"):
            recorded(path, "point_mass", duration=0.01)
        other.close()
    else:
        recorded(path, "point_mass", duration=0.01)
        before = path.read_bytes()
        stalled = [sys.executable, "-c", "input()"]
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "bufsize": 0}
        monkeypatch.setattr(
            stream_module, "recorder_process", lambda: subprocess.Popen(stalled, **pipes)
        )

        def interrupted(_recorder: Recorder) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(Recorder, "wait_until_ready", interrupted)
        with pytest.raises(KeyboardInterrupt):
            recorded(path, "point_mass", duration=0.01)
        assert path.read_bytes() == before
    assert not read_recording(path).is_cut


def test_a_run_whose_view_fails_after_the_file_was_opened_leaves_no_file(tmp_path: Path) -> None:
    class Blind:
        def start(self, *_: object) -> None:
            assert path.exists()
            raise HapticBridgeError("no page")

        def event(self, _: object) -> None: ...

        def close(self) -> None: ...

    path, device = tmp_path / "run.mcap", ScriptedDevice(still)
    bridge = fast("point_mass", device, recording=path, observer=Blind())
    with pytest.raises(HapticBridgeError, match="no page"), bridge:
        pass
    assert device.is_closed and not path.exists()
