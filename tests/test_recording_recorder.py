"""The recorder's process: every record of a run, also of one that is killed."""

from __future__ import annotations

import io
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from waiting import PATIENCE, has_ended, is_alive, until

from hapticbridge.errors import RecordingError
from hapticbridge.kernel.record import FORMAT, TICK_DTYPE, TickFlag
from hapticbridge.recording import (
    TAIL,
    Attachment,
    Recorder,
    Ring,
    read_recording,
)
from hapticbridge.recording import recorder as recorder_module
from hapticbridge.recording.recorder import RecordOutput, RecordStream
from hapticbridge.recording.recorder_process import LiveLine, RunState

META = {"method": "implicit", "device": "{}"}
# larger than what a pipe takes at once
FILES = (Attachment("model.mjb", "application/octet-stream", bytes(range(256)) * 4000),)


def numbered(start: int, stop: int) -> NDArray[np.void]:
    rows = np.zeros(stop - start, TICK_DTYPE)
    rows["tick"] = np.arange(start, stop)
    rows["deadline_ns"] = rows["tick"] * 1_000_000
    # noise, so that the chunks do not shrink to nothing
    rows["tool_position"] = np.random.default_rng(start).normal(size=(stop - start, 3))
    return rows


def started(*arguments: Any, **options: Any) -> Recorder:
    recorder = Recorder(*arguments, **options)
    recorder.start()
    return recorder


def produce(ring: Ring, recorder: Recorder, rows: NDArray[np.void]) -> None:
    done = 0
    while done < rows.size:
        done += ring.append(rows[done:])
        assert recorder.is_alive()
        time.sleep(0.001)


@pytest.fixture
def ring() -> Iterator[Ring]:
    ring = Ring.shared(512)
    yield ring
    ring.close()


