"""The recorder's process: every record of a run, also of one that is killed."""

from __future__ import annotations

import io
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import NonSeekingReader
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.record import TICK_DTYPE, TickFlag
from hapticbridge.recording import Attachment, Recorder, Ring, read_recording, repair
from hapticbridge.recording.recorder_process import LiveLine, RunState

META = {"method": "implicit", "device": "{}"}
# larger than what a pipe takes at once
FILES = (Attachment("model.mjb", "application/octet-stream", bytes(range(256)) * 4000),)
PATIENCE = 30.0


def numbered(start: int, stop: int) -> NDArray[np.void]:
    rows = np.zeros(stop - start, TICK_DTYPE)
    rows["tick"] = np.arange(start, stop)
    rows["deadline_ns"] = rows["tick"] * 1_000_000
    # noise, so that the chunks do not shrink to nothing
    rows["tool_position"] = np.random.default_rng(start).normal(size=(stop - start, 3))
    return rows


def produce(ring: Ring, recorder: Recorder, rows: NDArray[np.void]) -> None:
    done = 0
    while done < rows.size:
        done += ring.append(rows[done:])
        assert recorder.is_alive()
        time.sleep(0.001)


def wait_for(path: Path) -> None:
    limit = time.monotonic() + PATIENCE
    while not path.exists():
        assert time.monotonic() < limit, f"{path} did not appear"
        time.sleep(0.01)


def wait_for_end(pid: int) -> None:
    """Waits for a process that is not a child of this one, dead but unreaped included."""
    limit = time.monotonic() + PATIENCE
    status = Path(f"/proc/{pid}/stat")
    while status.exists() and status.read_text().rsplit(")")[-1].split()[0] != "Z":
        assert time.monotonic() < limit, f"process {pid} did not end"
        time.sleep(0.01)


@pytest.fixture
def ring() -> Iterator[Ring]:
    ring = Ring.shared(512)
    yield ring
    ring.close()


def process_of(recorder: Recorder) -> int:
    return recorder.pid


