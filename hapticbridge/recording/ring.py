"""Shared memory between the loop and its readers: the ring of records, and the newest positions."""

from __future__ import annotations

import contextlib
import errno
import mmap
import os
import secrets
import stat
import sys
import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.files import limit_words
from hapticbridge.kernel.record import TICK_DTYPE

if TYPE_CHECKING:
    import mujoco

# Shared memory of a ring

if sys.platform != "win32":
    import fcntl

_PREFIX = "hapticbridge-ring-"
_MEMORY = Path("/dev/shm")


def memory_folder() -> Path:
    """Returns the folder of shared memory: Linux's memory file system, else the temporary folder.

    ``multiprocessing.shared_memory`` does not fit. Before Python 3.13 its resource tracker also
    tracks attached processes, removes the memory under its owner, and prints about leaks after a
    kill. A confined process (``confinement``) may not open it.
    """
    try:
        os.close(os.open(_MEMORY, os.O_RDONLY))
    except OSError:
        return Path(tempfile.gettempdir())
    return _MEMORY if os.access(_MEMORY, os.W_OK) else Path(tempfile.gettempdir())


def created(content: str, size: int) -> tuple[mmap.mmap, str]:
    """Creates zeroed shared memory of ``size`` bytes for a content in words; returns its name too.

    Segments left by killed processes are removed.

    Raises:
        RecordingError: Memory is insufficient.
    """
    folder = memory_folder()
    try:
        _sweep(folder)
        memory, path = _created(folder, size)
    except OSError as error:
        reason = limit_words(error.errno) or error.strerror
        if error.errno == errno.ENOSPC and folder == _MEMORY:
            reason = f"{reason}; in a container '--shm-size 1g' of 'docker run' gives it more"
        raise RecordingError(
            f"no room for {content} ({size} bytes) in {folder}: {reason}"
        ) from error
    return memory, str(path)


def removed(name: str | None) -> None:
    """Removes the name of shared memory, if it has one; its arrays stay valid."""
    if name is not None:
        with contextlib.suppress(OSError):  # already gone, or Windows: still mapped
            Path(name).unlink()


ORDER = threading.Lock()
"""Lock of ``fence``, free between its calls."""


def fence() -> None:
    """Orders all accesses to shared memory before it and all after it (full barrier).

    Python has no memory fence. On x86 one atomic operation is a full barrier. On ARMv8 acquiring
    and releasing a lock is none: accesses from both sides may move into it and pass each other
    there. A release followed by an acquisition is one (ARM's manual, B2.3: barrier-ordered-before),
    so the lock is used twice. Not tested on ARM hardware.
    """
    for _ in range(2):
        with ORDER:
            pass


def _created(folder: Path, size: int) -> tuple[mmap.mmap, Path]:
    path = folder / f"{_PREFIX}{os.getpid()}-{secrets.token_hex(6)}"
    while True:
        file = _opened(path, os.O_RDWR | os.O_CREAT | os.O_EXCL)
        try:
            _lock(file)
            # another process's sweep may have removed the file before it was locked
            if os.fstat(file).st_nlink == 0:
                continue
            # write all of it, so that a full file system fails here, not as a bus error in a tick
            with open(file, "wb", closefd=False) as stream:
                stream.write(bytes(size))
            memory = mmap.mmap(file, size)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        finally:
            os.close(file)
        # touch every page once, so that the loop has no page fault
        np.frombuffer(memory, np.uint8)[:] = 0
        return memory, path


def attached(name: str) -> mmap.mmap:
    """Maps shared memory created by another process.

    Raises:
        RecordingError: It does not exist or cannot be mapped.
    """
    try:
        file = _opened(name, os.O_RDWR)
    except OSError as error:
        raise RecordingError(f"no ring at {name}: {error.strerror}") from error
    try:
        _lock(file)
        return mmap.mmap(file, 0)
    except (OSError, ValueError) as error:
        raise RecordingError(f"{name} cannot be mapped as a ring: {error}") from error
    finally:
        os.close(file)


_GUARDED = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC"))
"""Flags under which neither a planted link leads elsewhere nor a planted pipe blocks."""


