"""Drivers, libraries and kernel on emulated devices, where this machine can."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from emulated.guest import NO_KERNEL, kernel, run_in_guest
from emulated.tiers import JOBS, Claim, Job, claims_of, main


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
