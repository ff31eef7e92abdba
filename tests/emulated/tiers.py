"""Jobs in a User-Mode Linux, real libraries on a real kernel: their commands, needs and findings.

The project's ordinary tests drive the same emulated devices in process. Run as a program, it runs
all jobs and prints what ran and what was skipped and why.
"""

from __future__ import annotations

import os
import sys
import tempfile
import threading
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import hapticbridge as hb
from emulated import guest
from emulated.compile_ahead import compile_ahead
from emulated.guest import CHECKOUT, NO_KERNEL, GuestRun, kernel

CHECKS = CHECKOUT / "tests/usb_tiers"
LIMIT = 600.0
"""Time limit in s per job, far beyond the longest."""

LOOPS = {"falcon": 3.0, "rawhid": 3.0, "pid": 4.0}
"""Closed loops, and the virtual time in s of each: a run begins some 2 s into the hand's path, and
the home-made device's peg touches its hole 2 s later."""


@dataclass(frozen=True)
class Claim:
    """One thing that a job found.

    Attributes:
        name: What is claimed.
        is_true: Whether it held; None where it was skipped.
        note: What was measured, how it failed, or why it was skipped.
    """

    name: str
    is_true: bool | None
    note: str = ""


@dataclass(frozen=True)
class Job:
    """Something to run in a guest.

    Attributes:
        name: What it does.
        missing: Says what this machine lacks for it, None where nothing.
        run: Runs it, with an empty folder to write to.
    """

    name: str
    missing: Callable[[], str | None]
    run: Callable[[Path], list[Claim]]


def _kernel_missing() -> str | None:
    return None if kernel() is not None else NO_KERNEL


def _pytest(report: str) -> list[str]:
    """Returns the command that runs the checks, apart from the project's own tests."""
    paths = sorted(str(path) for path in CHECKS.glob("*check_*.py"))
    plain = ["--rootdir", str(CHECKS), "-c", os.devnull, "-p", "no:cacheprovider"]
    # line by line, so that what is stopped says where it stood
    form = ["--tb=short", "-v", f"--junitxml={report}", "-o", "junit_family=xunit1"]
    return [sys.executable, "-m", "pytest", *plain, *form, *paths]


def claims_of(report: Path, otherwise: str) -> list[Claim]:
    """Reads a report; where there is none, the only claim is that the job ran."""
    if not report.is_file():
        return [Claim("the job ran", is_true=False, note=otherwise)]
    claims = []
    for case in ET.parse(report).getroot().iter("testcase"):
        failures = [*case.iter("failure"), *case.iter("error")]
        measured = [f"{one.get('value')} {one.get('name')}" for one in case.iter("property")]
        note = "\n".join(failure.text or "" for failure in failures) or ", ".join(measured)
        name = case.get("name", "").removeprefix("test_").replace("_", " ")
        skipped = case.find("skipped")
        if skipped is None:
            claims.append(Claim(name, is_true=not failures, note=note))
        else:
            claims.append(Claim(name, is_true=None, note=skipped.get("message", "")))
    return claims


def _in_the_guest(
    folder: Path, command: Sequence[str], *, patience: float | None = None
) -> GuestRun:
    _compile_ahead()
    variables = guest.python_environment()
    if not guest.has_pidff():
        variables["HAPTICBRIDGE_NO_PIDFF"] = "1"
    return guest.run_in_guest(
        command, folder, environment=variables, timeout=LIMIT, patience=patience
    )


_compiling = threading.Lock()


def _compile_ahead() -> None:
    """Fills the cache of compiled code, once: a guest takes minutes for it, this machine 20 s."""
    with _compiling:
        compile_ahead()


def _checks(folder: Path) -> list[Claim]:
    """Runs the checks in a guest, and finds what they claim."""
    run = _in_the_guest(folder, _pytest("/run/job/report.xml"), patience=guest.PATIENCE)
    return claims_of(folder / "report.xml", run.output)


def _closed_loops(folder: Path) -> list[Claim]:
    """Runs ``hapticbridge run`` on emulated devices, in one guest."""
    command = [sys.executable, "-m", "usb_tiers.closed_loop", "/run/job"]
    command += [f"{device}:{seconds:g}" for device, seconds in LOOPS.items()]
    ended = _in_the_guest(folder, command)
    return [_closed_loop(ended, device, folder / f"{device}.mcap") for device in LOOPS]


def _closed_loop(ended: GuestRun, device: str, file: Path) -> Claim:
    seconds = LOOPS[device]
    name = f"a run with a peg on {device} for {seconds:g} s of virtual time is audited passive"
    if ended.status != 0 or not file.is_file():
        return Claim(name, is_true=False, note=ended.output)
    report = hb.audit(file)
    is_whole = report.duration > seconds - 5e-4 and not report.is_cut
    touching = int(np.count_nonzero(hb.read_recording(file).ticks["contacts"]))
    is_good = is_whole and report.verdict == "passive" and (touching > 100 or device != "rawhid")
    note = f"{report.ticks} ticks, {touching} of them touching, {report.verdict}"
    return Claim(name, is_good, f"{note} ({report.environment})")


JOBS = (
    Job("checks of the drivers", _kernel_missing, _checks),
    Job("closed loops", _kernel_missing, _closed_loops),
)


def _found(job: Job) -> tuple[list[Claim], float]:
    """Runs a job in a folder of its own; returns its claims and how long it took, in s."""
    start = time.monotonic()
    if job.missing() is not None:
        return [], 0.0
    with tempfile.TemporaryDirectory(prefix="hapticbridge-") as name:
        return job.run(Path(name).resolve()), time.monotonic() - start


def main() -> int:
    """Runs all jobs and prints a table; returns 1 where a claim did not hold, else 0.

    A guest has one processor, so as many run at once as this machine has.
    """
    is_good = True
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for job, (claims, seconds) in zip(JOBS, pool.map(_found, JOBS), strict=True):
            if (reason := job.missing()) is not None:
                print(f"skipped  {job.name}: {reason}", flush=True)
                continue
            print(f"ran      {job.name}: {len(claims)} claims in {seconds:.1f} s")
            for claim in claims:
                mark = {True: "ok  ", False: "FAIL", None: "skip"}[claim.is_true]
                print(f"    {mark} {claim.name}" + (f": {claim.note}" if claim.note else ""))
                is_good &= claim.is_true is not False
            sys.stdout.flush()
    return 0 if is_good else 1


if __name__ == "__main__":
    sys.exit(main())
