"""The shared-memory ring between the loop and whoever reads its records.

One producer (the tick's kernel), one consumer (the recorder). Neither waits for the other: a full
ring refuses the record, the producer counts that, and the audit sees the gap.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import secrets
import sys
import tempfile
import threading
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.record import TICK_DTYPE

# The shared memory of a ring: a file in memory under a name, which is gone when nobody maps it.

if sys.platform != "win32":
    import fcntl

_PREFIX = "hapticbridge-ring-"


def memory_folder() -> Path:
    """Returns where shared memory lives: Linux's memory file system, else the temporary folder.

    Not ``multiprocessing.shared_memory``: before Python 3.13 its resource tracker also tracks
    whoever attaches, removes the memory under its owner, and prints about leaks after a kill.
    """
    memory = Path("/dev/shm")
    usable = memory.is_dir() and os.access(memory, os.W_OK)
    return memory if usable else Path(tempfile.gettempdir())


def created(folder: Path, size: int) -> tuple[mmap.mmap, Path]:
    """Creates shared memory that is zero, under a name that nobody else has.

    Segments that a killed process left behind are removed on the way.

    Args:
        folder: Where.
        size: In bytes.

    Raises:
        OSError: There is no room.
    """
    _sweep(folder)
    path = folder / f"{_PREFIX}{os.getpid()}-{secrets.token_hex(6)}"
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            _lock(file)
            # a sweep may have found the file in the instant before it was locked
            if os.fstat(file).st_nlink == 0:
                continue
            # written out, so that a full file system says so here and not as a bus error in a tick
            with open(file, "wb", closefd=False) as stream:
                stream.write(bytes(size))
            memory = mmap.mmap(file, size)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        finally:
            os.close(file)
        # every page is touched once, so that the loop meets no page fault
        np.frombuffer(memory, np.uint8)[:] = 0
        return memory, path


def attached(name: str) -> mmap.mmap:
    """Maps the shared memory that another process created.

    Raises:
        RecordingError: There is none of that name, or it cannot be mapped.
    """
    try:
        file = os.open(name, os.O_RDWR | getattr(os, "O_CLOEXEC", 0))
    except OSError as error:
        raise RecordingError(f"no ring at {name}: {error.strerror}") from error
    try:
        _lock(file)
        return mmap.mmap(file, 0)
    except (OSError, ValueError) as error:
        raise RecordingError(f"{name} cannot be mapped as a ring: {error}") from error
    finally:
        os.close(file)


def _lock(file: int) -> None:
    """Marks a segment as in use; the mapping keeps the mark until its process ends."""
    if sys.platform != "win32":
        fcntl.flock(file, fcntl.LOCK_SH)


def _sweep(folder: Path) -> None:
    """Removes segments that no living process maps: bridge and recorder were both killed."""
    if sys.platform == "win32":
        return
    for path in folder.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):  # in use, of another user, or gone meanwhile
            file = os.open(path, os.O_RDONLY)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink()
            finally:
                os.close(file)


HEAD = 0
"""Index into ``Ring.cursors``: records written since the start; only the producer changes it."""

TAIL = 1
"""Index into ``Ring.cursors``: records read since the start; only the consumer changes it."""

_CURSORS = 8
_MAGIC = int.from_bytes(b"hbring01", "little")
_HEADER = np.dtype([("magic", "<i8"), ("record_size", "<i8"), ("capacity", "<i8"), ("rest", "V40")])
_ROWS_OFFSET = _HEADER.itemsize + 8 * _CURSORS


class Ring:
    """A ring of tick records, in this process's memory or shared between processes.

    The producer refuses when ``cursors[HEAD] - cursors[TAIL] >= capacity``; else it writes
    ``rows[cursors[HEAD] % capacity]``, makes it visible (release fence), and only then adds one to
    ``cursors[HEAD]``. A producer that dies inside a record therefore leaves no torn one behind.

    The memory stays mapped as long as any of its arrays is in use, also after ``close``.

    Attributes:
        rows: The records, shape (capacity,), ``TICK_DTYPE``.
        cursors: Shape (8,), int64; see ``HEAD`` and ``TAIL``, the rest is reserved and zero.
        name: What ``attach`` takes (the path of the shared memory), or None for a local ring.
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
        self._order = threading.Lock()

    @classmethod
    def local(cls, capacity: int) -> Ring:
        """Returns a ring in this process's own memory.

        Args:
            capacity: Records that it holds, >= 1.

        Raises:
            RecordingError: The capacity is below 1.
        """
        _check_capacity(capacity)
        return cls(np.zeros(capacity, TICK_DTYPE), np.zeros(_CURSORS, np.int64))

    @classmethod
    def shared(cls, capacity: int) -> Ring:
        """Creates a ring in shared memory; ``close`` removes its name.

        Segments that a killed process left behind are removed on the way.

        Args:
            capacity: Records that it holds, >= 1; one record takes 400 bytes.

        Raises:
            RecordingError: The capacity is below 1, or there is no room for it.
        """
        _check_capacity(capacity)
        size = _ROWS_OFFSET + capacity * TICK_DTYPE.itemsize
        folder = memory_folder()
        try:
            memory, path = created(folder, size)
        except OSError as error:
            raise RecordingError(
                f"no room for a ring of {capacity} records ({size} bytes) in {folder}: "
                f"{error.strerror}"
            ) from error
        header = np.frombuffer(memory, _HEADER, count=1)
        header["record_size"] = TICK_DTYPE.itemsize
        header["capacity"] = capacity
        header["magic"] = _MAGIC
        return cls._mapped(memory, capacity, str(path), is_owner=True)

    @classmethod
    def attach(cls, name: str) -> Ring:
        """Opens the ring that another process created.

        Args:
            name: The other ring's ``name``.

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
        """Records that the ring holds."""
        return int(self.rows.size)

    def pending(self) -> int:
        """Returns how many records were written and not yet read."""
        return int(self.cursors[HEAD] - self.cursors[TAIL])

    def append(self, rows: NDArray[np.void]) -> int:
        """Writes records as the producer; the twin in Python of the kernel's compiled producer.

        Args:
            rows: Records, shape (n,), ``TICK_DTYPE``.

        Returns:
            How many were taken, from the first on; the others met a full ring.
        """
        head = int(self.cursors[HEAD])
        taken = min(int(rows.size), self.capacity - self.pending())
        self.rows[(head + np.arange(taken)) % self.capacity] = rows[:taken]
        self._fence()
        self.cursors[HEAD] = head + taken
        return taken

    def take(self, limit: int) -> NDArray[np.void]:
        """Reads records as the consumer, and frees their places.

        Args:
            limit: The most records to take, >= 1.

        Returns:
            A copy of the oldest unread records, oldest first; empty if there is none.
        """
        tail = int(self.cursors[TAIL])
        count = min(self.pending(), limit)
        self._fence()
        taken = self._copy(tail, tail + count)
        self._fence()
        self.cursors[TAIL] = tail + count
        return taken

    def latest(self, count: int) -> NDArray[np.void]:
        """Copies the newest records that are still in the ring, read or not; frees nothing.

        While the producer runs, ask for less than the capacity: the place of the oldest record is
        the one that is written next.

        Args:
            count: The most records to copy, >= 0.

        Returns:
            The records, oldest first.
        """
        head = int(self.cursors[HEAD])
        self._fence()
        start = max(0, head - self.capacity, head - count)
        copied = self._copy(start, head)
        self._fence()
        # what the producer has overwritten since is no record of the past any more
        overwritten = int(self.cursors[HEAD]) - self.capacity - start
        return copied[overwritten:] if overwritten > 0 else copied

    def since(self, number: int) -> tuple[int, NDArray[np.void]]:
        """Copies the records from a number on that are still in the ring; frees nothing.

        The number says where to go on, however many records come in between two calls.

        Args:
            number: Of the first record that is wanted, counted from the ring's start, >= 0.

        Returns:
            The number of the first record that is still there, and the records, oldest first.
        """
        head = int(self.cursors[HEAD])
        self._fence()
        # the oldest place of a full ring is the one that is written next
        start = max(min(number, head), head - self.capacity + 1)
        copied = self._copy(start, head)
        self._fence()
        overwritten = max(int(self.cursors[HEAD]) - self.capacity + 1 - start, 0)
        return start + overwritten, copied[overwritten:]

    def close(self) -> None:
        """Removes the shared memory's name if this ring created it; its arrays stay valid."""
        if self._is_owner:
            self.unlink()

    def unlink(self) -> None:
        """Removes the shared memory's name, also on behalf of an owner that died."""
        if self.name is not None:
            with contextlib.suppress(OSError):  # already gone, or Windows: still mapped
                Path(self.name).unlink()

    def _copy(self, start: int, stop: int) -> NDArray[np.void]:
        first, count = start % self.capacity, stop - start
        if first + count <= self.capacity:
            return self.rows[first : first + count].copy()
        return np.concatenate((self.rows[first:], self.rows[: first + count - self.capacity]))

    def _fence(self) -> None:
        # Python has no memory fence; taking and leaving a lock is one on every processor
        with self._order:
            pass


def _check_capacity(capacity: int) -> None:
    if capacity < 1:
        raise RecordingError(f"a ring must hold at least 1 record, not {capacity}")
