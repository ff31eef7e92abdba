"""The file under a recording: whole writes, a lock, and room kept for the end on a disk that fills.

A disk that is full when a record must be written has room for nothing more, not even for the index
that closes the file. So room is claimed ahead; when no more can be claimed, what is claimed takes
all that still comes until the run has been told to end.
"""

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
"""In bytes, claimed ahead of the file's end. Records at 1 kHz are 0.4 MB/s before compression, and
the loop looks at its recorder ten times a second: enough for 10 kHz, and for the index of hours."""

_KEEP_SIZE, _PUNCH_HOLE = 1, 2  # FALLOC_FL_* of Linux


class Output:
    """A file that hands each write to the operating system whole and at once.

    The MCAP library writes a finished chunk in one call; a buffer in between would keep its end
    until the next one, and a kill would lose it.

    Args:
        path: The file; what it holds is lost.
        is_new: Refuse one that exists.

    Attributes:
        is_full: Whether no more room could be claimed; ``RESERVE`` bytes are left then, or what is
            left of them. Stays False where a file system cannot claim any.

    Raises:
        OSError: It cannot be opened, or another bridge is recording to it.
    """

    def __init__(self, path: Path, *, is_new: bool) -> None:
        # not truncated before it is locked: another bridge may be recording to the same file
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
        """Writes all of it, then claims as much room again: a call in a third of a second."""
        view = memoryview(data)
        while view:
            written = self._file.write(view)
            view = view[written:]
        self._position += len(data)
        if self._claims and data:  # no room at all cannot be claimed
            self._claim()
        return len(data)

    def tell(self) -> int:
        """Returns how much was written."""
        return self._position

    def flush(self) -> None:
        """Nothing is held back."""

    def sync(self) -> None:
        """Waits until all of it is on the disk."""
        if self._is_regular:
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Gives back what was claimed and not used, and closes."""
        if self._claimed > self._position and not self._file.closed:
            rest = self._claimed - self._position
            self._allocate(_KEEP_SIZE | _PUNCH_HOLE, self._position, rest)
            self._file.truncate(self._position)  # ext4 gives room behind the end back only so
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
        """Returns the error's number of Linux's fallocate, 0 for none."""
        first, length = ctypes.c_int64(start), ctypes.c_int64(size)
        if self._fallocate is None:
            return errno.EOPNOTSUPP
        if self._fallocate(self._file.fileno(), mode, first, length) == 0:
            return 0
        return ctypes.get_errno()


def _fallocate() -> Callable[..., int] | None:
    """Returns Linux's fallocate with offsets of 64 bits, which Python's os lacks; None without."""
    libc = ctypes.CDLL(None, use_errno=True)
    for name in ("fallocate64", "fallocate"):  # not every C library has both
        if hasattr(libc, name):
            found: Callable[..., int] = getattr(libc, name)
            return found
    return None
