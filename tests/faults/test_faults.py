"""Every fault against the simulated device: what must hold, and that the guard is what holds it."""

from __future__ import annotations

import math
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import AnsweringDevice, ScriptedDevice
from bridge_runs import fast, sway

from faults.catalogue import FAULTS, PROBED, PUSHED, PUSHER, RING_FULL, UNSEEN, Fault, passing
from faults.processes import HANGS, STOPS, Hang, hang, stop_at_start
from faults.rig import CAUSE, PERIOD, PRESS, Rig
from hapticbridge.audit import audit
from hapticbridge.clock import SimulatedClock
from hapticbridge.demand.guard import USUAL_ENERGY, Limits
from hapticbridge.errors import SafetyTrip
from hapticbridge.kernel.record import TickFlag
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge

LIMIT, MAX_ENERGY = 10.0, 0.05
"""Force limit of the rig in N, and energy in J beyond what the hand put in."""

pytestmark = pytest.mark.filterwarnings("ignore:.*Nan, Inf or huge value")


def ids(fault: Fault) -> str:
    return fault.name.replace(" ", "_")


@pytest.mark.parametrize("fault", FAULTS, ids=ids)
def test_a_fault_hurts_nobody_and_its_recording_is_whole(fault: Fault, tmp_path: Path) -> None:
    outcome = fault.run(tmp_path)
    assert outcome.is_finite
    assert outcome.largest_force <= LIMIT * (1 + 1e-12)
    assert outcome.energy <= fault.energy
    assert outcome.last_is_zero
    assert outcome.rows + outcome.dropped == outcome.ticks
    if fault is RING_FULL:  # what happened in the gap nobody can tell, and the audit says so
        assert 700 < outcome.dropped < 900
        first_lost = CAUSE + 1000 - outcome.dropped
        assert f"not contiguous: {first_lost - 1} is followed" in outcome.report.reason
        return
    if fault.ends == "refuses":
        assert outcome.ticks == 0
        assert "SafetyTrip: tick 0: a small force along" in outcome.error
        assert outcome.events[-3:] == ["probe", "trip", "stop"]
        assert fault.says in outcome.report.reason
        return
    assert outcome.report.verdict != "invalid", outcome.report.reason
    assert outcome.dropped == 0
    assert outcome.report.resimulation == "bit for bit"
    assert fault.says in outcome.report.reason
    if fault.ends in ("trip", "stops", "fades"):
        assert outcome.zero_after is not None
        assert outcome.zero_after <= fault.within
    if fault.ends == "trip":
        assert outcome.error.startswith("SafetyTrip")
        # what wrote bad numbers into the state is named beside the trip
        assert [name for name in outcome.events if name != "scene_changed"][-2:] == ["trip", "stop"]
    elif fault.ends == "lowers":
        assert not outcome.error
        assert outcome.found_after is not None
        assert outcome.found_after <= fault.within
    elif fault.ends == "leaves":
        assert outcome.error.startswith("RecordingError: the recorder (process ")
        assert "stood still for 2 s and is left to finish" in outcome.error
    elif fault.ends in ("fades", "slips", "goes on"):
        assert not outcome.error
        has_slipped = (outcome.flags[CAUSE:] & int(TickFlag.REANCHORED)).any()
        assert has_slipped == (fault.ends != "goes on")


@pytest.mark.parametrize("fault", HANGS, ids=lambda fault: fault.name.replace(" ", "_"))
def test_the_force_of_a_hung_bridge_is_ended_by_its_guardian(fault: Hang, tmp_path: Path) -> None:
    outcome = hang(fault, tmp_path)
    assert outcome.zero_after > 0.09  # not while the loop is only late
    assert not outcome.has_force_after
    if fault.wakes:
        assert "tick 1200: the loop sent nothing for 100 ms while force was on" in outcome.says


@pytest.mark.parametrize(("name", "seconds"), [("SIGINT", 0.2), ("SIGTERM", 0.1), ("SIGHUP", 0.0)])
def test_a_stop_during_start_up_leaves_nothing(name: str, seconds: float, tmp_path: Path) -> None:
    outcome = stop_at_start(name, seconds, tmp_path)
    assert (outcome.status, outcome.says, outcome.has_file) == (*STOPS[name], False)
    assert not outcome.orphans


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault.without], ids=ids)
def test_without_its_guard_the_fault_does_harm(fault: Fault, tmp_path: Path) -> None:
    device = fault.unguarded(tmp_path)
    if "turn" in fault.name:
        torques = np.linalg.norm(device.wrenches[CAUSE : CAUSE + 5, 3:], axis=1)
        assert torques.max() > 0.3
    else:
        assert device.energy > (fault.energy if fault in (*UNSEEN, *PROBED) else 0.6 * MAX_ENERGY)


