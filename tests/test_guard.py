"""Clutch, dead-man, slew, start, rising force: the handle follows only when it should."""

from __future__ import annotations

import itertools
import json
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
from audit_cases import ScriptedDevice, rewritten, verdict_of, without_model
from bridge_runs import fast
from faults.catalogue import FAULTS, PUSHER
from faults.rig import Outcome, Rig
from numpy.typing import NDArray
from report_runs import ANVIL

from hapticbridge import guard as start_module
from hapticbridge.audit import audit
from hapticbridge.bridge import Bridge
from hapticbridge.clock import RealClock, SimulatedClock
from hapticbridge.commands import Couple, Switch
from hapticbridge.coupling import Coupling
from hapticbridge.device.watchdog import ForceOffGuardian
from hapticbridge.errors import DeviceError, HapticBridgeError, SafetyTrip
from hapticbridge.guard import (
    RAMP_ENERGY,
    UNLIMITED,
    USUAL_ENERGY,
    Limits,
    guard_parameters_for,
    wait_until_still,
)
from hapticbridge.kernel.parameters import UNGUARDED, GuardParameters
from hapticbridge.options import BridgeOptions, Workspace
from hapticbridge.record import SAMPLE_DTYPE, TickFlag
from hapticbridge.recording import Recording, read_recording

LIMIT = 10.0
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


def test_a_clutch_moves_the_device_without_the_handle_and_comes_back_without_a_step(
    tmp_path: Path,
) -> None:
    outcome = run(tmp_path, lambda k: DOWN <= k < UP, clutch=3)
    ticks = read_recording(tmp_path / "run.mcap").ticks
    held = slice(DOWN, UP)
    assert outcome.forces[DOWN - 1] > 5.0  # pressed on the wall
    assert (ticks["handle_position"][held] == ticks["handle_position"][DOWN - 1]).all()
    assert np.ptp(ticks["device_position"][held, 0]) > 0.01  # the hand pushes it on
    assert not outcome.forces[DOWN + 25 : UP].any()
    assert outcome.forces[UP] < 0.01 * LIMIT
    assert np.abs(np.diff(outcome.forces[UP - 1 : UP + 400])).max() < 0.1 * LIMIT
    assert np.flatnonzero(ticks["flags"] & CLUTCH).tolist() == list(range(DOWN, UP))
    assert np.flatnonzero(ticks["flags"] & REANCHORED).tolist() == [UP]
    assert outcome.energy < 0.05
    assert (outcome.report.verdict, outcome.report.resimulation) == ("passive", "bit for bit")


def test_a_clutch_let_go_while_the_force_is_off_puts_the_handle_to_the_tool(tmp_path: Path) -> None:
    """The tool follows without force: a handle put where the device went would fling it there."""
    rig = Rig(tmp_path, options={"clutch": 3})
    rig.device.corrupt = pressed(3, lambda k: DOWN <= k < UP)
    switches = {UP - 100: Switch(force=False), UP + 300: Switch(force=True)}
    rig.on_tick = lambda bridge, k: bridge.command(switches[k]) if k in switches else None
    outcome = rig.run(DOWN)
    ticks = read_recording(tmp_path / "run.mcap").ticks
    apart = ticks["handle_position"][UP] - ticks["tool_position"][UP - 1]
    assert np.linalg.norm(apart) < 1e-4
    assert np.linalg.norm(np.ptp(ticks["device_position"][DOWN:UP], axis=0)) > 0.01
    assert not outcome.forces[UP : UP + 300].any()
    assert ticks["flags"][UP] & REANCHORED
    assert outcome.report.resimulation == "bit for bit"


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
def test_a_coupling_that_is_turned_too_far_stops_the_run(tmp_path: Path, angle: float) -> None:
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
    if angle == math.inf:
        assert not error
        assert torque.min() < -1.0 < 1.0 < torque.max()
        return
    assert "turned from the handle by more than the angle limit" in error
    assert len(ticks) == pytest.approx(angle / 4e-3, abs=2)
    assert (torque[1:] > 0).all()
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
    assert np.ptp(ticks["handle_position"][out], axis=0).max() == 0.0
    assert ticks["flags"][out[-1] + 1] & REANCHORED
    assert np.linalg.norm(ticks["wrench_on_device"][out[-1] + 1, :3]) < 0.01 * LIMIT
    # without an edge the same hand presses on
    assert not (free["flags"] & CLUTCH).any()
    assert np.linalg.norm(free["wrench_on_device"][out, :3], axis=1).max() > 5.0


