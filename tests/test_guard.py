"""Clutch, dead-man, start, rising force: the handle follows as far as the hand is given force."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, rewritten, without_model
from bridge_runs import fast
from faults.catalogue import FAULTS, PUSHER
from faults.rig import Outcome, Rig
from numpy.typing import NDArray
from report_runs import ANVIL
from waiting import until

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.clock import RealClock, SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand import guard as start_module
from hapticbridge.demand.guard import (
    Limits,
    guard_parameters_for,
    wait_until_still,
)
from hapticbridge.device.watchdog import ForceOffGuardian
from hapticbridge.errors import DeviceError, HapticBridgeError, SafetyTrip
from hapticbridge.kernel.parameters import LARGEST_TWIST, UNGUARDED, GuardParameters
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.options import Workspace

LIMIT = 10.0
NOTHING = 1e-6
"""Energy in J that a hand may be given from nothing; it is the error of the limited law."""
CLUTCH, REANCHORED = int(TickFlag.CLUTCH), int(TickFlag.REANCHORED)
DOWN, UP = 1200, 1500


def pressed(button: int, is_down: Callable[[int], bool]) -> Callable[[int, Any], int]:
    def press(tick: int, sample: NDArray[np.void]) -> int:
        sample["buttons"] = (1 << button) if is_down(tick) else 0
        return 0

    return press


def run(folder: Path, is_down: Callable[[int], bool], **options: Any) -> Outcome:
    rig = Rig(folder, options=options)
    rig.device.corrupt = pressed(3, is_down)
    return rig.run(DOWN)


def lever_error(ticks: NDArray[np.void]) -> float:
    """Returns the largest difference in J between the work at the device and at the handle."""
    device, handle = (np.diff(ticks[f"{end}_position"], axis=0) for end in ("device", "handle"))
    sent, felt = ticks["wrench_on_device"][:-1, :3], ticks["wrench_on_tool"][:-1, :3]
    has_slipped = ticks["lever"][1:] == 0.0  # the hand is away, and the coupling relaxes
    work = np.sum(sent * device + felt * handle, axis=1)
    return float(np.abs(np.cumsum(np.where(has_slipped, 0.0, work))).max())


def test_a_clutch_moves_the_device_without_the_handle_and_comes_back_within_the_fade(
    tmp_path: Path,
) -> None:
    outcome = run(tmp_path, lambda k: DOWN <= k < UP, clutch=3)
    ticks = read_recording(tmp_path / "run.mcap").ticks
    away = slice(DOWN + 25, UP)
    assert outcome.forces[DOWN - 1] > 5.0  # pressed on the wall
    assert np.ptp(ticks["handle_position"][away], axis=0).max() < 1e-4
    assert np.ptp(ticks["tool_position"][away], axis=0).max() < 1e-4  # it stays at the wall
    assert np.ptp(ticks["device_position"][DOWN:UP, 0]) > 0.01  # the hand pushes it on
    assert not outcome.forces[away].any()
    assert outcome.forces[UP] < 0.01 * LIMIT
    assert np.abs(np.diff(outcome.forces[DOWN - 1 : UP + 400])).max() < 0.1 * LIMIT
    assert (ticks["lever"][UP + 20 :] == 1.0).all()
    assert np.flatnonzero(ticks["flags"] & CLUTCH).tolist() == list(range(DOWN, UP))
    assert lever_error(ticks) < 1e-12
    assert outcome.energy <= NOTHING
    assert (outcome.report.verdict, outcome.report.resimulation) == ("passive", "bit for bit")


def test_a_dead_man_must_be_held_for_any_force(tmp_path: Path) -> None:
    outcome = run(tmp_path, lambda k: 300 <= k < DOWN, dead_man=3)
    assert not outcome.forces[:300].any()
    assert outcome.forces[DOWN - 1] > 5.0
    assert not outcome.forces[DOWN + 25 :].any()
    assert outcome.report.resimulation == "bit for bit"
    assert outcome.report.verdict == "passive"


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_a_coupling_that_is_stretched_too_far_stops_the_run(tmp_path: Path, scale: float) -> None:
    """The tool stays at the wall; the limit counts the device's motion, whatever the scale."""
    outcomes = {}
    for stretch in (3e-3, 0.2):
        limits = Limits(force=10.0, torque=0.5, ramp=0.2, stretch=stretch)
        rig = Rig(tmp_path, options={"limits": limits, "workspace": Workspace(scale=scale)})
        outcomes[stretch] = rig.run(DOWN)
        ticks = read_recording(tmp_path / "run.mcap").ticks
        distance = np.linalg.norm(ticks["handle_position"] - ticks["tool_position"], axis=1)
        limit = scale * stretch
        assert (distance[:-1] <= limit).all()
        assert (distance[-1] > limit) == (stretch == 3e-3)  # seen a tick later
    stopped = outcomes[3e-3]
    assert "farther from the handle than the stretch limit" in stopped.error
    assert "stretch limit" in stopped.report.reason
    assert stopped.last_is_zero
    assert stopped.report.resimulation == "bit for bit"
    assert not outcomes[0.2].error