def _opened(path: str | Path, flags: int) -> int:
    """Opens or creates a segment of this user alone, whatever the umask.

    Every user may write into the folder of shared memory, and the names there start alike.

    Raises:
        OSError: It does not exist, or is a link, a pipe, or a file that another user can write.
    """
    file = os.open(path, flags | _GUARDED, 0o600)
    if sys.platform == "win32":
        return file
    status = os.fstat(file)
    if flags & os.O_CREAT:
        os.fchmod(file, 0o600)
    elif not stat.S_ISREG(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o022:
        os.close(file)
        raise OSError(errno.EPERM, "it is not a file that this user alone can write")
    return file


def _lock(file: int) -> None:
    """Marks a segment as in use until the process that maps it ends."""
    if sys.platform != "win32":
        fcntl.flock(file, fcntl.LOCK_SH)


def _sweep(folder: Path) -> None:
    """Removes segments that no living process maps."""
    if sys.platform == "win32":
        return
    for path in folder.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):  # in use, planted by another user, or gone meanwhile
            file = _opened(path, os.O_RDONLY)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink()
            finally:
                os.close(file)


HEAD = 0
"""Index of ``Ring.cursors`` with the number of records written; only the producer changes it."""

TAIL = 1
"""Index of ``Ring.cursors`` with the number of records read; only the consumer changes it."""

_CURSORS = 8
_MAGIC = int.from_bytes(b"hbring01", "little")
_HEADER = np.dtype([("magic", "<i8"), ("record_size", "<i8"), ("capacity", "<i8"), ("rest", "V40")])
_ROWS_OFFSET = _HEADER.itemsize + 8 * _CURSORS