@pytest.mark.parametrize("flag", [CLUTCH, REANCHORED])
def test_a_changed_flag_does_not_pass_the_audit(tmp_path: Path, flag: int) -> None:
    run(tmp_path, lambda k: DOWN <= k < UP, clutch=3)
    recording = read_recording(tmp_path / "run.mcap")
    ticks = recording.ticks.copy()
    ticks["flags"][UP] ^= flag
    report = verdict_of(recording, tmp_path, ticks=ticks)
    assert report.verdict == "invalid"
    assert "flag" in report.reason


@pytest.mark.parametrize(("rise", "share"), [(2e-3, 0.5), (0.0, 1.0), (5e-3, 0.2)])
@pytest.mark.parametrize("is_turned", [False, True])
def test_the_wrench_changes_no_faster_than_it_may(
    rise: float, share: float, is_turned: bool
) -> None:
    # a hand that goes 10 mm or turns by 0.4 rad in 2 ms: 24 N or 0.96 N m, beyond the limits
    def moved(tick: int) -> tuple[float, ...]:
        steps = min(max(tick - 49, 0), 2)
        half = 0.1 * steps
        if is_turned:
            return (0, 0, 0, math.cos(half), 0, 0, math.sin(half))
        return (0.005 * steps, 0, 0, 1, 0, 0, 0)

    device = ScriptedDevice(moved)
    limits = Limits(force=10.0, torque=0.5, ramp=0.0, slew_time=rise)
    with fast("virtual_wall", device, limits=limits) as bridge:
        bridge.run(0.06)
        flags = bridge.latest_records(60)["flags"]
    part = slice(3, 6) if is_turned else slice(0, 3)
    steps = np.linalg.norm(np.diff(device.writes[:60], axis=0)[:, part], axis=1)
    assert steps.max() == pytest.approx(share * (0.5 if is_turned else 10.0))
    assert bool((flags & int(TickFlag.SLEW_LIMITED)).any()) == (rise > 0)


def test_a_device_that_moved_before_the_first_tick_finds_the_coupling_unstretched() -> None:
    reports = itertools.count()  # by the first tick it is 50 mm from where it started
    device = ScriptedDevice(lambda _k: (0.05 * (next(reports) > 0), 0, 0, 1, 0, 0, 0))
    with fast("point_mass", device) as bridge:
        bridge.run(0.01)
        rows = bridge.latest_records(10)
    assert rows["flags"][0] & REANCHORED
    assert np.abs(rows["wrench_on_tool"][:, :3]).max() < 1e-9


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


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: BridgeOptions(controller="magic"), "choices: 'damper', 'environment', 'off'"),
        (lambda: BridgeOptions(clutch=-1), "clutch button is -1"),
        (lambda: BridgeOptions(dead_man=99), "dead-man button is 99"),
        (lambda: BridgeOptions(clutch=1, dead_man=1), "exclude each other"),
        (lambda: Limits(force=1.0, torque=1.0, slew_time=-1.0), "it must be"),
        (lambda: Limits(force=1.0, torque=1.0, stretch=0.0), "it must be"),
        (lambda: Limits(force=1.0, torque=1.0, angle=4.0), "it must be"),
        (lambda: Limits(force=1.0, torque=1.0, energy=math.nan), "it must be"),
        (lambda: Limits(force=1.0, torque=1.0, reach=0.0), "it must be"),
    ],
)
def test_what_the_guard_is_not_is_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(DeviceError, match=message):
        call()


