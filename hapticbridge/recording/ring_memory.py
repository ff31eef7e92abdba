"""Shared memory of a ring."""

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
    """Returns the folder of shared memory: Linux's memory file system, else the temporary folder.

    ``multiprocessing.shared_memory`` does not fit. Before Python 3.13 its resource tracker also
    tracks attached processes, removes the memory under its owner, and prints about leaks after a
    kill.
    """
    memory = Path("/dev/shm")
    usable = memory.is_dir() and os.access(memory, os.W_OK)
    return memory if usable else Path(tempfile.gettempdir())


def created(folder: Path, size: int) -> tuple[mmap.mmap, Path]:
    """Creates zeroed shared memory under a unique name.

    Segments left by killed processes are removed. ``size`` is in bytes.

    Raises:
        OSError: Memory is insufficient.
    """
    _sweep(folder)
    path = folder / f"{_PREFIX}{os.getpid()}-{secrets.token_hex(6)}"
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
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
    """Marks a segment as in use until the process that maps it ends."""
    if sys.platform != "win32":
        fcntl.flock(file, fcntl.LOCK_SH)


def _sweep(folder: Path) -> None:
    """Removes segments that no living process maps."""
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