def test_recorder_writes_every_record_and_event_of_a_run(ring: Ring, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    rows = numbered(0, 3000)
    recorder = Recorder(ring, path, META, FILES, epoch_ns=7)
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
    assert recording.meta == {**META, "epoch_ns": "7"}
    assert recording.attachments["model.mjb"] == FILES[0].data
    assert recording.digest == recording.computed_digest
    assert recording.problems == ()
    assert ring.pending() == 0


def test_records_that_wait_at_the_close_are_drained(ring: Ring, tmp_path: Path) -> None:
    recorder = Recorder(ring, tmp_path / "run.mcap", META, ())
    ring.append(numbered(0, 512))
    recorder.close()
    assert read_recording(tmp_path / "run.mcap").ticks["tick"].tolist() == list(range(512))


def test_events_beyond_the_pipe_wait_and_all_arrive(ring: Ring, tmp_path: Path) -> None:
    recorder = Recorder(ring, tmp_path / "run.mcap", META, ())
    recorder.wait_until_ready()
    os.kill(process_of(recorder), signal.SIGSTOP)
    for number in range(3000):
        recorder.event({"event": "mark", "text": "x" * 100, "number": number}, number)
    os.kill(process_of(recorder), signal.SIGCONT)
    recorder.close()
    events = read_recording(tmp_path / "run.mcap").events
    assert [event["number"] for event in events] == list(range(3000))


def test_interrupt_and_termination_leave_closing_to_bridge(ring: Ring, tmp_path: Path) -> None:
    recorder = Recorder(ring, tmp_path / "run.mcap", META, ())
    recorder.wait_until_ready()
    assert os.getpgid(process_of(recorder)) != os.getpgid(0)
    for signal_number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(process_of(recorder), signal_number)
    produce(ring, recorder, numbered(0, 600))
    recorder.close()
    assert read_recording(tmp_path / "run.mcap").ticks.size == 600


def test_recorder_loads_neither_mujoco_nor_the_compiler(ring: Ring, tmp_path: Path) -> None:
    recorder = Recorder(ring, tmp_path / "run.mcap", META, ())
    recorder.wait_until_ready()
    loaded = Path(f"/proc/{process_of(recorder)}/maps").read_text()
    recorder.close()
    assert "zstandard" in loaded
    assert "mujoco" not in loaded
    assert "llvmlite" not in loaded


def test_what_cannot_be_recorded_is_refused_before_the_run(ring: Ring, tmp_path: Path) -> None:
    for path, reason in (
        (tmp_path / "none" / "run.mcap", "the folder .* does not exist"),
        (tmp_path, "Is a directory"),
        (Path("/dev/full"), "No space left on device"),
    ):
        recorder = Recorder(ring, path, META, FILES)
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
    recorder = Recorder(ring, path, META, ())
    recorder.wait_until_ready()
    # stands for a full disk: the process may not let a file grow beyond this
    resource.prlimit(process_of(recorder), resource.RLIMIT_FSIZE, (50_000, 50_000))
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
    recorder = Recorder(ring, tmp_path / "run.mcap", META, ())
    recorder.wait_until_ready()
    os.kill(process_of(recorder), signal.SIGKILL)
    limit = time.monotonic() + PATIENCE
    while recorder.is_alive():
        assert time.monotonic() < limit
        time.sleep(0.01)
    recorder.event({"event": "late"}, 0)
    with pytest.raises(RecordingError, match=r"killed by signal 9.*hapticbridge repair"):
        recorder.close()
    assert read_recording(tmp_path / "run.mcap").is_cut


BRIDGE = """
import os, signal, sys, time
sys.path.insert(0, sys.argv[1])
from test_recording_recorder import FILES, META, numbered
from hapticbridge.recording import Recorder, Ring

_, _, path, count, victims, fork = sys.argv
ring = Ring.shared(512)
recorder = Recorder(ring, path, META, FILES)
recorder.wait_until_ready()
if fork == "fork" and os.fork() == 0:  # a worker that keeps the recorder's pipe open
    print(os.getpid(), flush=True)
    time.sleep(60)
recorder.event({"event": "start"}, 0)
rows, done = numbered(0, int(count)), 0
while done < rows.size:
    done += ring.append(rows[done:])
print(recorder.pid, ring.name, flush=True)
if victims == "both":
    while ring.pending():
        time.sleep(0.005)
    os.kill(recorder.pid, signal.SIGKILL)
os.kill(os.getpid(), signal.SIGKILL)
"""


def killed_bridge(path: Path, count: int, victims: str, fork: str = "") -> list[str]:
    """Runs a bridge that ends itself by kill -9; returns what it printed."""
    arguments = [str(Path(__file__).parent), str(path), str(count), victims, fork]
    with subprocess.Popen(
        [sys.executable, "-c", BRIDGE, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as bridge:
        assert bridge.wait() == -signal.SIGKILL
        assert bridge.stdout is not None
        assert bridge.stderr is not None
        lines = [bridge.stdout.readline() for _ in range(2 if fork else 1)]
        words = sorted(lines, key=lambda line: len(line.split()))
        if fork:
            wait_for_end(int(words[-1].split()[0]))
            os.kill(int(words[0]), signal.SIGKILL)
        else:
            wait_for_end(int(words[-1].split()[0]))
        assert bridge.stderr.read() == ""
    return words[-1].split()


@pytest.mark.parametrize("fork", ["", "fork"])
def test_killed_bridge_leaves_a_whole_recording_that_says_so(tmp_path: Path, fork: str) -> None:
    path = tmp_path / "run.mcap"
    _, ring_name = killed_bridge(path, 2000, "bridge", fork)
    recording = read_recording(path)
    assert not recording.is_cut
    assert recording.problems == ()
    assert recording.digest == recording.computed_digest
    assert (recording.ticks == numbered(0, 2000)).all()
    assert recording.events == [
        {"event": "start", "time_ns": 0},
        {"event": "bridge_died", "tick": 1999, "time_ns": 1_999_000_000},
    ]
    assert not Path(ring_name).exists()


def test_killed_bridge_and_recorder_lose_one_chunk_at_most_and_repair_mends(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    killed_bridge(path, 2000, "both")
    recording = read_recording(path)
    assert recording.is_cut
    assert recording.digest is None
    assert recording.problems == ()
    # one chunk of 128 kB and one batch that was taken from the ring but not written yet
    assert 2000 - 302 - 512 <= recording.ticks.size < 2000
    assert (recording.ticks == numbered(0, 2000)[: recording.ticks.size]).all()
    mended = repair(path, tmp_path / "mended.mcap")
    assert not mended.is_cut
    assert mended.digest == mended.computed_digest
    assert (mended.ticks == recording.ticks).all()
    with (tmp_path / "mended.mcap").open("rb") as stream:
        messages = list(NonSeekingReader(stream, validate_crcs=True).iter_messages(["/tick"]))
    assert len(messages) == recording.ticks.size


def test_live_line_in_a_file_is_plain_text(ring: Ring, capfd: pytest.CaptureFixture[str]) -> None:
    recorder = Recorder(ring, None, META, (), live=True)
    recorder.wait_until_ready()
    rows = numbered(0, 101)
    rows["wrench_on_tool"][-1] = (3.0, 0.0, -4.0, 9.0, 9.0, 9.0)
    rows["environment_energy"] = -3.4e-3
    rows["device_energy"] = -1.04e-3
    rows["flags"][[5, 9]] = TickFlag.OVERRUN | TickFlag.CONTACT
    produce(ring, recorder, rows)
    recorder.close()
    assert capfd.readouterr() == (
        "",
        "0.1 s  5.0 N  environment -3.4 mJ  device -1.0 mJ  2 overruns\n",
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
    assert "2.0 s  0.0 N  environment 0.0 mJ  device 0.0 mJ  0 overruns" in text
    assert text.count("\n") <= 2
