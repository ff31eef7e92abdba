"""Gaps, deadlines, cuts and events: what makes a file no whole record of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from audit_cases import recorded, rewritten, verdict_of, without_model
from cli_cases import Called

from hapticbridge.audit import audit
from hapticbridge.kernel.record import CLOCK_FIELDS, TickFlag
from hapticbridge.recording import Recording, read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.scene.load import scene_path


@pytest.mark.parametrize("lost", [slice(70, 71), slice(0, 3), slice(50, 150)])
def test_gap_is_named_and_invalid(tap: Recording, folder: Path, lost: slice) -> None:
    kept = np.delete(tap.ticks, lost)
    report = verdict_of(tap, folder, ticks=kept)
    assert report.verdict == "invalid"
    assert f"{lost.start - 1} is followed by {lost.stop}" in report.reason
    assert (report.tick, report.port) == (lost.start, "tick")


def test_swapped_and_repeated_records_are_invalid(tap: Recording, folder: Path) -> None:
    order = np.arange(len(tap.ticks))
    order[[80, 81]] = [81, 80]
    assert verdict_of(tap, folder, ticks=tap.ticks[order]).verdict == "invalid"
    twice = np.insert(np.arange(len(tap.ticks)), 80, 79)
    assert verdict_of(tap, folder, ticks=tap.ticks[twice]).verdict == "invalid"


def test_deadlines_must_follow_the_period_and_the_overrun_flag(
    tap: Recording, folder: Path
) -> None:
    late = tap.ticks.copy()
    for name in CLOCK_FIELDS:
        late[name][90:] += 3_000_000
    report = verdict_of(tap, folder, ticks=late)
    assert (report.verdict, report.tick, report.port) == ("invalid", 90, "deadline_ns")
    late["flags"][90] |= int(TickFlag.OVERRUN)
    report = verdict_of(tap, folder, ticks=late)
    assert (report.verdict, report.port) == ("invalid", "'overruns' of the event 'stop'")
    events = [event | {"overruns": 1, "skipped": 3} for event in tap.events]
    assert verdict_of(tap, folder, ticks=late, events=events).verdict == "passive"
    for name in CLOCK_FIELDS:
        late[name][90:] += 500_000
    assert verdict_of(tap, folder, ticks=late).verdict == "invalid"


@pytest.mark.parametrize(
    "flag",
    [
        TickFlag.CONTACT,
        TickFlag.DROPPED_BEFORE,
        TickFlag.RAMPING,
        TickFlag.CLUTCH,
    ],
)
def test_a_flag_that_its_record_contradicts_is_found_without_a_simulation(
    tap: Recording, folder: Path, flag: TickFlag
) -> None:
    ticks = tap.ticks.copy()
    ticks["flags"][80] ^= int(flag)
    report = verdict_of(without_model(tap), folder, ticks=ticks)
    assert (report.verdict, report.tick, report.port) == ("invalid", 80, "flags")
    assert f"flag '{str(flag.name).lower()}' of tick 80" in report.reason


def test_changed_input_event_is_found(tmp_path: Path) -> None:
    scene = tmp_path / "scene.xml"
    text = scene_path("point_mass").read_text()
    scene.write_text(text)
    path = tmp_path / "run.mcap"

    def push(bridge: Bridge, tick: int) -> None:
        if tick == 20:
            bridge.set_input(body_wrench={"tool": [0.5, 0, 0, 0, 0, 1e-3]})

    recorded(path, scene, duration=0.1, on_tick=push)
    recording = read_recording(path)
    assert audit(path).resimulation == "bit for bit"
    assert recording.ticks["external_work"][-1] != 0
    damages: tuple[dict[str, object], ...] = (
        {"tick": 21},
        {"tick": "20"},
        {"tick": -1},
        {"writes": []},
        {"writes": [["xfrc_applied", 6, [0.5, 0, 0, 0, 0, 1.1e-3]]]},
        {"writes": [["qpos", 0, [1.0]]]},
        {"writes": [["ctrl", 0, 1.0]]},
        {"writes": [["ctrl", 10**6, [1.0]]]},
        {"writes": {"a": 1}},
        {"writes": None},
    )
    for damage in damages:
        events = [
            event | damage if event["event"] == "input" else event for event in recording.events
        ]
        report = audit(rewritten(recording, tmp_path / "other.mcap", events=events))
        assert report.verdict == "invalid", damage


def test_clock_times_are_free_as_long_as_they_run_forwards(tap: Recording, folder: Path) -> None:
    ticks = tap.ticks.copy()
    for name in ("wake_ns", "read_ns", "write_ns"):
        ticks[name][7] += 12345
    ticks["buttons"][7] = 3
    assert verdict_of(tap, folder, ticks=ticks).verdict == "passive"
    ticks["wake_ns"][7] += 1
    report = verdict_of(tap, folder, ticks=ticks)
    assert (report.verdict, report.tick, report.port) == ("invalid", 7, "wake_ns")


def test_a_recording_of_another_format_is_refused_in_one_sentence(
    tap: Recording, folder: Path, call: Called
) -> None:
    path = rewritten(tap, folder / "other.mcap", meta={"format": "0"})
    for command in (("audit",), ("view",), ("export", "--format", "csv")):
        code, out, err = call(command[0], path, *command[1:])
        assert code == 2
        assert "has the recording format '0'" in " ".join((out + err).split())
