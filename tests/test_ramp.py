"""A force that rises at a start must not give the hand what it did not put in."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, rewritten, without_model
from bridge_runs import fast
from report_runs import ANVIL

from hapticbridge.audit import audit
from hapticbridge.bridge import Bridge
from hapticbridge.commands import Couple
from hapticbridge.coupling import Coupling
from hapticbridge.errors import SafetyTrip
from hapticbridge.guard import RAMP_ENERGY, USUAL_ENERGY, Limits
from hapticbridge.record import TickFlag
from hapticbridge.recording import Recording, read_recording

T, RAMP = 1e-3, 500
K, B_DEVICE = 2000.0, 2.0
COUPLING = Coupling(K, 0.9, 2.0, 5e-4)
LIMITS = Limits(force=10.0, torque=0.5)

Pose = Callable[[int], tuple[float, ...]]


def rubbed(amplitude: float, speed: float = 10.0) -> Pose:
    """To and fro against a tool that stays: a hand that begins before the force is there."""
    return lambda k: (amplitude * math.sin(speed * T * k), 0, 0, 1, 0, 0, 0)


def run(
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
    recording, given, trip = run(tmp_path, pose, energy=USUAL_ENERGY)
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
    _, given, _ = run(tmp_path, pose, energy=math.inf, is_slowed=False)
    assert given > 0.12
    _, given, trip = run(tmp_path, pose, energy=USUAL_ENERGY, is_slowed=False)
    assert "more energy beyond what the hand put in" in trip
    assert USUAL_ENERGY < given < 0.05


def pressed(depth: float) -> Pose:
    """Into the coupling within 20 ms, and held there."""
    return lambda k: (depth * min(k / 20, 1.0), 0, 0, 1, 0, 0, 0)


@pytest.mark.parametrize("newtons", [4.0, 6.0, 9.0, 30.0])
def test_the_force_rises_slower_by_what_the_coupling_holds_beyond_the_allowance(
    tmp_path: Path, newtons: float
) -> None:
    depth = newtons / K
    recording, *_ = run(tmp_path, pressed(depth), energy=math.inf)
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
        recording, *_ = run(tmp_path, twisted, energy=math.inf, is_slowed=is_slowed)
        ramping = (recording.ticks["flags"] & int(TickFlag.RAMPING)) != 0
        assert (np.count_nonzero(ramping) > RAMP) == is_slowed


def test_a_coupling_that_is_changed_meanwhile_counts_as_it_is(tmp_path: Path) -> None:
    def act(bridge: Bridge, tick: int) -> None:
        if tick == 100:
            bridge.command(Couple(1000.0, 0.9))

    recording, *_ = run(tmp_path, pressed(9.0 / K), energy=math.inf, act=act)
    plain = rewritten(without_model(recording), tmp_path / "plain.mcap")
    assert audit(plain).verdict == "passive"
    assert audit(recording.path).resimulation == "bit for bit"


def test_a_recording_that_claims_another_pace_is_found(tmp_path: Path) -> None:
    recording, *_ = run(tmp_path, rubbed(0.02), energy=math.inf)
    slow = recording.meta["guard"]
    for claim in ('"ramp_energy": null', '"ramp_energy": 0.02'):
        told = {"guard": slow.replace('"ramp_energy": 0.01', claim)}
        for file in (recording, without_model(recording)):
            changed = rewritten(file, tmp_path / "changed.mcap", meta=told)
            assert audit(changed).verdict == "invalid"


def test_what_was_recorded_before_the_pace_was_known_is_judged_as_it_was(tmp_path: Path) -> None:
    recording, *_ = run(tmp_path, rubbed(0.02), energy=math.inf, is_slowed=False)
    assert '"ramp_energy": null' in recording.meta["guard"]
    older = {"guard": recording.meta["guard"].replace(', "ramp_energy": null', "")}
    report = audit(rewritten(recording, tmp_path / "older.mcap", meta=older))
    assert report.resimulation == "bit for bit"