class Ring:
    """Ring of tick records, in this process's memory or shared between processes.

    It has one producer (the tick's kernel) and one consumer (the recorder); neither waits for the
    other. The producer refuses a record if ``cursors[HEAD] - cursors[TAIL] >= capacity`` and counts
    it, and the audit reports the gap. Otherwise it writes ``rows[cursors[HEAD] % capacity]``,
    issues a release fence, and only then increments ``cursors[HEAD]``. A producer that dies inside
    a record therefore leaves no torn one.

    The memory stays mapped while any of its arrays is in use, also after ``close``.

    Attributes:
        rows: Records, shape (capacity,), ``TICK_DTYPE``.
        cursors: Shape (8,), int64; see ``HEAD`` and ``TAIL``, the rest is reserved and zero.
        name: Name for ``attach`` (path of the shared memory); None for a local ring.
    """

    def __init__(
        self,
        rows: NDArray[np.void],
        cursors: NDArray[np.int64],
        name: str | None = None,
        *,
        is_owner: bool = False,
    ) -> None:
        self.rows = rows
        self.cursors = cursors
        self.name = name
        self._is_owner = is_owner

    @classmethod
    def local(cls, capacity: int) -> Ring:
        """Returns a ring in this process's own memory.

        Raises:
            RecordingError: The capacity is below 1.
        """
        _check_capacity(capacity)
        return cls(np.zeros(capacity, TICK_DTYPE), np.zeros(_CURSORS, np.int64))

    @classmethod
    def shared(cls, capacity: int) -> Ring:
        """Creates a ring in shared memory; ``close`` removes its name.

        Segments left by killed processes are removed. One record takes 400 bytes.

        Raises:
            RecordingError: The capacity is below 1, or memory is insufficient.
        """
        _check_capacity(capacity)
        size = _ROWS_OFFSET + capacity * TICK_DTYPE.itemsize
        memory, name = created(f"a ring of {capacity} records", size)
        header = np.frombuffer(memory, _HEADER, count=1)
        header["record_size"] = TICK_DTYPE.itemsize
        header["capacity"] = capacity
        header["magic"] = _MAGIC
        return cls._mapped(memory, capacity, name, is_owner=True)

    @classmethod
    def attach(cls, name: str) -> Ring:
        """Opens a ring created by another process.

        Raises:
            RecordingError: There is no such ring, or it is not one of this version.
        """
        memory = attached(name)
        if len(memory) >= _ROWS_OFFSET:
            header = np.frombuffer(memory, _HEADER, count=1)[0]
            capacity = int(header["capacity"])
            size = _ROWS_OFFSET + capacity * TICK_DTYPE.itemsize
            fits = capacity >= 1 and size <= len(memory)
            if header["magic"] == _MAGIC and header["record_size"] == TICK_DTYPE.itemsize and fits:
                return cls._mapped(memory, capacity, name, is_owner=False)
        raise RecordingError(f"{name} is not a ring of this version of hapticbridge")

    @classmethod
    def _mapped(cls, memory: mmap.mmap, capacity: int, name: str, *, is_owner: bool) -> Ring:
        cursors = np.frombuffer(memory, np.int64, count=_CURSORS, offset=_HEADER.itemsize)
        rows = np.frombuffer(memory, TICK_DTYPE, count=capacity, offset=_ROWS_OFFSET)
        return cls(rows, cursors, name, is_owner=is_owner)

    @property
    def capacity(self) -> int:
        """Number of records that the ring holds."""
        return int(self.rows.size)

    def pending(self) -> int:
        """Returns the number of records written and not yet read."""
        return int(self.cursors[HEAD] - self.cursors[TAIL])

    def append(self, rows: NDArray[np.void]) -> int:
        """Writes records as the producer, as the kernel's compiled producer does.

        Returns:
            Number of records written, from the first on; a full ring refuses the rest.
        """
        head = int(self.cursors[HEAD])
        taken = min(int(rows.size), self.capacity - self.pending())
        self.rows[(head + np.arange(taken)) % self.capacity] = rows[:taken]
        fence()
        self.cursors[HEAD] = head + taken
        return taken

    def take(self, limit: int) -> NDArray[np.void]:
        """Reads records as the consumer, and frees their places.

        Returns:
            A copy of the oldest unread records, oldest first; empty if there is none.
        """
        tail = int(self.cursors[TAIL])
        count = min(self.pending(), limit)
        fence()
        taken = self._copy(tail, tail + count)
        fence()
        self.cursors[TAIL] = tail + count
        return taken

    def latest(self, count: int) -> NDArray[np.void]:
        """Copies the newest records in the ring, read or not, without freeing them.

        While the producer runs, request fewer than the capacity: the oldest record's place is
        written next.

        Returns:
            The records, oldest first.
        """
        head = int(self.cursors[HEAD])
        fence()
        start = max(0, head - self.capacity, head - count)
        copied = self._copy(start, head)
        fence()
        # drop the records that the producer has overwritten meanwhile
        overwritten = int(self.cursors[HEAD]) - self.capacity - start
        return copied[overwritten:] if overwritten > 0 else copied

    def since(self, number: int) -> tuple[int, NDArray[np.void]]:
        """Copies the records from a number on that are still in the ring, without freeing them.

        Numbers count from the ring's start.

        Returns:
            Number of the first available record, and the records, oldest first.
        """
        head = int(self.cursors[HEAD])
        fence()
        # the oldest place of a full ring is written next
        start = max(min(number, head), head - self.capacity + 1)
        copied = self._copy(start, head)
        fence()
        overwritten = max(int(self.cursors[HEAD]) - self.capacity + 1 - start, 0)
        return start + overwritten, copied[overwritten:]

    def close(self) -> None:
        """Removes the shared memory's name if this ring created it; its arrays stay valid."""
        if self._is_owner:
            self.unlink()

    def unlink(self) -> None:
        """Removes the shared memory's name, also for an owner that died."""
        removed(self.name)

    def _copy(self, start: int, stop: int) -> NDArray[np.void]:
        first, count = start % self.capacity, stop - start
        if first + count <= self.capacity:
            return self.rows[first : first + count].copy()
        return np.concatenate((self.rows[first:], self.rows[: first + count - self.capacity]))


def _check_capacity(capacity: int) -> None:
    if capacity < 1:
        raise RecordingError(f"a ring must hold at least 1 record, not {capacity}")


# Newest positions of the scene

SEQUENCE, NUMBER, CONTACTS = 0, 1, 2
"""Indices into ``Snapshot.head``. The sequence is odd while the loop writes. The number is that
of the tick's record in the ring, counted from the ring's start. The third is the number of
contacts with a force."""

MAX_CONTACTS = 32
"""Largest number of contacts in a picture; in a larger heap no single one can be distinguished."""

_HEAD = 8
_ATTEMPTS = 100