@pytest.mark.parametrize("angle", [2.8, math.inf])
def test_a_coupling_that_is_turned_too_far_stops_the_run_or_slips(
    tmp_path: Path, angle: float
) -> None:
    """A tool on a rail cannot turn; at half a turn the torque would change sides."""
    scene = tmp_path / "rail.xml"
    scene.write_text(PUSHER)
    device = ScriptedDevice(lambda k: (0, 0, 0, np.cos(2e-3 * k), 0, 0, np.sin(2e-3 * k)))
    path, error = tmp_path / "run.mcap", ""
    limits = Limits(force=10.0, torque=0.5, ramp=0.0, angle=angle, energy=math.inf)
    with fast(scene, device, limits=limits, recording=path) as bridge:
        try:
            bridge.run(0.9)
        except SafetyTrip as trip:
            error = str(trip)
    ticks = read_recording(path).ticks
    torque = ticks["wrench_on_tool"][:, 5]
    assert (torque[1:] > 0).all()
    if angle == math.inf:
        assert not error
        slipped = (ticks["flags"] & REANCHORED) != 0
        assert slipped.argmax() == pytest.approx(LARGEST_TWIST / 4e-3, abs=2)
        assert slipped[slipped.argmax() :].all()
        assert torque[slipped] == pytest.approx(0.5)
        assert audit(path).resimulation == "bit for bit"
        return
    assert "turned from the handle by more than the angle limit" in error
    assert len(ticks) == pytest.approx(angle / 4e-3, abs=2)
    assert not device.writes[-1].any()
    assert "angle limit" in audit(path).reason


def test_beyond_its_reach_a_device_moves_without_handle_and_force(tmp_path: Path) -> None:
    fault = next(fault for fault in FAULTS if fault.name == "edge of the workspace")
    rows = {}
    for reach in (0.0125, 1.0):
        rig = Rig(tmp_path)
        fault.do(rig)
        rig.options["limits"] = replace(rig.options["limits"], reach=reach)
        rig.run(fault.cause)
        rows[reach] = read_recording(tmp_path / "run.mcap").ticks
    ticks, free = rows[0.0125], rows[1.0]
    is_out = np.linalg.norm(ticks["device_position"], axis=1) > 0.0125
    assert is_out.any()
    assert ((ticks["flags"] & CLUTCH) != 0).tolist() == is_out.tolist()
    begun = int(np.argmax(is_out))
    out = begun + np.arange(np.argmin(is_out[begun:]))  # the first time that it is there
    assert not ticks["wrench_on_device"][out[0] + 25 : out[-1]].any()
    assert np.ptp(ticks["handle_position"][out[25:]], axis=0).max() < 1e-4
    assert ticks["flags"][out[-1] + 1] & REANCHORED
    assert np.linalg.norm(ticks["wrench_on_device"][out[-1] + 1, :3]) < 0.01 * LIMIT
    # without an edge the same hand presses on
    assert not (free["flags"] & CLUTCH).any()
    assert np.linalg.norm(free["wrench_on_device"][out, :3], axis=1).max() > 5.0


@pytest.mark.parametrize("is_resumed", [False, True])
def test_a_hand_that_moves_while_it_gets_no_force_finds_the_coupling_unstretched(
    is_resumed: bool,
) -> None:
    """By the first tick, or during a pause, it goes 50 mm."""
    away = False
    device = ScriptedDevice(lambda _k: (0.05 * away, 0, 0, 1, 0, 0, 0))
    with fast("point_mass", device) as bridge:
        if is_resumed:
            bridge.run(0.01)
        away = True
        bridge.run(0.01)
        rows = bridge.latest_records(10)
    assert rows["flags"][0] & REANCHORED
    assert np.abs(rows["wrench_on_tool"][:, :3]).max() < 1e-9


