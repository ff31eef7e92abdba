"""A run of S seconds lasts S seconds of its clock, whatever was missed on the way."""

from __future__ import annotations

from pathlib import Path

import pytest
from audit_cases import ScriptedDevice, SlowClock, recorded
from bridge_runs import sway
from cli_cases import Called

from hapticbridge.audit import audit
from hapticbridge.bridge import Bridge
from hapticbridge.recording import read_recording

MISSED = {0: 2, 50: 1, 51: 7, 120: 30}


@pytest.mark.parametrize("seconds", [0.05, 0.1, 0.2, 0.4])
def test_a_run_that_misses_deadlines_ends_when_the_clock_says(
    tmp_path: Path, seconds: float
) -> None:
    path = tmp_path / "run.mcap"
    clock = SlowClock(MISSED)
    summary = recorded(path, "point_mass", ScriptedDevice(sway), clock=clock, duration=seconds)
    asked = round(1000 * seconds)
    ticks = read_recording(path).ticks
    assert ticks["deadline_ns"][-1] == 1_000_000 * asked
    assert summary.ticks == len(ticks) == asked - summary.skipped
    assert summary.skipped == sum(missed for at, missed in MISSED.items() if at < len(ticks)) > 0
    assert summary.duration == pytest.approx(seconds)
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert report.ticks == len(ticks)
    assert report.duration == pytest.approx(seconds)


@pytest.mark.parametrize(("stall", "ticks", "end"), [(49, 51, 0.1), (60, 51, 0.111)])
def test_a_stall_over_the_end_ends_the_run_with_the_tick_that_was_late(
    tmp_path: Path, stall: int, ticks: int, end: float
) -> None:
    path = tmp_path / "run.mcap"
    clock, device = SlowClock({50: stall}), ScriptedDevice(sway)
    summary = recorded(path, "point_mass", device, clock=clock, duration=0.1)
    assert (summary.ticks, summary.skipped) == (ticks, stall)
    assert summary.duration == pytest.approx(end)
    assert len(device.writes) == ticks + 2  # one zero at the end of the run, one on leaving
    assert not device.writes[-1].any()
    assert audit(path).verdict == "passive"


def test_a_second_run_lasts_as_long_as_it_is_asked_to(tmp_path: Path) -> None:
    path, clock = tmp_path / "run.mcap", SlowClock({20: 500, 30: 5})
    device = ScriptedDevice(sway)
    with Bridge("point_mass", device, clock=clock, recording=path) as bridge:
        first = bridge.run(0.1)
        assert first.ticks == 21
        assert first.duration == pytest.approx(0.521)
        assert bridge.run(0.1).duration == pytest.approx(0.621)
    assert audit(path).duration == pytest.approx(0.621)


def test_a_motion_that_ends_the_run_is_followed_to_its_end_however_long_it_takes(
    tmp_path: Path,
) -> None:
    """Its samples are what is asked for, one a tick; a time is not."""
    motion = tmp_path / "hand.csv"
    motion.write_text("t,x,y,z\n0,0,0,0\n0.2,0.01,0,0\n")
    with Bridge("point_mass", f"trajectory:{motion}", clock=SlowClock(MISSED)) as bridge:
        summary = bridge.run()
        assert (summary.ticks, summary.skipped) == (201, 40)
        assert bridge.latest_records(1)["device_position"][0, 0] == pytest.approx(0.01)
    with Bridge("point_mass", f"trajectory:{motion}", clock=SlowClock(MISSED)) as bridge:
        assert bridge.run(0.2).ticks == 160


def test_the_command_line_says_what_its_seconds_are(call: Called) -> None:
    code, text, _ = call("run", "--help")
    assert code == 0
    assert "Seconds to run, by the clock" in " ".join(text.split())