def snapshot_dtype(model: mujoco.MjModel) -> np.dtype[np.void]:
    """Returns the layout of a scene's picture; all numbers are 64-bit floats."""
    return np.dtype(
        [
            ("slack", "<f8"),
            ("qpos", "<f8", (model.nq,)),
            ("mocap_pos", "<f8", (model.nmocap, 3)),
            ("mocap_quat", "<f8", (model.nmocap, 4)),
            ("contacts", "<f8", (MAX_CONTACTS, 2, 3)),
        ]
    )


@dataclass(frozen=True, slots=True)
class Picture:
    """Positions of a scene after one tick.

    Attributes:
        number: Number of the tick's record in the ring, counted from the ring's start.
        slack: Energy in J that the environment may have created by then.
        qpos: Generalised positions, (nq,).
        mocap_pos: Positions of mocap bodies in m, (nmocap, 3).
        mocap_quat: Orientations of mocap bodies, (nmocap, 4).
        contacts: Position in m and force in N of each contact with a force, in the world frame,
            (n, 2, 3) with n <= ``MAX_CONTACTS``.
    """

    number: int
    slack: float
    qpos: NDArray[np.float64]
    mocap_pos: NDArray[np.float64]
    mocap_quat: NDArray[np.float64]
    contacts: NDArray[np.float64]


class Snapshot:
    """The newest picture of a scene, in shared memory or in this process's own.

    A record has the poses of handle and tool only. A view draws all bodies, so the loop also
    publishes the generalised positions, mocap poses and contacts of one tick, about 30 times per
    second. The loop never waits; a reader that meets a write reads again. ``memory`` has
    ``size_of(model)`` zeroed bytes; an owner removes the name on ``close``.

    Attributes:
        head: Shape (8,), int64; see ``SEQUENCE``.
        numbers: Shape (n,), float64, in the layout of ``snapshot_dtype``.
        name: Path for ``attach``; None for memory of this process alone.
    """

    def __init__(
        self, memory: Any, model: mujoco.MjModel, name: str | None = None, *, is_owner: bool = False
    ) -> None:
        layout = snapshot_dtype(model)
        self.head = np.frombuffer(memory, np.int64, count=_HEAD)
        offset = self.head.nbytes
        self.numbers = np.frombuffer(memory, np.float64, layout.itemsize // 8, offset)
        self.name = name
        self._layout, self._is_owner = layout, is_owner

    @classmethod
    def shared(cls, model: mujoco.MjModel) -> Snapshot:
        """Creates shared memory for a scene; ``close`` removes its name.

        Raises:
            RecordingError: Memory is insufficient.
        """
        memory, name = created("the positions of the scene", size_of(model))
        return cls(memory, model, name, is_owner=True)

    @classmethod
    def attach(cls, name: str, model: mujoco.MjModel) -> Snapshot:
        """Opens shared memory created by another process.

        Raises:
            RecordingError: It does not exist, or belongs to another scene.
        """
        memory = attached(name)
        if len(memory) != size_of(model):
            raise RecordingError(f"{name} has {len(memory)} bytes, the scene {size_of(model)}")
        return cls(memory, model, name)

    def read(self) -> Picture | None:
        """Returns the newest picture; None before the first, or if each read met a write."""
        for _ in range(_ATTEMPTS):
            sequence = int(self.head[SEQUENCE])
            fence()
            number, count = int(self.head[NUMBER]), int(self.head[CONTACTS])
            numbers = self.numbers.copy()
            fence()
            if sequence == 0:
                return None
            if sequence % 2 == 0 and sequence == int(self.head[SEQUENCE]):
                row = numbers.view(self._layout)[0]
                return Picture(
                    number=number,
                    slack=float(row["slack"]),
                    qpos=row["qpos"],
                    mocap_pos=row["mocap_pos"],
                    mocap_quat=row["mocap_quat"],
                    contacts=row["contacts"][:count],
                )
        return None

    def close(self) -> None:
        """Removes the shared memory's name if this object created it; its arrays stay valid."""
        if self._is_owner:
            removed(self.name)


def size_of(model: mujoco.MjModel) -> int:
    """Returns the size of a scene's snapshot in bytes."""
    return 8 * _HEAD + snapshot_dtype(model).itemsize
