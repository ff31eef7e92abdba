"""Gaps, deadlines, cuts and events: what makes a file no whole record of a run."""

from __future__ import annotations

from pathlib import Path

import pytest
from audit_cases import rewritten, verdict_of, without_model
from cli_cases import Called

from hapticbridge.kernel.record import CLOCK_FIELDS, TickFlag
from hapticbridge.recording import Recording


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
