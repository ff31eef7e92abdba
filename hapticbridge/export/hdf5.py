"""HDF5 format."""

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
"""Rows per chunk, 64 kB. Larger chunks compress better; smaller ones read faster for few rows."""


_CACHE = 2 * 8 * _CHUNK
"""Chunk cache in bytes per column: the chunks of one block. HDF5's default of 8 MB fills after 17
minutes at 1 kHz, 0.4 GB for all columns, and nothing is read again here."""


class Hdf5Sink:
    """HDF5 writer: ``/ticks/NAME`` per column, ``/meta/KEY`` per metadata text, and ``/events``.

    Each data set of ``/ticks`` has the attribute ``unit``. Events are JSON texts. Metadata are text
    data sets, because an attribute is limited to 64 kB.

    Raises:
        RecordingError: h5py is not installed.
    """

    def __init__(self, path: Path, recording: RecordingFile) -> None:
        h5py = optional_module("h5py", "HDF5", "hdf5", RecordingError)
        self._file = h5py.File(path, "w", rdcc_nbytes=_CACHE)
        text = h5py.string_dtype()
        meta = self._file.create_group("meta")
        for key, value in recording.meta.items():
            # a slash in the name would create a group
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
        """Implements ``Sink.add``."""
        end = self._count + len(ticks)
        for column, data in self._columns:
            data.resize((end,))
            data[self._count :] = column_values(ticks, column)
        self._count = end

    def close(self) -> None:
        """Implements ``Sink.close``."""
        self._file.close()
