"""The ring between two processes, against a queue."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.recording import HEAD, TAIL, Ring
from hapticbridge.recording import ring as ring_module


def numbered(start: int, stop: int) -> NDArray[np.void]:
    rows = np.zeros(stop - start, TICK_DTYPE)
    rows["tick"] = np.arange(start, stop)
    rows["wrench_on_tool"] = rows["tick"][:, None] + np.arange(6) / 8
    return rows


@pytest.fixture
def shared() -> Iterator[Ring]:
    ring = Ring.shared(7)
    yield ring
    ring.close()


@given(
    capacity=st.integers(1, 9),
    steps=st.lists(st.tuples(st.booleans(), st.integers(0, 12)), max_size=40),
)
def test_ring_is_a_bounded_queue_that_refuses(capacity: int, steps: list[tuple[bool, int]]) -> None:
    ring, queue, written = Ring.local(capacity), list[int](), 0
    for is_write, count in steps:
        if is_write:
            taken = ring.append(numbered(written, written + count))
            assert taken == min(count, capacity - len(queue))
            queue += range(written, written + taken)
            written += taken
        else:
            read = ring.take(count)
            expected, queue = queue[:count], queue[count:]
            assert read["tick"].tolist() == expected
            assert (read["wrench_on_tool"][:, 1] == read["tick"] + 1 / 8).all()
        assert ring.pending() == len(queue)
        assert (ring.cursors[HEAD], ring.cursors[TAIL]) == (written, written - len(queue))


def test_cursors_and_rows_have_the_shape_that_the_kernel_relies_on(shared: Ring) -> None:
    assert (HEAD, TAIL) == (0, 1)
    for ring in (Ring.local(7), shared):
        assert ring.rows.shape == (7,)
        assert ring.rows.dtype == TICK_DTYPE
        assert ring.cursors.shape == (8,)
        assert ring.cursors.dtype == np.int64
        assert not ring.cursors.any()
        assert ring.rows.ctypes.data % 8 == 0
        assert ring.rows.flags.c_contiguous


@given(written=st.integers(0, 30), unread=st.integers(0, 5), count=st.integers(0, 12))
def test_latest_gives_newest_records_oldest_first(written: int, unread: int, count: int) -> None:
    ring = Ring.local(5)
    for tick in range(written):
        ring.append(numbered(tick, tick + 1))
        ring.take(max(0, ring.pending() - unread))
    kept = min(count, 5, int(ring.cursors[HEAD]))
    newest = ring.rows["tick"].max() if ring.cursors[HEAD] else -1
    assert ring.latest(count)["tick"].tolist() == list(range(newest - kept + 1, newest + 1))


class Watched(np.ndarray[tuple[int], np.dtype[np.int64]]):
    """Cursors beside which a producer goes on, before and after each look at its own."""

    produce: Callable[[], None] = staticmethod(lambda: None)
    seen: int

    def __getitem__(self, index: Any) -> Any:
        self.produce()
        self.seen = super().__getitem__(index)
        self.produce()
        return self.seen


@given(capacity=st.integers(2, 9), written=st.lists(st.integers(0, 12), min_size=1, max_size=60))
def test_who_reads_on_misses_only_the_overwritten(capacity: int, written: list[int]) -> None:
    cursors = np.zeros(8, np.int64).view(Watched)
    ring, counts, end = Ring(np.zeros(capacity, TICK_DTYPE), cursors), iter(written), 0

    def write() -> None:
        nonlocal end
        for row in numbered(end, end + next(counts, 0)):
            ring.rows[end % capacity] = row
            end += 1
        # it may be amid the next one, too
        ring.rows[end % capacity]["tick"] = -1
        cursors[HEAD] = end

    cursors.produce = write
    number = 0
    for _ in written:
        asked, before = number, end
        first, rows = ring.since(asked)
        number = first + len(rows)
        np.testing.assert_array_equal(rows["tick"], np.arange(first, number))
        assert asked <= first <= number
        assert number >= before  # all that was there is told, unless it is gone
        assert first == asked or first == cursors.seen - capacity + 1


def test_what_is_taken_is_a_copy() -> None:
    ring = Ring.local(2)
    ring.append(numbered(0, 2))
    taken, latest = ring.take(2), ring.latest(2)
    ring.append(numbered(5, 7))
    assert taken["tick"].tolist() == latest["tick"].tolist() == [0, 1]


def test_attached_ring_sees_what_the_owner_writes_and_frees_its_places(shared: Ring) -> None:
    assert shared.name is not None
    other = Ring.attach(shared.name)
    assert shared.append(numbered(0, 9)) == 7
    assert other.take(4)["tick"].tolist() == [0, 1, 2, 3]
    assert shared.pending() == 3
    assert shared.append(numbered(7, 20)) == 4
    assert other.take(99)["tick"].tolist() == list(range(4, 11))


def test_records_pass_unchanged_between_a_writing_and_a_reading_thread() -> None:
    ring, total = Ring.local(256), 5000

    def produce() -> None:
        rows, done = numbered(0, total), 0
        while done < total:
            done += ring.append(rows[done : done + 37])

    producer = threading.Thread(target=produce)
    producer.start()
    read: list[NDArray[np.void]] = []
    while sum(rows.size for rows in read) < total:
        read.append(ring.take(101))
    producer.join()
    assert (np.concatenate(read) == numbered(0, total)).all()


def test_arrays_stay_valid_after_close_and_the_name_is_gone() -> None:
    ring = Ring.shared(3)
    ring.append(numbered(0, 3))
    assert ring.name is not None
    ring.close()
    ring.close()
    assert ring.latest(3)["tick"].tolist() == [0, 1, 2]
    with pytest.raises(RecordingError, match="no ring at"):
        Ring.attach(ring.name)


def test_closing_an_attached_ring_leaves_the_memory_to_its_owner(shared: Ring) -> None:
    assert shared.name is not None
    Ring.attach(shared.name).close()
    assert Path(shared.name).exists()
    Ring.attach(shared.name)


def test_process_that_attaches_and_exits_neither_removes_the_ring_nor_prints(shared: Ring) -> None:
    script = "import sys; from hapticbridge.recording import Ring; Ring.attach(sys.argv[1])"
    done = subprocess.run(
        [sys.executable, "-c", script, str(shared.name)], capture_output=True, check=True
    )
    assert done.stderr == b""
    assert Path(str(shared.name)).exists()


def test_ring_of_a_killed_process_is_swept_and_a_living_one_is_not(shared: Ring) -> None:
    script = (
        "import os, signal; from hapticbridge.recording import Ring; ring = Ring.shared(3);"
        "print(ring.name, flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    )
    killed = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    left = Path(killed.stdout.decode().strip())
    assert killed.stderr == b""
    assert left.exists()
    Ring.shared(3).close()
    assert not left.exists()
    assert Path(str(shared.name)).exists()


@pytest.mark.parametrize("content", [b"", b"short", bytes(4096), b"hbring01" + b"\xff" * 4096])
def test_what_is_no_ring_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "ring"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="ring"):
        Ring.attach(str(path))
    for make in (Ring.local, Ring.shared):
        for capacity in (0, -1):
            with pytest.raises(RecordingError, match=f"at least 1 record, not {capacity}"):
                make(capacity)


FORMS: dict[str, Callable[[Path, Path], object]] = {
    "pipe": lambda path, _: os.mkfifo(path),
    "link": lambda path, other: path.symlink_to(other),
    "link to nothing": lambda path, other: path.symlink_to(other.with_name("none")),
    "folder": lambda path, _: path.mkdir(),
    "file": lambda path, other: path.write_bytes(other.read_bytes()),
}
"""Files in the place of a ring, beside a ring that is whole."""


@pytest.fixture
def planted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> Iterator[Path]:
    """Something planted in the folder of shared memory, under a name like a ring's."""
    monkeypatch.setattr("hapticbridge.recording.ring.memory_folder", lambda: tmp_path)
    good = Ring.shared(3)
    path = tmp_path / "hapticbridge-ring-1-planted"
    FORMS[request.param](path, Path(str(good.name)))
    if request.param == "file":  # a file of another user
        path.chmod(0o666)
        monkeypatch.setattr("os.getuid", lambda: path.stat().st_uid + 1)
    yield path
    good.close()


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX files")
@pytest.mark.parametrize("planted", FORMS, indirect=True)
def test_what_another_user_planted_stops_no_ring_and_is_taken_for_none(
    planted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers: list[object] = []

    def attach() -> None:
        try:
            answers.append(Ring.attach(str(planted)))
        except RecordingError as error:
            answers.append(error)

    def make() -> None:  # sweeps the folder before
        monkeypatch.undo()
        monkeypatch.setattr("hapticbridge.recording.ring.memory_folder", lambda: planted.parent)
        with_time = Ring.shared(3)
        answers.append(with_time.append(numbered(0, 3)))
        with_time.close()

    for act in (attach, make):
        thread = threading.Thread(target=act, daemon=True)  # it would wait for the pipe's writer
        thread.start()
        thread.join(10.0)
        assert not thread.is_alive()
    assert isinstance(answers[0], RecordingError)
    assert answers[1] == 3


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX files")
@pytest.mark.parametrize("planted", ["file"], indirect=True)
def test_a_sweep_leaves_what_belongs_to_another_user(planted: Path) -> None:
    planted.chmod(0o600)
    Ring.shared(3).close()
    assert planted.exists()


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX files")
@pytest.mark.parametrize("umask", [0o000, 0o022, 0o777])
def test_a_ring_is_its_owners_alone_under_any_umask(umask: int) -> None:
    before = os.umask(umask)
    try:
        ring = Ring.shared(3)
        found = Path(str(ring.name)).stat()
        other = Ring.attach(str(ring.name))
    finally:
        os.umask(before)
    assert stat.S_IMODE(found.st_mode) == 0o600
    assert ring.append(numbered(0, 3)) == len(other.take(9))
    ring.close()


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX files")
@pytest.mark.parametrize("mode", [0o620, 0o602])
def test_a_segment_that_others_can_write_is_not_mapped(shared: Ring, mode: int) -> None:
    Path(str(shared.name)).chmod(mode)
    with pytest.raises(RecordingError, match="this user alone"):
        Ring.attach(str(shared.name))


def test_a_fence_releases_a_lock_before_it_acquires_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """On ARMv8 this order alone is a full barrier: acquiring, then releasing, lets both sides in.

    The machines of these tests are x86, where each of them is one.
    """
    steps: list[str] = []

    class Noting:
        def __enter__(self) -> None:
            steps.append("acquire")

        def __exit__(self, *_: object) -> None:
            steps.append("release")

    monkeypatch.setattr(ring_module, "ORDER", Noting())
    ring_module.fence()
    assert "acquire" in steps[steps.index("release") :]


@pytest.mark.skipif(ring_module.memory_folder() != Path("/dev/shm"), reason="needs /dev/shm")
@pytest.mark.parametrize("is_shared", [True, False])
def test_memory_that_a_container_lacks_is_told_with_its_option(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_shared: bool
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("hapticbridge.recording.ring.mmap.mmap", full)
    if not is_shared:
        monkeypatch.setattr("hapticbridge.recording.ring.memory_folder", lambda: tmp_path)
    with pytest.raises(RecordingError, match="No space left on device") as told:
        Ring.shared(1000)
    assert ("--shm-size" in str(told.value)) is is_shared