@pytest.mark.parametrize(("silent", "is_refused"), [(200, False), (0, True)])
def test_a_device_catches_up_after_a_silence_and_jumps_at_no_other_time(
    silent: int, is_refused: bool
) -> None:
    begin = 100

    def pose(tick: int) -> tuple[float, ...]:
        """Device at 0.1 m/s whose link is silent, then gives what waited in it, then the newest."""
        waited = begin if tick == begin + silent else tick
        jump = 0.02 if tick > begin + silent else 0.0
        return (1e-4 * waited + jump, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

    link = ScriptedDevice(pose, is_stale=lambda tick: begin <= tick < begin + silent)
    with hb.Bridge("point_mass", link, clock=hb.SimulatedClock()) as bridge:
        if is_refused:
            with pytest.raises(hb.SafetyTrip, match="jumped farther") as stopped:
                bridge.run(0.5)
            (remedy,) = stopped.value.__notes__
            assert remedy.startswith("check the unit (m)")
        else:
            assert bridge.run(0.5).ticks == 500
            after = bridge.latest_records(500)[begin + silent : begin + silent + 10]
            assert (
                np.linalg.norm(after["wrench_on_device"], axis=1).max() < 1.0
            )  # 5 N at once without a lever


class Moving:
    """A device with motors that moves for a while, and says where only after it was written to."""

    def __init__(self, still_after: int) -> None:
        self.info = replace(ScriptedDevice(lambda _k: (0,) * 7).info, is_real=True)
        self.count, self._still_after = 0, still_after
        self.times: list[float] = []
        self._is_asked = True
        self.forces: list[NDArray[np.float64]] = []

    def read(self, sample: NDArray[np.void]) -> int:
        assert self._is_asked, "nobody asked since the last answer"
        self._is_asked = False
        self.count += 1
        self.times.append(time.monotonic())
        sample["position"][0, 0] = 2e-3 * min(self.count, self._still_after)
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        self._is_asked = True
        self.forces.append(wrench.copy())


def test_force_waits_until_the_device_is_still(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(start_module, "STILL_TIME", 0.02)
    device: Any = Moving(still_after=30)
    wait_until_still(device, np.zeros(1, SAMPLE_DTYPE), 1e-3, RealClock())
    assert device.count > 30
    assert device.times[-1] - device.times[29] > 0.015  # still for that long, not just once
    assert not np.any(device.forces)
    unread: Any = Moving(still_after=30)
    wait_until_still(unread, np.zeros(1, SAMPLE_DTYPE), 1e-3, SimulatedClock())
    assert unread.count == 0
    monkeypatch.setattr(start_module, "PATIENCE", 0.05)
    restless: Any = Moving(still_after=10**6)
    with pytest.raises(DeviceError, match="hold it still"):
        wait_until_still(restless, np.zeros(1, SAMPLE_DTYPE), 1e-3, RealClock())


@pytest.mark.parametrize("is_stopped", [True, False])
def test_a_run_that_is_told_to_end_does_not_wait_for_rest(
    monkeypatch: pytest.MonkeyPatch, is_stopped: bool
) -> None:
    monkeypatch.setattr(start_module, "PATIENCE", 0.2)
    seen: list[int] = []

    def moving(tick: int) -> tuple[float, ...]:
        seen.append(tick)
        if is_stopped and tick == 20:
            os.kill(os.getpid(), signal.SIGINT)
        return (2e-3 * tick, 0, 0, 1, 0, 0, 0)

    device = ScriptedDevice(moving)
    device.info = replace(device.info, is_real=True)
    with Bridge("point_mass", device, realtime=False) as bridge:
        if is_stopped:
            summary = bridge.run(0.01)
            assert (summary.stopped_by, summary.ticks) == ("signal", 0)
            assert max(seen) < 100
        else:
            with pytest.raises(SafetyTrip, match="hold it still"):
                bridge.run(0.01)
    assert not np.any(device.writes)


@pytest.mark.parametrize(("strays_to", "is_refused"), [(0.004, False), (0.05, True)])
def test_an_absolute_device_that_strayed_while_rest_was_waited_for_is_refused(
    monkeypatch: pytest.MonkeyPatch, strays_to: float, is_refused: bool
) -> None:
    """At 2400 N/m the device's 10 N are reached 4.17 mm from the grip."""
    monkeypatch.setattr(start_module, "STILL_TIME", 0.005)
    device = ScriptedDevice(lambda tick: (strays_to if tick else 0.0, 0, 0, 1, 0, 0, 0))
    device.info = replace(device.info, is_real=True)
    with Bridge("point_mass", device, workspace=Workspace(absolute=True), realtime=False) as bridge:
        if not is_refused:
            bridge.run(0.01)
            return
        with pytest.raises(SafetyTrip, match="absolute pose puts the handle 50 mm from the grip"):
            bridge.run(0.01)
    assert not np.any(device.writes)


def test_a_guard_reads_back_as_it_was_written() -> None:
    info = ScriptedDevice(lambda _k: (0,) * 7).info
    guarding = guard_parameters_for(info, Limits(force=10.0, torque=0.5), 1e-3)
    guarding = replace(guarding, clutch=0b100)
    assert GuardParameters.from_json(guarding.to_json()) == guarding
    assert GuardParameters.from_json(UNGUARDED.to_json()) == UNGUARDED
    for text in ("", "{}", "[1]", guarding.to_json().replace("0.05", '"x"')):
        with pytest.raises(HapticBridgeError, match="guard"):
            GuardParameters.from_json(text)


KILLED = """
import os, sys, time
from hapticbridge.device.watchdog import ForceOffGuardian
word = ForceOffGuardian(sys.argv[1], b"\\0zero", b"\\1off")
if sys.argv[2:] and (holder := os.fork()) == 0:
    time.sleep(60)  # as a worker of multiprocessing: it holds all that the bridge had open
    os._exit(0)
print("ready", holder if sys.argv[2:] else 0, flush=True)
time.sleep(60)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX processes")
@pytest.mark.parametrize("has_forked", [False, True])
def test_a_killed_process_still_says_zero_and_one_that_closed_does_not(
    tmp_path: Path, has_forked: bool
) -> None:
    node, quiet = tmp_path / "hidraw", tmp_path / "closed"
    node.touch()
    quiet.touch()
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(node), *["fork"] * has_forked],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    ready, holder = process.stdout.readline().split()
    assert ready == "ready"
    assert node.read_bytes() == b""
    process.send_signal(signal.SIGKILL)
    process.wait()
    until(lambda: node.read_bytes() == 3 * b"\0zero\1off")
    if has_forked:
        os.kill(int(holder), signal.SIGKILL)
    process.stdout.close()
    word = ForceOffGuardian(str(quiet), b"\0zero")
    word.close()
    word.close()
    assert quiet.read_bytes() == b""


T, RAMP = 1e-3, 500
K, B_DEVICE = 2000.0, 2.0

Pose = Callable[[int], tuple[float, ...]]


def rubbed(amplitude: float, speed: float) -> Pose:
    """To and fro against a tool that stays: a hand that begins before the force is there."""
    return lambda k: (amplitude * math.sin(speed * T * k), 0, 0, 1, 0, 0, 0)


def turned(tick: int) -> tuple[float, ...]:
    half = 0.5 * math.sin(5.0 * T * tick)  # 1 rad: far beyond 0.5 N m
    return (0, 0, 0, math.cos(half), math.sin(half), 0, 0)


@pytest.mark.parametrize("pose", [rubbed(0.04, 5.0), rubbed(0.04, 10.0), rubbed(0.02, 5.0), turned])
def test_a_hand_is_given_nothing_while_the_force_rises(tmp_path: Path, pose: Pose) -> None:
    scene, path = tmp_path / "anvil.xml", tmp_path / "run.mcap"
    scene.write_text(ANVIL)
    device = ScriptedDevice(pose, damping=B_DEVICE)
    limits = Limits(force=10.0, torque=0.5, ramp=RAMP * T)
    with fast(
        scene, device, coupling=Coupling(K, 0.9, 2.0, 5e-4), limits=limits, recording=path
    ) as bridge:
        bridge.run(1.5)
    recording = read_recording(path)
    ticks = recording.ticks
    share = np.minimum(np.arange(1, len(ticks) + 1) / (RAMP + 1), 1.0)
    np.testing.assert_allclose(ticks["lever"], share, atol=1e-12)
    # by itself: work of what was sent until the next sample, less what the damper burns meanwhile
    moved = np.diff(ticks["device_position"], axis=0)
    turn = np.diff(2 * np.arcsin(ticks["device_quaternion"][:, 1]))
    sent = ticks["wrench_on_device"][:-1]
    given = np.sum((sent[:, :3] - B_DEVICE / T * moved) * moved, axis=1) + sent[:, 3] * turn
    assert np.cumsum(given).max() <= NOTHING
    assert lever_error(ticks) < 1e-12
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    # from the records alone too: the second computation knows how the force rises
    assert audit(rewritten(without_model(recording), tmp_path / "b.mcap")).verdict == "unverified"
