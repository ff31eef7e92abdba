"""Parquet format."""

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


class ParquetSink:
    """Parquet writer with one row group per block.

    Column metadata hold ``unit``. Schema metadata hold ``hapticbridge.meta`` (the recording's
    metadata as a JSON object of texts) and ``hapticbridge.events`` (its events as a JSON list).

    Raises:
        RecordingError: pyarrow is not installed.
    """

    def __init__(self, path: Path, recording: RecordingFile) -> None:
        self._arrow = optional_module("pyarrow", "Parquet", "tables", RecordingError)
        parquet = optional_module("pyarrow.parquet", "Parquet", "tables", RecordingError)
        kinds = {"i": self._arrow.int64(), "f": self._arrow.float64()}
        fields = [
            self._arrow.field(
                column.name,
                kinds[TICK_DTYPE[column.field].base.kind],
                nullable=False,
                metadata={"unit": column.unit},
            )
            for column in COLUMNS
        ]
        about = {
            "hapticbridge.meta": json.dumps(recording.meta),
            "hapticbridge.events": json.dumps(recording.events),
        }
        self._schema = self._arrow.schema(fields, metadata=about)
        # values rarely repeat, so a dictionary would only take space
        self._writer = parquet.ParquetWriter(
            path, self._schema, compression="zstd", use_dictionary=False
        )

    def add(self, ticks: NDArray[np.void]) -> None:
        """Implements ``Sink.add``."""
        arrays = [self._arrow.array(column_values(ticks, column)) for column in COLUMNS]
        self._writer.write_table(self._arrow.Table.from_arrays(arrays, schema=self._schema))

    def close(self) -> None:
        """Implements ``Sink.close``."""
        self._writer.close()
