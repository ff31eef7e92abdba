"""CSV format."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticbridge.export.sink import column_values
from hapticbridge.recording import RecordingFile
from hapticbridge.tick import COLUMNS

SIDECAR = ".json"
"""Extension of the file beside the CSV, appended to its whole name."""


def sidecar_of(path: Path) -> Path:
    """Returns the path of the file with units, metadata and events."""
    return path.with_name(path.name + SIDECAR)


class CsvSink:
    """CSV writer whose numbers read back to the same doubles; NaN loses its payload.

    The header has names only. Units, metadata and events go to ``NAME.csv.json`` as one object
    ``{"units", "meta", "events"}``, because most programs cannot read comments in a CSV.
    """

    def __init__(self, path: Path, recording: RecordingFile) -> None:
        about = {
            "units": {column.name: column.unit for column in COLUMNS},
            "meta": recording.meta,
            "events": recording.events,
        }
        text = json.dumps(about, indent=1, ensure_ascii=False)
        sidecar_of(path).write_text(text + "\n", encoding="utf-8")
        self._file = path.open("w", encoding="ascii", newline="")
        self._file.write(",".join(column.name for column in COLUMNS) + "\n")

    def add(self, ticks: NDArray[np.void]) -> None:
        """Implements ``Sink.add``."""
        # repr of a float is the shortest text that reads back to it
        texts = [map(repr, column_values(ticks, column).tolist()) for column in COLUMNS]
        self._file.writelines(",".join(row) + "\n" for row in zip(*texts, strict=True))

    def close(self) -> None:
        """Implements ``Sink.close``."""
        self._file.close()
