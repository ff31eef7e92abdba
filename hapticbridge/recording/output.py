"""Locked output file with reserved space."""

from __future__ import annotations

import ctypes
import errno
import os
import stat
import sys
from collections.abc import Callable
from pathlib import Path

if sys.platform != "win32":
    import fcntl

RESERVE = 4 << 20
"""Space in bytes reserved beyond the file's end. Records at 1 kHz take 0.4 MB/s before compression,
and the loop checks its recorder ten times a second. It suffices for 10 kHz and for the index of
hours."""

_KEEP_SIZE, _PUNCH_HOLE = 1, 2  # FALLOC_FL_* of Linux


class Output:
    """Unbuffered file with a lock and reserved space.

    The MCAP library writes a finished chunk in one call; a buffer would hold its end back, and a
    kill would lose it. A full disk has no space for the index that closes the file, so space is
    reserved in advance. When no more can be reserved, the reserve takes the remaining data until
    the run has ended. The content of an existing file is lost; ``is_new`` refuses it.

    Attributes:
        is_full: True if no more space could be reserved; at most ``RESERVE`` bytes are then left.
            Always False on a file system without reservation.

    Raises:
        OSError: It cannot be opened, or another bridge is recording to it.
    """

    def __init__(self, path: Path, *, is_new: bool) -> None:
        # lock before truncating: another bridge may be recording to this file
        flags = os.O_WRONLY | os.O_CREAT | getattr(os, "O_BINARY", 0)
        flags |= os.O_EXCL if is_new else 0
        self._file = os.fdopen(os.open(path, flags, 0o666), "wb", buffering=0)
        try:
            if sys.platform != "win32":
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._is_regular = stat.S_ISREG(os.fstat(self._file.fileno()).st_mode)
            if self._is_regular:
                self._file.truncate(0)
        except BlockingIOError as error:
            self._file.close()
            raise OSError(errno.EBUSY, "another bridge is recording to it") from error
        self._position = self._claimed = 0
        self._claims = self._is_regular and sys.platform == "linux"
        self._fallocate = _fallocate() if self._claims else None
        self.is_full = False

    def write(self, data: bytes) -> int:
        """Writes all data, then extends the reserve; about three calls per second."""
        view = memoryview(data)
        while view:
            written = self._file.write(view)
            view = view[written:]
        self._position += len(data)
        if self._claims and data:  # a reservation of zero bytes is an error
            self._claim()
        return len(data)

    def tell(self) -> int:
        """Returns the number of bytes written."""
        return self._position

    def flush(self) -> None:
        """Does nothing; writes are unbuffered."""

    def sync(self) -> None:
        """Waits until all data is on the disk."""
        if self._is_regular:
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Releases the unused reserve and closes the file."""
        if self._claimed > self._position and not self._file.closed:
            rest = self._claimed - self._position
            self._allocate(_KEEP_SIZE | _PUNCH_HOLE, self._position, rest)
            self._file.truncate(self._position)  # ext4 releases space beyond the end only this way
        self._file.close()

    def _claim(self) -> None:
        wanted = self._position + RESERVE
        number = self._allocate(_KEEP_SIZE, self._claimed, wanted - self._claimed)
        if number == 0:
            self._claimed = wanted
        elif number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            self.is_full, self._claims = True, False
        elif number != errno.EINTR:
            self._claims = False

    def _allocate(self, mode: int, start: int, size: int) -> int:
        """Calls Linux's fallocate; returns the error number, or 0."""
        first, length = ctypes.c_int64(start), ctypes.c_int64(size)
        if self._fallocate is None:
            return errno.EOPNOTSUPP
        if self._fallocate(self._file.fileno(), mode, first, length) == 0:
            return 0
        return ctypes.get_errno()


def _fallocate() -> Callable[..., int] | None:
    """Returns Linux's 64-bit fallocate, which Python's os module lacks; None if unavailable."""
    libc = ctypes.CDLL(None, use_errno=True)
    for name in ("fallocate64", "fallocate"):  # not every C library has both
        if hasattr(libc, name):
            found: Callable[..., int] = getattr(libc, name)
            return found
    return None
