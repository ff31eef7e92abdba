"""The end of a tick: its balance, and the record's way to the ring, where the recorder takes it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.after import close_tick
from hapticbridge.kernel.codes import OK, RING_FULL
from hapticbridge.kernel.native import floats, ints, mj_contact_force, pointer_at, release_fence

HEAD, TAIL = 0, 1
"""Cursors of the ring: records written, records read."""

SEQUENCE, NUMBER, CONTACTS = 0, 1, 2
"""Head of a snapshot: sequence, odd during a write; number of the record; count of contacts."""


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


@compiled
def finish_tick(
    state: NDArray[np.void],
    row: NDArray[np.void],
    ring: NDArray[np.void],
    cursors: NDArray[np.int64],
    deadline_ns: int,
    wake_ns: int,
    read_ns: int,
    write_ns: int,
    flags: int,
    has_positions: bool,
) -> int:
    """Does ``close_tick`` and ``publish`` in one call: a second one would cost 0.2 µs.

    Returns:
        What ``close_tick`` returns, or ``RING_FULL``: then only ``publish`` is to be repeated.
    """
    code = close_tick(state, row, has_positions)
    if code != OK:
        return code
    taken = publish(row, ring, cursors, deadline_ns, wake_ns, read_ns, write_ns, flags)
    return OK if taken else RING_FULL


@compiled
def publish_positions(
    state: NDArray[np.void],
    cursors: NDArray[np.int64],
    head: NDArray[np.int64],
    numbers: NDArray[np.float64],
) -> None:
    """Copies the scene's positions and contacts to a snapshot (``recording.snapshot``).

    Call it after MuJoCo's step and before the next one begins, while the contact forces of the step
    are there. It changes nothing that the tick reads.

    Args:
        state: The kernel's state.
        cursors: The ring's; the record of this tick is the next one to be written there.
        head: The snapshot's head.
        numbers: The snapshot's numbers: slack, positions, mocap poses, then 6 a contact.
    """
    s = state[0]
    head[SEQUENCE] += 1
    release_fence()
    numbers[0], end = s.slack, 1
    for source, count in (
        (s.qpos, s.nq),
        (s.mocap_pos, 3 * s.nmocap),
        (s.mocap_quat, 4 * s.nmocap),
    ):
        numbers[end : end + count] = floats(source, count)
        end += count
    shown = min(ints(s.ncon, 1)[0], (numbers.size - end) // 6)
    for c in range(shown):
        contact = pointer_at(s.contact) + c * s.contact_size
        slot, frame = numbers[end : end + 6], floats(contact + s.contact_frame, 9)
        mj_contact_force(s.model, s.data, c, slot.ctypes.data)  # along the axes of its frame
        normal, first, second = slot[0], slot[1], slot[2]
        slot[:3] = floats(contact + s.contact_point, 3)
        for axis in range(3):
            slot[3 + axis] = (
                normal * frame[axis] + first * frame[3 + axis] + second * frame[6 + axis]
            )
        end += 6
    head[NUMBER], head[CONTACTS] = cursors[HEAD], shown
    release_fence()
    head[SEQUENCE] += 1
