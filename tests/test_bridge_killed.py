"""Runs against the wall clock in processes of their own, which are then stopped or killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from waiting import PATIENCE, is_alive, until

from hapticbridge.audit import audit
from hapticbridge.errors import RecordingError
from hapticbridge.recording import read_recording, repair

SCRIPT = """
import os, sys, time
import hapticbridge as hb

def tell(tick):
    if tick == 600:  # two chunks of the recording are full
        child = os.fork() if sys.argv[2] == "SIGKILL" else 0
        if sys.argv[2] == "SIGKILL" and not child:  # it keeps the recorder's pipe open
            os.closerange(1, 3)
            time.sleep(60)
        print(bridge.session.stream.recorder.pid, child, flush=True)

with hb.Bridge("virtual_wall", recording=sys.argv[1]) as bridge:
    summary = bridge.run(60.0, tell)
print(summary.stopped_by, summary.ticks, summary.overruns, summary.dropped, summary.verdict)
"""


@dataclass
class Stopped:
    """A run that was stopped in the middle."""

    path: Path
    status: int
    output: str
    recorder: int


HOW = ("SIGINT", "SIGTERM", "SIGKILL", "both")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Stopped]]:
    """Four runs at once, each stopped in its own way: most of their time is start and wait."""
    folder = tmp_path_factory.mktemp("killed")
    started = {}
    stopped = {}
    try:
        for how in HOW:
            path = folder / f"{how}.mcap"
            # from 3.12 on Python warns of a fork beside threads, which the script wants
            quiet = ("-W", "ignore::DeprecationWarning")
            command = [sys.executable, *quiet, "-c", SCRIPT, str(path), how]
            process = subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
            )
            started[how] = (path, process)
        for how, (path, process) in started.items():
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line[:1].isdigit(), line + process.stdout.read()
            recorder, child = map(int, line.split())
            if how == "both":
                os.kill(recorder, signal.SIGKILL)
                process.kill()
            else:
                process.send_signal(signal.SIGKILL if how == "SIGKILL" else getattr(signal, how))
            output, _ = process.communicate(timeout=PATIENCE)
            until(lambda: not is_alive(recorder))  # noqa: B023
            if child:
                os.kill(child, signal.SIGKILL)
            stopped[how] = Stopped(path, process.returncode, output, recorder)
        yield stopped
    finally:
        for _, process in started.values():
            process.kill()
            process.wait()


@pytest.mark.parametrize("how", ["SIGINT", "SIGTERM"])
def test_signal_ends_a_run_cleanly(runs: dict[str, Stopped], how: str) -> None:
    run = runs[how]
    assert run.status == 0, run.output
    reason, ticks, overruns, dropped, verdict = run.output.split()
    recording = read_recording(run.path)
    assert (reason, verdict) == ("signal", "passive")
    assert not recording.is_cut
    stop = recording.events[-1]
    assert (stop["event"], stop["reason"]) == ("stop", "signal")
    assert stop["tick"] == len(recording.ticks) == int(ticks)
    assert 600 < int(ticks) < 60_000
    assert (stop["overruns"], stop["dropped"]) == (int(overruns), int(dropped))
    report = audit(run.path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


def test_real_clock_counts_every_skipped_deadline(runs: dict[str, Stopped]) -> None:
    recording = read_recording(runs["SIGINT"].path)
    ticks = recording.ticks
    last = int(ticks["deadline_ns"][-1]) // 1_000_000
    assert last == len(ticks) + recording.events[-1]["skipped"]
    assert (ticks["wake_ns"] >= ticks["deadline_ns"]).all()
    assert (ticks["read_ns"] >= ticks["wake_ns"]).all()
    assert (ticks["write_ns"] >= ticks["read_ns"]).all()


def test_killed_bridge_leaves_a_whole_recording_that_says_so(runs: dict[str, Stopped]) -> None:
    run = runs["SIGKILL"]
    assert run.status == -signal.SIGKILL
    recording = read_recording(run.path)
    assert not recording.is_cut
    assert recording.problems == ()
    assert [event["event"] for event in recording.events] == ["start", "bridge_died"]
    assert recording.events[-1]["tick"] == recording.ticks["tick"][-1] == len(recording.ticks) - 1
    assert len(recording.ticks) >= 600
    report = audit(run.path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert report.events["bridge_died"] == 1
    assert (report.is_cut, report.cut) == (True, "the bridge died during the run")


def test_killed_bridge_and_recorder_leave_a_cut_recording_that_repair_mends(
    runs: dict[str, Stopped], tmp_path: Path
) -> None:
    cut, mended = runs["both"].path, tmp_path / "mended.mcap"
    report = audit(cut)
    assert report.is_cut
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    # at 400 bytes a record a chunk of 128 kB holds about 300 of the 600 that were surely written
    assert report.ticks >= 250
    with pytest.raises(RecordingError, match=r"exists|cannot write"):
        repair(cut, cut)
    repair(cut, mended)
    after = audit(mended)
    assert (after.verdict, after.is_cut, after.ticks) == ("passive", True, report.ticks)
    assert after.cut == "the file had lost its end and was repaired"
    before, now = read_recording(cut).ticks, read_recording(mended).ticks
    assert np.array_equal(before, now)
