"""Interface of table writers."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.recording import RecordingFile
from hapticbridge.tick import Column


class Sink(Protocol):
    """A table being written."""

    def __init__(self, path: Path, recording: RecordingFile) -> None: ...

    def add(self, ticks: NDArray[np.void]) -> None:
        """Appends records, ``TICK_DTYPE``."""

    def close(self) -> None:
        """Finishes the file."""


def column_values(ticks: NDArray[np.void], column: Column) -> NDArray[Any]:
    """Returns one column of records, contiguous, int64 or float64, to the bit."""
    field = ticks[column.field]
    return np.ascontiguousarray(field if column.part is None else field[:, column.part])
