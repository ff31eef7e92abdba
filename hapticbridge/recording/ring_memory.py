"""The shared memory of a ring: a file in memory under a name, which is gone when nobody maps it."""

from __future__ import annotations

import contextlib
import mmap
import os
import secrets
import sys
import tempfile
from pathlib import Path

import numpy as np

from hapticbridge.errors import RecordingError

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
