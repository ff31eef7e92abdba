"""Random access to a file's bytes."""

from __future__ import annotations

import os
import threading
import zlib
from pathlib import Path
from types import TracebackType

from hapticbridge.errors import RecordingError

WINDOW = 1 << 20
"""Bytes per read of a long stretch. A larger window takes more memory, a smaller one more calls."""


class FileBytes:
    """A file as a sequence of bytes that is never in memory as a whole.

    It is not memory-mapped: a bridge that overwrites the file would truncate it, and access to a
    mapped page beyond the end kills the process. Slices may be read from several threads.

    Raises:
        RecordingError: It cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        try:
            if path.exists() and not path.is_file():
                kind = "a folder" if path.is_dir() else "not a regular file"
                if path.is_dir() and not os.access(path, os.R_OK | os.X_OK):
                    kind = "a folder that cannot be read"
                raise RecordingError(f"cannot read the recording {path}: it is {kind}")
            self._size = path.stat().st_size
            self._file = path.open("rb", buffering=0)
        except (OSError, ValueError) as error:
            raise self._refusal(error) from error

    def __enter__(self) -> FileBytes:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._file.close()

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, places: slice) -> bytes:
        """Returns the bytes of a slice without a step.

        Raises:
            RecordingError: They cannot be read, or the file has become shorter.
        """
        start, stop, _ = places.indices(self._size)
        wanted = max(stop - start, 0)
        pieces = bytearray()
        try:
            with self._lock:
                self._file.seek(start)
                # a read may return fewer bytes than requested
                while len(pieces) < wanted and (piece := self._file.read(wanted - len(pieces))):
                    pieces += piece
        except OSError as error:
            raise self._refusal(error) from error
        if len(pieces) < wanted:
            raise RecordingError(f"the recording {self._path} became shorter while it was read")
        return bytes(pieces)

    def checksum(self, start: int, stop: int) -> int:
        """Returns the CRC-32 of a stretch."""
        crc = 0
        for at in range(start, stop, WINDOW):
            crc = zlib.crc32(self[at : min(at + WINDOW, stop)], crc)
        return crc

    def is_zero_from(self, start: int) -> bool:
        """Returns True if all bytes from a position on are zero."""
        return not any(any(self[at : at + WINDOW]) for at in range(start, self._size, WINDOW))

    def _refusal(self, error: Exception) -> RecordingError:
        reason = getattr(error, "strerror", None) or error
        return RecordingError(f"cannot read the recording {self._path}: {reason}")