def test_a_guard_reads_back_as_it_was_written() -> None:
    info = ScriptedDevice(lambda _k: (0,) * 7).info
    guarding = guard_parameters_for(info, Limits(force=10.0, torque=0.5), 1e-3)
    guarding = replace(guarding, clutch=0b100)
    assert GuardParameters.from_json(guarding.to_json()) == guarding
    assert GuardParameters.from_json(UNGUARDED.to_json()) == UNGUARDED
    older = {k: v for k, v in json.loads(guarding.to_json()).items() if k != "reach"}
    assert GuardParameters.from_json(json.dumps(older)) == guarding
    for text in ("", "{}", "[1]", guarding.to_json().replace("0.05", '"x"')):
        with pytest.raises(HapticBridgeError, match="guard"):
            GuardParameters.from_json(text)
    assert not UNLIMITED.slew_time


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
    limit = time.monotonic() + 20.0
    while node.read_bytes() != 3 * b"\0zero\1off":
        assert time.monotonic() < limit, "nobody said zero"
    if has_forked:
        os.kill(int(holder), signal.SIGKILL)
    process.stdout.close()
    word = ForceOffGuardian(str(quiet), b"\0zero")
    word.close()
    word.close()
    assert quiet.read_bytes() == b""


T, RAMP = 1e-3, 500
K, B_DEVICE = 2000.0, 2.0
COUPLING = Coupling(K, 0.9, 2.0, 5e-4)
LIMITS = Limits(force=10.0, torque=0.5)

Pose = Callable[[int], tuple[float, ...]]


def rubbed(amplitude: float, speed: float = 10.0) -> Pose:
    """To and fro against a tool that stays: a hand that begins before the force is there."""
    return lambda k: (amplitude * math.sin(speed * T * k), 0, 0, 1, 0, 0, 0)


def ramped(
    folder: Path, pose: Pose, *, energy: float, is_slowed: bool = True, **options: Any
) -> tuple[Recording, float, str]:
    """Runs it; returns the recording, what the hand was given beyond what it put in, the trip."""
    scene, path, reason = folder / "anvil.xml", folder / "run.mcap", ""
    scene.write_text(ANVIL)
    device = ScriptedDevice(pose, damping=B_DEVICE)
    limits = replace(LIMITS, energy=energy)
    act = options.pop("act", None)
    bridge = fast(scene, device, coupling=COUPLING, limits=limits, recording=path, **options)
    if not is_slowed:
        guard = replace(bridge.setup.guard, ramp_energy=math.inf)
        bridge.setup = replace(bridge.setup, guard=guard)
    with bridge:
        try:
            bridge.run(1.5, act and (lambda k: act(bridge, k)))
        except SafetyTrip as trip:
            reason = str(trip)
    recording = read_recording(path)
    # by itself: work of what was sent until the next sample, less what the damper burns meanwhile
    moved = np.diff(recording.ticks["device_position"], axis=0)
    sent = recording.ticks["wrench_on_device"][:-1, :3]
    given = np.cumsum(np.sum((sent - B_DEVICE / T * moved) * moved, axis=1))
    return recording, float(given.max()), reason


