"""What-if on recordings of a run's guard: its limits, its buttons and its controller go along."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import report_runs
from audit_cases import ScriptedDevice, SlowClock, recorded
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import RecordingError, SafetyTrip
from hapticbridge.guard import Limits
from hapticbridge.options import Workspace
from hapticbridge.record import TickFlag
from hapticbridge.recording import read_recording
from hapticbridge.whatif import what_if
from hapticbridge.whatif.recorded import RecordedRun

LIGHTLY_HELD = report_runs.ANVIL.replace(
    "<worldbody>", '<custom><numeric name="simulated_hand" data="60 0"/></custom><worldbody>'
)
"""A tool that stays where it is, and a hand that burns nothing: a stiff spring swings up."""

TOO_STIFF = Coupling(
    stiffness=10_000.0, damping=0.05, rotational_stiffness=0.1, rotational_damping=1e-4
)


class Pressed(ScriptedDevice):
    """A slow push to the side, and a button that is down from tick 100 to tick 199."""

    def __init__(self) -> None:
        super().__init__(lambda tick: (1e-4 * tick, 0, 0, 1, 0, 0, 0))

    def _report(self, sample: NDArray[np.void], tick: int) -> None:
        super()._report(sample, tick)
        sample["buttons"] = int(100 <= tick < 200)


def swung(path: Path, controller: str | None, duration: float = 0.1) -> Path:
    scene = path.with_suffix(".xml")
    scene.write_text(LIGHTLY_HELD)
    device = SimulatedDevice(mass=0.2, damping=0.1, hand=report_runs.LIGHT_HAND)
    options: dict[str, Any] = {"duration": duration, "controller": controller}
    recorded(path, str(scene), device, TOO_STIFF, **options)
    return path


@pytest.mark.parametrize("button", ["clutch", "dead_man"])
def test_a_button_does_again_what_it_did(button: str, tmp_path: Path) -> None:
    path = tmp_path / "pressed.mcap"
    options: dict[str, Any] = {button: 0}
    recorded(path, "point_mass", Pressed(), duration=0.3, **options)
    same, slower = what_if(path, {}), what_if(path, {"rate": 500})
    before, after = same.runs[0].ticks, same.runs[1].ticks
    # else the handle would be 10 mm further on, or the wrench there all the time
    np.testing.assert_allclose(after["handle_position"], before["handle_position"], atol=1e-9)
    np.testing.assert_allclose(after["wrench_on_device"], before["wrench_on_device"], atol=1e-6)
    for run in (*same.runs, *slower.runs[1:]):
        released = (run.ticks["flags"] & int(TickFlag.CLUTCH)) != 0
        times = run.period * np.flatnonzero(released)
        pressed = (times >= 0.1) & (times < 0.2)
        assert pressed.all() == (button == "clutch")
        assert released.sum() * run.period == pytest.approx(0.1 if button == "clutch" else 0.2)


def test_limits_are_those_that_were_recorded(tmp_path: Path) -> None:
    limits = Limits(
        force=3.0,
        torque=0.2,
        rise=0.05,
        ramp=0.02,
        stretch=0.1,
        angle=1.0,
        energy=math.inf,
        reach=0.5,
    )
    path = tmp_path / "limited.mcap"
    device = ScriptedDevice(lambda tick: (0.004 * (tick > 60), 0, 0, 1, 0, 0, 0))
    recorded(
        path, "point_mass", device, duration=0.15, limits=limits, workspace=Workspace(scale=2.0)
    )
    again = RecordedRun.of(read_recording(path), tmp_path / "scene").limits
    assert vars_of(again) == pytest.approx(vars_of(limits))
    before, after = (run.ticks for run in what_if(path, {}).runs[:2])
    assert (before["flags"] & int(TickFlag.SLEW_LIMITED)).any()
    assert before.tobytes() == after.tobytes()


def test_the_edge_of_the_reach_is_where_it_was(tmp_path: Path) -> None:
    path, limits = tmp_path / "far.mcap", Limits(force=10.0, torque=0.5, reach=0.005)
    device = ScriptedDevice(lambda tick: (1e-4 * tick, 0, 0, 1, 0, 0, 0))
    recorded(path, "point_mass", device, duration=0.1, limits=limits)
    before, after = (run.ticks for run in what_if(path, {}).runs[:2])
    beyond = (before["flags"] & int(TickFlag.CLUTCH)) != 0
    assert 40 < beyond.sum() < 60
    assert before.tobytes() == after.tobytes()


class Silent(ScriptedDevice):
    """A device that has nothing new from tick 20 on."""

    def read(self, sample: NDArray[np.void]) -> int:
        super().read(sample)
        return int(TickFlag.STALE_SAMPLE) if len(self.writes) >= 20 else 0


def test_old_samples_are_old_again(tmp_path: Path) -> None:
    path = tmp_path / "silent.mcap"
    device = Silent(lambda tick: (1e-4 * min(tick, 19), 0, 0, 1, 0, 0, 0))
    recorded(path, "point_mass", device, duration=0.08)
    same, slower = what_if(path, {}), what_if(path, {"rate": 700})
    before, after = (run.ticks for run in same.runs[:2])
    assert np.ptp(before["wrench_on_device"][20:, 0]) > 0
    assert np.abs(before["wrench_on_device"][-1]).max() == 0.0  # it has faded
    assert before.tobytes() == after.tobytes()
    assert np.abs(slower.runs[1].ticks["wrench_on_device"][-1]).max() == 0.0
    assert slower.runs[1].report.verdict == "passive"  # no tick is called old that has moved


def vars_of(limits: Limits) -> dict[str, float]:
    return {name: getattr(limits, name) for name in Limits.__dataclass_fields__}


@pytest.mark.parametrize(
    ("recorded_with", "chosen"), [("off", "off"), ("damper", None), (None, None)]
)
def test_the_controller_is_the_recorded_one_unless_it_was_left_open(
    recorded_with: str | None, chosen: str | None, tmp_path: Path
) -> None:
    path = swung(tmp_path / "run.mcap", recorded_with)
    run = RecordedRun.of(read_recording(path), tmp_path / "scene")
    assert run.settings.controller == chosen


def test_a_model_hand_feels_the_controller_that_is_asked_for(tmp_path: Path) -> None:
    path = swung(tmp_path / "run.mcap", "off", duration=1.4)
    ticks = {}
    for name in ("off", "damper"):
        found = what_if(path, {"controller": name})
        assert found.changes == (("controller", "", "off", name),)
        ticks[name] = found.runs[2].ticks
    at_work = {n: (t["flags"] & int(TickFlag.CONTROLLER_ACTIVE)) != 0 for n, t in ticks.items()}
    assert not at_work["off"].any()
    assert at_work["damper"].any()
    with pytest.raises(
        RecordingError,
        match="controller is 'dampr'; choose one of 'damper', 'environment', 'off'",
    ):
        what_if(path, {"controller": "dampr"})


def test_a_trip_is_shown_beside_what_does_not_trip(tmp_path: Path) -> None:
    path, scene = tmp_path / "trip.mcap", "point_mass"
    device = ScriptedDevice(lambda tick: (0.001 * max(tick - 50, 0), 0, 0, 1, 0, 0, 0))
    with pytest.raises(SafetyTrip):
        recorded(
            path, scene, device, duration=0.3, limits=Limits(force=10.0, torque=0.5, stretch=0.005)
        )
    same = what_if(path, {}).runs
    assert same[1].trip == same[0].trip
    assert len(same[1].ticks) == len(same[0].ticks)
    found = what_if(path, {"stiffness": 100, "damping": 0.2})
    assert "stretch limit" in found.runs[0].trip
    assert "stretch limit" in found.runs[1].trip
    assert found.exit_code == 1
    tripped = len(found.runs[0].ticks)
    # a softer spring is as long sooner
    assert len(found.runs[1].ticks) < tripped


def test_missed_deadlines_come_back_where_the_motion_is_prescribed(tmp_path: Path) -> None:
    for missed in (0, 80):
        path, clock = tmp_path / f"{missed}.mcap", SlowClock({20: missed} if missed else {})
        device = ScriptedDevice(lambda tick: (2e-5 * tick, 0, 0, 1, 0, 0, 0))
        recorded(path, "point_mass", device, duration=0.05, clock=clock)
        found = what_if(path, {})
        before, after = (run.ticks for run in found.runs[:2])
        # a stall of 80 ms re-seats the coupling, in both
        assert (before["flags"] & int(TickFlag.RESEATED)).any() == (missed > 0)
        assert before.tobytes() == after.tobytes()
        told = [note for note in found.notes if note.startswith("late ticks: 1")]
        assert [("none in the closed loop" in note) for note in told] == [True] * (missed > 0)


class Moved(ScriptedDevice):
    """A device that somebody moved by 20 mm between its start and its first sample."""

    def start(self, period: float) -> NDArray[np.void]:
        sample = super().start(period)
        sample["position"][0, 0] -= 0.02
        return sample


def test_what_moved_before_the_first_tick_is_not_seen_in_the_scene(tmp_path: Path) -> None:
    path = tmp_path / "moved.mcap"
    device = Moved(lambda tick: (1e-5 * tick, 0, 0, 1, 0, 0, 0))
    recorded(path, "point_mass", device, duration=0.05)
    before, after = (run.ticks for run in what_if(path, {}).runs[:2])
    assert before["flags"][0] & int(TickFlag.RESEATED)
    assert before.tobytes() == after.tobytes()