def test_recorder_writes_every_record_and_event_of_a_run(ring: Ring, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    rows = numbered(0, 3000)
    recorder = started(ring, path, META, FILES, epoch_ns=7)
    recorder.event({"event": "start"}, 0)
    recorder.wait_until_ready()
    produce(ring, recorder, rows)
    recorder.event({"event": "stop", "force": float("nan")}, 2_999_000_000)
    recorder.close()
    recorder.close()
    assert not recorder.is_alive()
    recording = read_recording(path)
    assert (recording.ticks == rows).all()
    assert recording.events == [
        {"event": "start", "time_ns": 0},
        {"event": "stop", "force": "nan", "time_ns": 2_999_000_000},
    ]
    assert recording.meta == {"format": FORMAT, **META, "epoch_ns": "7"}
    assert recording.attachments["model.mjb"] == FILES[0].data
    assert recording.problems == ()
    assert ring.pending() == 0


def test_records_that_wait_at_the_close_are_drained(ring: Ring, tmp_path: Path) -> None:
    recorder = started(ring, tmp_path / "run.mcap", META, ())
    ring.append(numbered(0, 512))
    recorder.close()
    assert read_recording(tmp_path / "run.mcap").ticks["tick"].tolist() == list(range(512))


def test_a_file_holds_no_record_before_the_event_of_its_start(ring: Ring, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = started(ring, path, META, ())
    rows = numbered(0, 2048)  # eight chunks
    produce(ring, recorder, rows[:1024])
    until(lambda: not ring.pending())
    recorder.event({"event": "start"}, 0)
    produce(ring, recorder, rows[1024:])
    recorder.close()
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    cut = read_recording(path)
    assert cut.is_cut
    assert 0 < cut.ticks.size < rows.size
    assert [event["event"] for event in cut.events] == ["start"]


def test_events_beyond_the_pipe_wait_and_all_arrive(ring: Ring, tmp_path: Path) -> None:
    recorder = started(ring, tmp_path / "run.mcap", META, ())
    recorder.wait_until_ready()
    os.kill(recorder.pid, signal.SIGSTOP)
    for number in range(3000):
        recorder.event({"event": "mark", "text": "x" * 100, "number": number}, number)
    os.kill(recorder.pid, signal.SIGCONT)
    recorder.close()
    events = read_recording(tmp_path / "run.mcap").events
    assert [event["number"] for event in events] == list(range(3000))


def test_interrupt_and_termination_leave_closing_to_bridge(ring: Ring, tmp_path: Path) -> None:
    recorder = started(ring, tmp_path / "run.mcap", META, ())
    recorder.wait_until_ready()
    assert os.getpgid(recorder.pid) != os.getpgid(0)
    for signal_number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(recorder.pid, signal_number)
    produce(ring, recorder, numbered(0, 600))
    recorder.close()
    assert read_recording(tmp_path / "run.mcap").ticks.size == 600


def test_recorder_loads_neither_mujoco_nor_the_compiler(ring: Ring, tmp_path: Path) -> None:
    recorder = started(ring, tmp_path / "run.mcap", META, ())
    recorder.wait_until_ready()
    loaded = Path(f"/proc/{recorder.pid}/maps").read_text()
    recorder.close()
    assert "zstandard" in loaded
    assert "mujoco" not in loaded
    assert "llvmlite" not in loaded


def test_what_cannot_be_recorded_is_refused_before_the_run(ring: Ring, tmp_path: Path) -> None:
    for path, reason in (
        (tmp_path / "none" / "run.mcap", "the folder .* does not exist"),
        (Path("/proc/run.mcap"), "the folder /proc takes no new file"),
        (tmp_path, "Is a directory"),
        (Path("/dev/full"), "No space left on device"),
    ):
        recorder = started(ring, path, META, FILES)
        with pytest.raises(RecordingError, match=reason):
            recorder.wait_until_ready()
        assert not recorder.is_alive()
        recorder.event({"event": "late"}, 0)
        recorder.close()
    with pytest.raises(RecordingError, match="needs a shared ring"):
        Recorder(Ring.local(4), None, META, ())
    with pytest.raises(RecordingError, match="must be text"):
        Recorder(ring, None, {"a": 1}, ())  # type: ignore[dict-item]


def test_full_disk_is_reported_at_close_and_file_reads_as_cut(ring: Ring, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = started(ring, path, META, ())
    recorder.wait_until_ready()
    # stands for a full disk: the process may not let a file grow beyond this
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (50_000, 50_000))
    rows = numbered(0, 20_000)
    done = 0
    while done < rows.size and recorder.is_alive():
        done += ring.append(rows[done:])
        time.sleep(0.001)
    with pytest.raises(RecordingError, match=r"cannot write the recording .*run.mcap: File too"):
        recorder.close()
    recorder.close()
    recording = read_recording(path)
    assert recording.is_cut
    assert (recording.ticks == rows[: recording.ticks.size]).all()
    assert recording.ticks.size > 0


def test_killed_recorder_is_noticed_and_named(ring: Ring, tmp_path: Path) -> None:
    recorder = started(ring, tmp_path / "run.mcap", META, ())
    recorder.wait_until_ready()
    os.kill(recorder.pid, signal.SIGKILL)
    until(lambda: not recorder.is_alive())
    recorder.event({"event": "late"}, 0)
    with pytest.raises(RecordingError, match=r"killed by signal 9.*hapticbridge repair"):
        recorder.close()
    assert read_recording(tmp_path / "run.mcap").is_cut


def test_live_line_in_a_file_is_plain_text(ring: Ring, capfd: pytest.CaptureFixture[str]) -> None:
    recorder = started(ring, None, META, (), live=True)
    recorder.wait_until_ready()
    rows = numbered(0, 101)
    rows["wrench_on_tool"][-1] = (3.0, 0.0, -4.0, 9.0, 9.0, 9.0)
    rows["wrench_on_device"][-1] = (-0.9, 0.0, 1.2, 0.0, 0.0, 0.0)
    rows["environment_energy"] = -3.4e-3
    rows["device_energy"] = -1.04e-3
    rows["flags"][[5, 9]] = TickFlag.OVERRUN | TickFlag.CONTACT
    produce(ring, recorder, rows)
    recorder.close()
    assert capfd.readouterr() == (
        "",
        "0.1 s  1.5 N on the hand; 5 N on the tool  environment -3.4 mJ  device -1.04 mJ  "
        "2 overruns\n",
    )


def test_run_state_counts_the_records_that_were_dropped() -> None:
    state = RunState()
    assert str(state) == "waiting for the first tick"
    rows = numbered(0, 20)
    rows["flags"][[8, 15]] = TickFlag.DROPPED_BEFORE
    state.add(rows[:5])
    state.add(rows[8:12])  # three lost between two batches
    state.add(rows[[15, 17]])  # three lost, then a tick that was skipped by an overrun
    assert str(state).endswith("  0 overruns  6 records dropped")


def test_run_state_goes_on_to_say_why_the_force_is_lower() -> None:
    state, rows = RunState(), numbered(0, 3)
    rows["flags"] &= ~int(TickFlag.SWINGING | TickFlag.RUNS_AWAY)
    state.add(rows[:1])
    assert "FORCE" not in str(state)
    rows["flags"][1] |= TickFlag.SWINGING
    state.add(rows[1:2])
    state.add(rows[2:])
    assert str(state).endswith("FORCE LOWERED: the device answers late, or an axis is reversed")


def test_run_state_names_the_forces_of_every_hand_and_counts_a_tick_once() -> None:
    state = RunState((True, False))
    rows = np.repeat(numbered(0, 4), 2)  # a record per hand and tick
    rows["wrench_on_device"][:, :3], rows["wrench_on_tool"][:, :3] = 0.0, 0.0
    rows["wrench_on_device"][0::2, 0] = rows["wrench_on_tool"][0::2, 0] = 1.5
    rows["wrench_on_tool"][1::2, 1] = 2.5
    rows["device_energy"][0::2], rows["device_energy"][1::2] = 1e-3, -2e-3
    rows["flags"][:2] = TickFlag.OVERRUN
    state.add(rows)
    words = str(state)
    assert "1.5 N on the hand | 2.5 N on the tool" in words
    assert "device 1 mJ | -2 mJ" in words
    assert words.endswith("1 overruns")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class BrokenTerminal(Terminal):
    def write(self, text: str) -> int:
        raise BrokenPipeError(32, "Broken pipe")


def test_live_line_on_a_terminal_is_redrawn_and_may_break() -> None:
    stream = Terminal()
    for terminal in (stream, BrokenTerminal()):
        line = LiveLine(terminal)
        line.update(numbered(0, 2001))
        line.close()
    text = stream.getvalue()
    assert "2.0 s  0 N on the hand  environment 0 J  device 0 J  0 overruns" in text
    assert text.count("\n") <= 2


@pytest.mark.parametrize("has_full_pipe", [False, True])
def test_a_recorder_that_stands_still_is_left_to_finish(
    ring: Ring, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_full_pipe: bool
) -> None:
    monkeypatch.setattr(recorder_module, "STANDSTILL", 0.2)
    path = tmp_path / "run.mcap"
    recorder = started(ring, path, META, ())
    recorder.wait_until_ready()
    produce(ring, recorder, numbered(0, 600))
    os.kill(recorder.pid, signal.SIGSTOP)
    for number in range(3000 * has_full_pipe):
        recorder.event({"event": "mark", "text": "x" * 100, "number": number}, number)
    began = time.monotonic()
    with pytest.raises(RecordingError, match="is left to finish"):
        recorder.close()
    assert time.monotonic() - began < 10.0  # the longest close of one that works takes 30 s
    recorder.close()
    assert recorder.is_left
    os.kill(recorder.pid, signal.SIGCONT)
    until(lambda: has_ended(recorder.pid))
    recording = read_recording(path)
    assert recording.ticks["tick"].tolist() == list(range(600))
    assert not recording.is_cut


def test_a_recorder_that_is_only_slow_is_waited_for(
    ring: Ring, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = """
import os, time
print('{"ready": true}', flush=True)
for _ in range(24):
    os.read(0, 10000)
    time.sleep(0.05)
while (text := os.read(0, 100000)) and b'"close"' not in text:
    pass
print('{"closed": true}', flush=True)
"""
    monkeypatch.setattr(recorder_module, "STANDSTILL", 0.6)
    monkeypatch.setattr(recorder_module, "_BOOTSTRAP", slow)
    recorder = started(ring, tmp_path / "run.mcap", META, ())
    recorder.wait_until_ready()
    for number in range(3000):
        recorder.event({"event": "mark", "text": "x" * 100}, number)
    recorder.close()
    assert not recorder.is_left


def test_a_recorder_that_takes_records_for_ever_is_left_too(
    ring: Ring, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = started(ring, tmp_path / "run.mcap", META, ())
    recorder.wait_until_ready()
    os.kill(recorder.pid, signal.SIGSTOP)
    monkeypatch.setattr(recorder_module, "MAX_CLOSE", 0.1)
    seconds = iter(np.arange(0.0, 10.0, recorder_module.MAX_CLOSE / 4))

    def later() -> float:
        ring.cursors[TAIL] += 1  # a sign of life
        return float(next(seconds))

    monkeypatch.setattr(recorder_module, "time", SimpleNamespace(monotonic=later))
    with pytest.raises(RecordingError, match=r"has worked for 0\.1 s and is left to finish"):
        recorder.close()
    os.kill(recorder.pid, signal.SIGKILL)


def test_a_recorder_without_a_file_that_stands_still_is_ended(
    ring: Ring, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "STANDSTILL", 0.2)
    recorder = started(ring, None, META, (), live=True)
    recorder.wait_until_ready()
    os.kill(recorder.pid, signal.SIGSTOP)
    recorder.close()
    assert not Path(f"/proc/{recorder.pid}").exists()


def test_a_recorder_of_a_run_without_a_tick_leaves_no_file_when_the_bridge_dies(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.mcap"
    script = (
        "import os, sys; from hapticbridge.recording import Recorder, Ring\n"
        "ring = Ring.shared(512); recorder = Recorder(ring, sys.argv[1], {}, ())\n"
        "recorder.start(); recorder.wait_until_ready()\n"
        "print(recorder.pid, flush=True); os.kill(os.getpid(), 9)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)],
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        timeout=PATIENCE,
    )
    until(lambda: not is_alive(int(done.stdout)))
    assert not path.exists()


@pytest.mark.parametrize("moment", ["process", "thread", "file"])
def test_a_stop_while_the_process_starts_leaves_neither_process_nor_file(
    moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stop comes once the process runs, as the first thread starts, or once the file exists."""
    path = tmp_path / "run.mcap"
    started: list[subprocess.Popen[bytes]] = []
    start = recorder_module.recorder_process

    def struck() -> subprocess.Popen[bytes]:
        started.append(start())
        if moment == "process":
            signal.raise_signal(signal.SIGINT)
        return started[0]

    threads: list[threading.Thread] = []

    class StruckThread(threading.Thread):
        def start(self) -> None:
            super().start()
            threads.append(self)
            is_last = len(threads) == 2
            while moment == "file" and is_last and not path.exists():
                time.sleep(1e-3)
            if moment == "thread" or (moment == "file" and is_last):
                signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(threading, "Thread", StruckThread)
    monkeypatch.setattr(recorder_module, "recorder_process", struck)
    stream = RecordStream(RecordOutput(path), 1e-3, may_wait=True)
    with pytest.raises(KeyboardInterrupt):
        stream.start(META, ())
    stream.close(is_discarded=True)
    assert started[0].poll() is not None
    assert not path.exists()
