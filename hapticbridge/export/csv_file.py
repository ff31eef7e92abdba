"""CSV: a header of names alone, and units, metadata and events beside it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticbridge.export.sink import column_values
from hapticbridge.recording import RecordingFile
from hapticbridge.tick import COLUMNS

SIDECAR = ".json"
"""Ending of the file beside the CSV, added to its whole name."""


def sidecar_of(path: Path) -> Path:
    """Returns the file that holds what CSV cannot."""
    return path.with_name(path.name + SIDECAR)


class CsvSink:
    """Writes numbers with as many digits as bring back the same double; NaN loses its payload.

    Units, metadata and events stand in ``NAME.csv.json`` as one object ``{"units", "meta",
    "events"}``: comments in the CSV itself would stop most programs that read one.
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
        """See ``Sink.add``."""
        # repr of a float is the shortest text that reads back to it
        texts = [map(repr, column_values(ticks, column).tolist()) for column in COLUMNS]
        self._file.writelines(",".join(row) + "\n" for row in zip(*texts, strict=True))

    def close(self) -> None:
        """See ``Sink.close``."""
        self._file.close()