@pytest.mark.parametrize("energy", [USUAL_ENERGY, 0.046])
def test_a_motors_push_is_cut_off_before_it_passes_the_energy_limit(
    tmp_path: Path, energy: float
) -> None:
    fault = next(fault for fault in FAULTS if fault.cause == PUSHED)
    rig = Rig(tmp_path)
    fault.do(rig)
    rig.guard = {"energy": energy}
    outcome = rig.run(fault.cause)
    assert 0.8 * energy < outcome.energy <= energy
    assert "more than it put in" in outcome.error
    assert outcome.last_is_zero


class GivesWay(AnsweringDevice):
    """A hand that gives way slowly while a motor pushes, then jumps to the device's full speed.

    Attributes:
        given: Largest energy in J that it got beyond what b burnt.
    """

    def __init__(self, slow_until: float) -> None:
        super().__init__(self._yield, name="yielding", damping=0.2)
        self._slow_until, self._gives_way = slow_until, False
        self._net = self.given = 0.0

    def _yield(self, _tick: int, force: float) -> float:
        self._gives_way = self._gives_way or abs(force) > 9.0
        if not self._gives_way:
            return 0.0
        speed = 0.2 if self._net < self._slow_until else self.info.speed_limit
        self._net += (abs(force) - 0.2 * speed) * speed * PERIOD
        self.given = max(self.given, self._net)
        return math.copysign(speed, force)


def given_to_a_hand_that_jumps(scene: Path, slow_until: float, changes: dict[str, Any]) -> float:
    """Returns the energy in J that a motor gives to a hand that jumps to full speed."""
    hand = GivesWay(slow_until)
    bridge = Bridge(scene, hand, clock=SimulatedClock())
    bridge.setup = replace(bridge.setup, guard=replace(bridge.setup.guard, **changes))
    with bridge:
        bridge.set_input(ctrl={"ram": -12.0})
        with pytest.raises(SafetyTrip, match="more than it put in"):
            bridge.run(1.0)
    return hand.given


@pytest.mark.parametrize("slow_until", [0.0, 0.005, 0.02, 0.038])
def test_a_jump_to_full_speed_brings_at_most_fifty_millijoules(
    tmp_path: Path, slow_until: float
) -> None:
    scene = tmp_path / "pusher.xml"
    scene.write_text(PUSHER)
    assert 0.0 < given_to_a_hand_that_jumps(scene, slow_until, {}) <= MAX_ENERGY
    if slow_until > 0.01:
        unlimited = given_to_a_hand_that_jumps(scene, slow_until, {"full_speed": 0.0})
        assert unlimited > MAX_ENERGY


def test_a_signal_at_any_tick_ends_a_run_with_zero_force(tmp_path: Path) -> None:
    generator = np.random.default_rng(11)
    device = ScriptedDevice(sway)
    signals = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    ticks: list[int] = []
    with fast("point_mass", device, recording=tmp_path / "run.mcap") as bridge:
        for count in range(24):
            number = signals[count % 3]
            begun, wanted = ticks[-1] if ticks else 0, int(generator.integers(1, 40))
            writes = len(device.writes)

            def act(k: int, at: int = begun + wanted, number: int = number) -> None:
                if k == at:
                    os.kill(os.getpid(), number)

            summary = bridge.run(0.05, act)
            assert (summary.stopped_by, summary.ticks) == ("signal", begun + wanted + 1)
            assert len(device.writes) == writes + wanted + 2
            assert device.writes[-2].any()
            assert not device.writes[-1].any()
            ticks.append(summary.ticks)
    recording = read_recording(tmp_path / "run.mcap")
    ends = [event for event in recording.events if event["event"] in ("resume", "stop")]
    assert [event["tick"] for event in ends] == ticks
    assert [event["signal"] for event in ends] == [signals[k % 3].name for k in range(24)]
    assert recording.ticks["tick"].tolist() == list(range(ticks[-1]))
    assert audit(tmp_path / "run.mcap").verdict == "passive"


