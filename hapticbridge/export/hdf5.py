"""HDF5: a data set per number, its unit in an attribute."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.export.sink import column_values
from hapticbridge.extras import optional_module
from hapticbridge.recording import RecordingFile
from hapticbridge.tick import COLUMNS, TICK_DTYPE

_CHUNK = 8192
"""Rows a chunk, 64 kB: larger packs better, smaller reads faster where few rows are wanted."""


_CACHE = 2 * 8 * _CHUNK
"""Bytes of written chunks that HDF5 keeps per column: those of one block. Its own choice is 8 MB,
which 17 minutes at 1 kHz fill: 0.4 GB in all columns, and nothing here is read again."""


class Hdf5Sink:
    """Writes ``/ticks/NAME`` per column, ``/meta/KEY`` per metadata text, and ``/events``.

    Each data set of ``/ticks`` has the attribute ``unit``. Events are JSON texts. Metadata are data
    sets of text, since an attribute ends at 64 kB.

    Raises:
        RecordingError: h5py is not installed.
    """

    def __init__(self, path: Path, recording: RecordingFile) -> None:
        h5py = optional_module("h5py", "HDF5", "hdf5", RecordingError)
        self._file = h5py.File(path, "w", rdcc_nbytes=_CACHE)
        text = h5py.string_dtype()
        meta = self._file.create_group("meta")
        for key, value in recording.meta.items():
            # a slash would make a folder of what stands before it
            meta.create_dataset(key.replace("/", "_"), data=value, dtype=text)
        events = [json.dumps(event) for event in recording.events]
        self._file.create_dataset("events", (len(events),), text, data=events)
        ticks = self._file.create_group("ticks")
        self._count = 0
        self._columns = []
        for column in COLUMNS:
            kind = TICK_DTYPE[column.field].base
            data = ticks.create_dataset(
                column.name, (0,), kind, maxshape=(None,), chunks=(_CHUNK,), compression="gzip"
            )
            data.attrs["unit"] = column.unit
            self._columns.append((column, data))

    def add(self, ticks: NDArray[np.void]) -> None:
        """See ``Sink.add``."""
        end = self._count + len(ticks)
        for column, data in self._columns:
            data.resize((end,))
            data[self._count :] = column_values(ticks, column)
        self._count = end

    def close(self) -> None:
        """See ``Sink.close``."""
        self._file.close()
