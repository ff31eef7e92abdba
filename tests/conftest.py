"""Fixtures of several test files."""

from __future__ import annotations

import functools
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import recorded, tapped
from cli_cases import Called
from forked_recorder import ForkedRecorder
from hypothesis import settings
from numpy.typing import NDArray
from outside_scenes import GRIPPED, hand_file, mjcf, scene_file, ticks
from recording_cases import random_rows, write
from report_runs import Made

from hapticbridge.audit import AuditReport, audit
from hapticbridge.cli import main
from hapticbridge.errors import HapticBridgeError
from hapticbridge.recording import Recording, read_recording
from hapticbridge.signals import STOP_SIGNALS

# a deadline is a timing, and other work on the machine must fail no test; half of the usual
# examples, for other ones are drawn in each run
settings.register_profile("hapticbridge", deadline=None, max_examples=50)
settings.load_profile("hapticbridge")


@pytest.fixture(autouse=True, scope="session")
def usual_signals() -> Iterator[None]:
    """Handles stop signals as a terminal's processes do, whatever the caller ignores or blocks.

    ``nohup`` leaves SIGHUP ignored, a background job of a shell SIGINT; children inherit that.
    """
    ignored = [number for number in STOP_SIGNALS if signal.getsignal(number) is signal.SIG_IGN]
    for number in ignored:
        usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, usual)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)
    yield
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)


@functools.cache
def is_drawable() -> bool:
    """Returns True if MuJoCo alone has a context to draw in, without a display."""
    code = "import mujoco; mujoco.GLContext(16, 16).make_current()"
    environments = (os.environ | {"MUJOCO_GL": name} for name in ("egl", "osmesa"))
    tried = (
        subprocess.run([sys.executable, "-c", code], env=each, capture_output=True, check=False)
        for each in environments
    )
    return any(done.returncode == 0 for done in tried)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator[None, object, object]:
    """Skips a test that could not draw, on a machine where MuJoCo alone cannot either."""
    try:
        return (yield)
    except (AssertionError, HapticBridgeError) as error:
        if "so nothing can be drawn off-screen" in str(error) and not is_drawable():
            pytest.skip("nothing can be drawn off-screen here")
        raise


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Counts skipped tests by reason: a line for each of the two most frequent, one for the rest.

    Names in quotation marks and brackets are left out of a reason.
    """
    skipped = terminalreporter.stats.get("skipped", [])
    reasons = (str(report.longrepr[-1]).removeprefix("Skipped: ") for report in skipped)
    kinds = Counter(re.sub(r"'[^']*'", "…", re.split(r" \(|: ", each)[0]) for each in reasons)
    lines = [f"{count} skipped: {kind}" for kind, count in kinds.most_common()]
    rest = [", ".join(lines[2:])] if len(lines) > 2 else []
    for line in [*lines[:2], *rest]:
        terminalreporter.write_line(line)


PROCESSES = ("test_bridge_killed", "test_cli_run", "test_realtime", "test_recording_recorder")
"""Modules whose recorders are processes as users have them."""


@pytest.fixture(autouse=True, scope="module")
def forked_recorders(request: pytest.FixtureRequest) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        if sys.platform == "linux" and not request.module.__name__.startswith(PROCESSES):
            patch.setattr("hapticbridge.recording.recorder.recorder_process", ForkedRecorder)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("audit")


@pytest.fixture(scope="module")
def tap(folder: Path) -> Recording:
    """A peg in contact, tilted and off centre."""
    return read_recording(tapped(folder))


@pytest.fixture(scope="module")
def held(folder: Path) -> Recording:
    """The same with a device in a hand, whose motion answers to the force."""
    path = folder / "held.mcap"
    motion = folder / "tap.csv"
    tapped(folder)
    recorded(path, device=f"simulated:path={motion}", duration=0.2)
    return read_recording(path)


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder, kept = tmp_path_factory.mktemp("golden"), {}

    def make(run: Callable[[Path], Path]) -> tuple[Recording, AuditReport]:
        if run not in kept:
            path = run(folder)
            kept[run] = read_recording(path), audit(path)
        return kept[run]

    return make


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SWEEP_SCRATCH", str(tmp_path))
    return tmp_path


@pytest.fixture(scope="module")
def run_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tapped(tmp_path_factory.mktemp("cli"), "run.mcap")


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Called:
    """Calls the command line in this process; returns exit code, stdout and stderr."""
    monkeypatch.setenv("COLUMNS", "200")

    def called(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return called


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Puts a few bytes in place of a report's picture, which a process would draw for a second."""
    monkeypatch.setattr("hapticbridge.cli.audit.still", lambda *_, **__: b"a picture")


@pytest.fixture(scope="module")
def plain_ticks(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, NDArray[np.void]]:
    folder = tmp_path_factory.mktemp("plain")
    hand = hand_file(folder, [(0.1, (0.01, -0.005, 0.01)), (0.1, (-0.01, 0.0, 0.0))])
    return hand, ticks(scene_file(folder, mjcf(body=GRIPPED)), hand)


@pytest.fixture(scope="module")
def memory_folder() -> Any:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@pytest.fixture(scope="module")
def whole(memory_folder: Path) -> Path:
    """A recording of several chunks with events between its records."""
    path = memory_folder / "whole.mcap"
    write(path, random_rows(1500))
    return path