def test_a_signal_that_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup leaves it
    try:
        with fast("point_mass", ScriptedDevice(sway)) as bridge:
            summary = bridge.run(
                0.02, lambda k: os.kill(os.getpid(), signal.SIGHUP) if k == 5 else None
            )
    finally:
        signal.signal(signal.SIGHUP, before)
    assert summary.stopped_by == "duration"


def test_a_signal_that_a_library_handles_stays_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python says None of it, and cannot put it back: a run must not fail at its end for that."""
    seen, before = signal.getsignal, signal.getsignal(signal.SIGHUP)

    def told(number: int) -> Any:
        return None if number == signal.SIGHUP else seen(number)

    monkeypatch.setattr(signal, "getsignal", told)
    with fast("point_mass", ScriptedDevice(sway)) as bridge:
        heeded: list[Any] = []
        bridge.run(0.02, lambda _: heeded.append(seen(signal.SIGHUP)))
    assert heeded[-1] is before
    assert seen(signal.SIGHUP) is before


def test_a_killed_recorders_last_records_are_written_by_the_bridge(tmp_path: Path) -> None:
    fault: Any = next(fault for fault in FAULTS if fault.name == "recorder killed")
    outcome = fault.run(tmp_path)
    recording = read_recording(tmp_path / "run.mcap")
    assert not recording.is_cut
    assert recording.ticks["tick"].tolist() == list(range(outcome.ticks))
    assert "recorder_died" in outcome.events
    assert not list(tmp_path.glob("*.salvaged"))
    assert audit(tmp_path / "run.mcap").verdict == "passive"


START = CAUSE * PERIOD

AWAY = ((*PRESS[:3], (START - 0.1, 0.0804), (START + 0.4, -0.0696), (9.0, -0.0696))), 0.2
"""A hand that had pressed on the wall takes itself away at 0.3 m/s; a stall of 0.2 s."""

INTO = (
    ((0.0, 0.0), (START - 0.1, 0.005), (START + 0.08, 0.023), (START + 0.31, 0.0), (9.0, 0.0)),
    0.06,
)
"""A hand goes into the wall at 0.1 m/s during a stall of 60 ms, and back again."""

Case = tuple[tuple[tuple[float, float], ...], float]


# While a machine stands still nothing in this program can act; the device holds its last force. So
# the claim is about what comes after: nothing is added.


def given(folder: Path, case: Case, *, is_guarded: bool) -> tuple[float, float, bool]:
    """Returns what the hand was given in the stall, what after it, in J, and whether it tripped.

    ``is_guarded`` is False without an energy limit.
    """
    rig, has_tripped = Rig(folder), False
    rig.points, stall = case
    rig.device.corrupt = passing(rig, CAUSE, stall)
    limits = Limits(force=10.0, torque=0.5, ramp=0.2)
    bridge = Bridge("virtual_wall", rig.device, clock=rig.clock, limits=limits)
    if not is_guarded:
        guard = replace(bridge.setup.guard, energy=math.inf)
        bridge.setup = replace(bridge.setup, guard=guard)
    with bridge:
        try:
            bridge.run(START + 0.4)
        except SafetyTrip:
            has_tripped = True
    energy = rig.device.to_the_hand
    begin, end = CAUSE + 1, CAUSE + 1 + round(stall / PERIOD)
    return energy[end] - energy[begin], max(energy[end:]) - energy[end], has_tripped


def test_a_hand_that_leaves_in_a_stall_is_given_all_of_it_before_the_loop_wakes(
    tmp_path: Path,
) -> None:
    during, after, has_tripped = given(tmp_path, AWAY, is_guarded=True)
    assert during > 3 * USUAL_ENERGY  # 4 N held over 40 mm: only the device could end it
    assert after == pytest.approx(0.0, abs=1e-6)
    assert has_tripped
    same, more, _ = given(tmp_path, AWAY, is_guarded=False)
    assert same == during
    assert more <= 1e-6


def test_a_hand_that_enters_a_wall_in_a_stall_is_not_given_what_it_never_put_in(
    tmp_path: Path,
) -> None:
    during, after, _ = given(tmp_path, INTO, is_guarded=False)
    assert during < 0.0
    assert after < -during  # of its own: it comes back
