"""Drivers, libraries and kernel on emulated devices, where this machine can."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from emulated.compile_ahead import snapshot_of_compiled_code
from emulated.guest import NO_KERNEL, GuestRun, kernel, run_in_guest
from emulated.parting import repeated
from emulated.tiers import JOBS, Claim, Job, claims_of, main

from hapticbridge.kernel.record import FORMAT, TICK_DTYPE
from hapticbridge.recording.writer import RecordingWriter


@pytest.mark.parametrize("job", JOBS, ids=lambda job: job.name)
def test_what_a_job_claims_holds(job: Job, tmp_path: Path) -> None:
    if (reason := job.missing()) is not None:
        pytest.skip(reason)
    claims = job.run(tmp_path)
    failed = [f"{claim.name}: {claim.note}" for claim in claims if claim.is_true is False]
    assert not failed, "\n".join(failed)
    assert claims


def test_a_job_that_cannot_run_is_skipped_with_the_reason_and_a_false_claim_fails_the_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    skipped = Job("on a kernel", lambda: NO_KERNEL, lambda _: [Claim("never", is_true=False)])
    unknown = Claim("unknown", is_true=None, note="no such driver")
    true = Claim("true", is_true=True, note="5 trips/s")
    good = Job("good", lambda: None, lambda _: [true, unknown])
    bad = Job("bad", lambda: None, lambda _: [Claim("false", is_true=False, note="why")])
    monkeypatch.setattr("emulated.tiers.JOBS", (skipped, good))
    assert main() == 0
    said = capsys.readouterr().out
    assert f"skipped  on a kernel: {NO_KERNEL}" in said
    assert "ok   true: 5 trips/s" in said
    assert "skip unknown: no such driver" in said
    monkeypatch.setattr("emulated.tiers.JOBS", (skipped, good, bad))
    assert main() == 1
    assert "FAIL false: why" in capsys.readouterr().out


def test_a_report_is_read_claim_by_claim_and_a_missing_one_is_a_failure(tmp_path: Path) -> None:
    report = tmp_path / "report.xml"
    (nothing,) = claims_of(report, "the guest's last words")
    assert (nothing.is_true, nothing.note) == (False, "the guest's last words")
    report.write_text(
        "<testsuites><testsuite>"
        '<testcase name="test_it_holds"><properties><property name="trips/s" value="9"/>'
        '</properties></testcase><testcase name="test_it_fails"><failure>why</failure></testcase>'
        '<testcase name="test_it_breaks"><error>how</error></testcase>'
        '<testcase name="test_it_cannot"><skipped message="no such kernel"/></testcase>'
        "</testsuite></testsuites>"
    )
    assert claims_of(report, "") == [
        Claim("it holds", is_true=True, note="9 trips/s"),
        Claim("it fails", is_true=False, note="why"),
        Claim("it breaks", is_true=False, note="how"),
        Claim("it cannot", is_true=None, note="no such kernel"),
    ]


@pytest.mark.parametrize(
    ("field", "change", "status", "told"),
    [
        ("wake_ns", 0, 0, "5 ticks"),
        ("wake_ns", 512, 0, "5 ticks"),
        ("wake_ns", 1024, 0, "runs 1 and 3: wake_ns of tick 4 differs by 1024 ns"),
        ("kinetic", 5e-324, 0, "runs 1 and 3: the first difference is Difference(time=0.004, "),
        ("kinetic", 0.0, 3, "run 3 of 3 ended with status 3 after 1.5 s of this machine's time"),
    ],
)
def test_odd_run_is_told(tmp_path: Path, field: str, change: float, status: int, told: str) -> None:
    def run(number: int) -> tuple[GuestRun, Path]:
        ticks, file = np.zeros(5, TICK_DTYPE), tmp_path / f"{number}.mcap"
        ticks["tick"] = np.arange(5)
        ticks["wrench_on_tool"][2, 1] = np.nan
        ticks[field][4] += change if number == 3 else 0
        writer = RecordingWriter(file, {"period_s": "0.001", "format": FORMAT}, [], epoch_ns=0)
        writer.write_ticks(ticks)
        writer.close()
        ended = status if number == 3 else 0
        return GuestRun(ended, f"guest {number} says so", 1.5, "its kernel too"), file

    verdict, note = repeated(run, 3)
    assert verdict == (told == "5 ticks")
    assert note.startswith(told)
    for said in ("guest 3 says so", "its kernel too"):
        assert (said in note) != verdict


def test_snapshot_holds_what_is_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = tmp_path / "cache" / "0123"
    mine = ["kernel/step.1.nbc", "kernel/step.nbi", "tick-0123.o"]
    for name in (*mine, "kernel/step.nbi.tmp.77", "tmp0a1b", "../4567/x.nbi"):
        (cache / name).parent.mkdir(parents=True, exist_ok=True)
        (cache / name).write_text(name)
    monkeypatch.setattr("emulated.compile_ahead.cache_folder", lambda: cache)
    folder = snapshot_of_compiled_code(tmp_path / "mine")
    found = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    assert found == [f"0123/{name}" for name in mine]


@pytest.mark.skipif(kernel() is None, reason=NO_KERNEL)
def test_in_virtual_time_a_program_that_reads_the_clock_oftener_is_later(tmp_path: Path) -> None:
    """Reason why runs that are to be equal must find the same compiled code."""
    told = []
    for number, readings in enumerate((0, 0, 1000)):
        reads = f"import time; [time.monotonic() for _ in range({readings})]"
        program = f"{reads}; print(time.monotonic_ns())"
        folder = tmp_path / str(number)
        folder.mkdir()
        command = [sys.executable, "-I", "-S", "-c", program]
        ended = run_in_guest(command, folder, environment={})
        told.append(int(ended.output))
    assert told[1] == told[0]
    assert told[2] - told[0] == pytest.approx(1000 * 256, rel=0.01)


@pytest.mark.skipif(kernel() is None, reason=NO_KERNEL)
def test_a_guest_says_how_its_command_ended_and_one_that_hangs_is_stopped(tmp_path: Path) -> None:
    command = ["sh", "-c", 'echo "$WHAT"; test -e /dev/uhid && exit 7']
    ended = run_in_guest(command, tmp_path, environment={"WHAT": "it's here"})
    assert (ended.status, ended.output) == (7, "it's here\n")
    dying = ["sh", "-c", "echo '<1>memory is full' >/dev/kmsg; kill -9 $$"]
    killed = run_in_guest(dying, tmp_path, environment={})
    assert killed.status == 137
    assert "memory is full" in killed.output
    endless = ["sh", "-c", "while :; do i=0; while [ $i -lt 999 ]; do i=$((i+1)); done; echo; done"]
    limits: Any = {"environment": {}, "patience": 3.0}
    stopped = run_in_guest(endless, tmp_path, timeout=4.0, **limits)
    assert stopped.status is None
    assert stopped.output.endswith("\nthe guest was stopped after 4 s")
    endless[-1] = "echo begun; while :; do :; done"
    silent = run_in_guest(endless, tmp_path, **limits)
    assert silent.status is None
    assert silent.output == "begun\nthe guest was stopped: it had printed nothing for 3 s"