@pytest.mark.parametrize(("amplitude", "speed"), [(0.04, 5.0), (0.04, 10.0), (0.02, 5.0)])
def test_rubbing_while_the_force_rises_is_given_little_and_stops_nothing(
    tmp_path: Path, amplitude: float, speed: float
) -> None:
    pose = rubbed(amplitude, speed)
    recording, given, trip = ramped(tmp_path, pose, energy=USUAL_ENERGY)
    assert not trip
    assert given < 1.5 / (RAMP * T) * RAMP_ENERGY  # the time of three ramps
    report = audit(recording.path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    # from the records alone too: the second computation knows how the force rises
    assert audit(rewritten(without_model(recording), tmp_path / "b.mcap")).verdict == "passive"


def test_a_force_that_rises_whatever_it_holds_gives_a_rubbing_hand_what_the_limit_forbids(
    tmp_path: Path,
) -> None:
    """The energy is there, so the trip is right; the pace of the ramp is what was wrong."""
    pose = rubbed(0.04)
    _, given, _ = ramped(tmp_path, pose, energy=math.inf, is_slowed=False)
    assert given > 0.12
    _, given, trip = ramped(tmp_path, pose, energy=USUAL_ENERGY, is_slowed=False)
    assert "more energy beyond what the hand put in" in trip
    assert USUAL_ENERGY < given < 0.05


def pushed_in(depth: float) -> Pose:
    """Into the coupling within 20 ms, and held there."""
    return lambda k: (depth * min(k / 20, 1.0), 0, 0, 1, 0, 0, 0)


@pytest.mark.parametrize("newtons", [4.0, 6.0, 9.0, 30.0])
def test_the_force_rises_slower_by_what_the_coupling_holds_beyond_the_allowance(
    tmp_path: Path, newtons: float
) -> None:
    depth = newtons / K
    recording, *_ = ramped(tmp_path, pushed_in(depth), energy=math.inf)
    ticks = recording.ticks
    ramping = (ticks["flags"] & int(TickFlag.RAMPING)) != 0
    # a spring whose force stops growing at 10 N
    held = 0.5 * K * min(depth, 10.0 / K) ** 2 + 10.0 * max(depth - 10.0 / K, 0.0)
    slower = max(held / RAMP_ENERGY, 1.0)
    took = int(np.argmin(ramping)) if not ramping.all() else None
    if slower * RAMP > len(ticks):
        assert took is None
    else:
        assert took == pytest.approx(
            slower * (RAMP - 20) + 20, rel=0.04, abs=1
        )  # the anvil gives way
        assert (took == RAMP) == (newtons < 6.3)  # sqrt(2 K 0.01 J)
    steps = np.diff(np.linalg.norm(ticks["wrench_on_device"][30:300, :3], axis=1))
    full = min(float(np.linalg.norm(ticks["wrench_on_tool"][200, :3])), 10.0)
    assert np.median(steps) == pytest.approx(full / (RAMP + 1) / slower, rel=0.02)
    rises = np.diff(ticks["share"][30:300])
    assert np.median(rises) == pytest.approx(1 / (RAMP + 1) / slower, rel=0.02)


def test_about_an_axis_too(tmp_path: Path) -> None:
    def twisted(tick: int) -> tuple[float, ...]:
        half = 0.5 * min(tick / 100, 1.0)  # 1 rad: 0.0625 J below 0.5 N m, 0.375 J beyond
        return (0, 0, 0, math.cos(half), math.sin(half), 0, 0)

    for is_slowed in (True, False):
        recording, *_ = ramped(tmp_path, twisted, energy=math.inf, is_slowed=is_slowed)
        ramping = (recording.ticks["flags"] & int(TickFlag.RAMPING)) != 0
        assert (np.count_nonzero(ramping) > RAMP) == is_slowed


def test_a_coupling_that_is_changed_meanwhile_counts_as_it_is(tmp_path: Path) -> None:
    def act(bridge: Bridge, tick: int) -> None:
        if tick == 100:
            bridge.command(Couple(1000.0, 0.9))

    recording, *_ = ramped(tmp_path, pushed_in(9.0 / K), energy=math.inf, act=act)
    plain = rewritten(without_model(recording), tmp_path / "plain.mcap")
    assert audit(plain).verdict == "passive"
    assert audit(recording.path).resimulation == "bit for bit"


def test_a_recording_that_claims_another_pace_is_found(tmp_path: Path) -> None:
    recording, *_ = ramped(tmp_path, rubbed(0.02), energy=math.inf)
    slow = recording.meta["guard"]
    for claim in ('"ramp_energy": null', '"ramp_energy": 0.02'):
        told = {"guard": slow.replace('"ramp_energy": 0.01', claim)}
        for file in (recording, without_model(recording)):
            changed = rewritten(file, tmp_path / "changed.mcap", meta=told)
            assert audit(changed).verdict == "invalid"


def test_what_was_recorded_before_the_pace_was_known_is_judged_as_it_was(tmp_path: Path) -> None:
    recording, *_ = ramped(tmp_path, rubbed(0.02), energy=math.inf, is_slowed=False)
    assert '"ramp_energy": null' in recording.meta["guard"]
    older = {"guard": recording.meta["guard"].replace(', "ramp_energy": null', "")}
    report = audit(rewritten(recording, tmp_path / "older.mcap", meta=older))
    assert report.resimulation == "bit for bit"
