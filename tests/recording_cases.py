"""Random recordings, written, compared and rewritten."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mcap.reader import SeekingReader
from numpy.typing import NDArray

from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.recording import Attachment, RecordingWriter

EPOCH = 1_700_000_000_000_000_000


META = {"period_s": "0.001", "device": '{"mass": 0.1}', "method": "implicit", "µ": "ü"}


FILES = (
    Attachment("scene.xml", "application/xml", b"<mujoco/>"),
    Attachment("model.mjb", "application/octet-stream", bytes(range(256)) * 9),
    Attachment("empty", "", b""),
)


def random_rows(count: int, seed: int = 0) -> NDArray[np.void]:
    """Arbitrary bits in every field but tick and deadline."""
    raw = np.random.default_rng(seed).bytes(count * TICK_DTYPE.itemsize)
    rows = np.frombuffer(raw, TICK_DTYPE).copy()
    rows["tick"] = np.arange(count)
    rows["deadline_ns"] = (rows["tick"] + 1) * 1_000_000
    return rows


def write(
    path: Path, rows: NDArray[np.void], *, batch: int = 100, events: bool = True, close: bool = True
) -> RecordingWriter:
    writer = RecordingWriter(path, META, FILES, EPOCH)
    if events:
        writer.write_event({"event": "start"}, 0)
    for start in range(0, rows.size, batch):
        writer.write_ticks(rows[start : start + batch])
        if events:
            writer.write_event({"event": "mark", "after": start}, start * 1_000_000)
    if close:
        writer.close()
    return writer


def same(a: NDArray[np.void], b: NDArray[np.void]) -> bool:
    """Equal to the bit, NaN patterns too."""
    return a.dtype == b.dtype and a.tobytes() == b.tobytes()


def chunks(path: Path) -> list[tuple[int, int, int]]:
    """Start and end of each chunk record in the file, and its uncompressed size in bytes."""
    with path.open("rb") as stream:
        summary = SeekingReader(stream).get_summary()
    assert summary is not None
    return [
        (
            each.chunk_start_offset,
            each.chunk_start_offset + each.chunk_length,
            each.uncompressed_size,
        )
        for each in sorted(summary.chunk_indexes, key=lambda each: each.chunk_start_offset)
    ]
