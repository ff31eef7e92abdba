"""The index of a recording's chunks while it is being written: on disk, not in memory.

An MCAP file ends with the place of each of its chunks, so that a reader finds a time without
reading all that comes before. The MCAP library keeps these entries as objects until the file is
finished: 0.9 kB a chunk, 10 MB an hour at 1 kHz, for as long as the run lasts.
"""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import Writer


class ChunkIndexFile:
    """Stands in for the list in which the MCAP library keeps the index.

    Entries wait in a file without a name, beside the recording where that is possible, and go when
    it is closed or its process dies. One entry is about 100 bytes.

    Args:
        folder: Where the recording is.

    Raises:
        OSError: No file can be made, there or where temporary files belong.
    """

    def __init__(self, folder: Path) -> None:
        self._file = _nameless_file(folder)

    def take_over(self, writer: Writer) -> None:
        """Replaces the library's list, which is private, in the only place that names it."""
        writer._Writer__chunk_indices = self  # type: ignore[attr-defined]

    def append(self, entry: ChunkIndex) -> None:
        """Takes the entry of a finished chunk.

        Raises:
            OSError: The disk is full.
        """
        builder = RecordBuilder()
        entry.write(builder)
        data: bytes = builder.end()  # type: ignore[no-untyped-call]
        if self._file.write(data) != len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def __iter__(self) -> Iterator[_Entries]:
        """Yields all entries as one, which the library writes into the summary."""
        self._file.seek(0)
        yield _Entries(self._file.read())

    def close(self) -> None:
        """Frees the file."""
        self._file.close()


def _nameless_file(folder: Path) -> IO[bytes]:
    try:
        return tempfile.TemporaryFile(dir=folder, buffering=0)
    except OSError:  # one may write to a file or device in a folder that takes no others
        return tempfile.TemporaryFile(buffering=0)


class _Entries:
    """Entries that need no packing any more."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def write(self, stream: RecordBuilder) -> None:
        stream.write(self._data)
