"""The hand-over of a finished record to the ring, from which the recorder takes it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.native import release_fence

HEAD, TAIL = 0, 1
"""Cursors of the ring: records written, records read."""


@compiled
def publish(
    row: NDArray[np.void],
    ring: NDArray[np.void],
    cursors: NDArray[np.int64],
    deadline_ns: int,
    wake_ns: int,
    read_ns: int,
    write_ns: int,
    flags: int,
) -> bool:
    """Completes the record with its times and hands it to the ring (single producer).

    Returns:
        False if the ring is full; nothing was written then, and the call can be repeated.
    """
    head = cursors[HEAD]
    if head - cursors[TAIL] >= ring.size:
        return False
    r = row[0]
    r.deadline_ns, r.wake_ns, r.read_ns, r.write_ns = deadline_ns, wake_ns, read_ns, write_ns
    r.flags |= flags
    ring[head % ring.size] = r
    release_fence()
    cursors[HEAD] = head + 1
    return True
