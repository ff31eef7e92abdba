"""Shared memory with the newest positions of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.recording.ring import attached, created, fence, removed

SEQUENCE, NUMBER, CONTACTS = 0, 1, 2
"""Indices into ``Snapshot.head``. The sequence is odd while the loop writes. The number is that
of the tick's record in the ring, counted from the ring's start. The third is the number of
contacts with a force."""

MAX_CONTACTS = 32
"""Largest number of contacts in a picture; in a larger heap no single one can be distinguished."""

_HEAD = 8
_ATTEMPTS = 100


def snapshot_dtype(model: mujoco.MjModel) -> np.dtype[np.void]:
    """Returns the layout of a scene's picture; all numbers are 64-bit floats."""
    return np.dtype(
        [
            ("slack", "<f8"),
            ("qpos", "<f8", (model.nq,)),
            ("mocap_pos", "<f8", (model.nmocap, 3)),
            ("mocap_quat", "<f8", (model.nmocap, 4)),
            ("contacts", "<f8", (MAX_CONTACTS, 2, 3)),
        ]
    )


@dataclass(frozen=True, slots=True)
class Picture:
    """Positions of a scene after one tick.

    Attributes:
        number: Number of the tick's record in the ring, counted from the ring's start.
        slack: Energy in J that the environment may have created by then.
        qpos: Generalised positions, (nq,).
        mocap_pos: Positions of mocap bodies in m, (nmocap, 3).
        mocap_quat: Orientations of mocap bodies, (nmocap, 4).
        contacts: Position in m and force in N of each contact with a force, in the world frame,
            (n, 2, 3) with n <= ``MAX_CONTACTS``.
    """

    number: int
    slack: float
    qpos: NDArray[np.float64]
    mocap_pos: NDArray[np.float64]
    mocap_quat: NDArray[np.float64]
    contacts: NDArray[np.float64]


class Snapshot:
    """The newest picture of a scene, in shared memory or in this process's own.

    A record has the poses of handle and tool only. A view draws all bodies, so the loop also
    publishes the generalised positions, mocap poses and contacts of one tick, about 30 times per
    second. The loop never waits; a reader that meets a write reads again. ``memory`` has
    ``size_of(model)`` zeroed bytes; an owner removes the name on ``close``.

    Attributes:
        head: Shape (8,), int64; see ``SEQUENCE``.
        numbers: Shape (n,), float64, in the layout of ``snapshot_dtype``.
        name: Path for ``attach``; None for memory of this process alone.
    """

    def __init__(
        self, memory: Any, model: mujoco.MjModel, name: str | None = None, *, is_owner: bool = False
    ) -> None:
        layout = snapshot_dtype(model)
        self.head = np.frombuffer(memory, np.int64, count=_HEAD)
        offset = self.head.nbytes
        self.numbers = np.frombuffer(memory, np.float64, layout.itemsize // 8, offset)
        self.name = name
        self._layout, self._is_owner = layout, is_owner

    @classmethod
    def shared(cls, model: mujoco.MjModel) -> Snapshot:
        """Creates shared memory for a scene; ``close`` removes its name.

        Raises:
            RecordingError: Memory is insufficient.
        """
        memory, name = created("the positions of the scene", size_of(model))
        return cls(memory, model, name, is_owner=True)

    @classmethod
    def attach(cls, name: str, model: mujoco.MjModel) -> Snapshot:
        """Opens shared memory created by another process.

        Raises:
            RecordingError: It does not exist, or belongs to another scene.
        """
        memory = attached(name)
        if len(memory) != size_of(model):
            raise RecordingError(f"{name} has {len(memory)} bytes, the scene {size_of(model)}")
        return cls(memory, model, name)

    def read(self) -> Picture | None:
        """Returns the newest picture; None before the first, or if each read met a write."""
        for _ in range(_ATTEMPTS):
            sequence = int(self.head[SEQUENCE])
            fence()
            number, count = int(self.head[NUMBER]), int(self.head[CONTACTS])
            numbers = self.numbers.copy()
            fence()
            if sequence == 0:
                return None
            if sequence % 2 == 0 and sequence == int(self.head[SEQUENCE]):
                row = numbers.view(self._layout)[0]
                return Picture(
                    number=number,
                    slack=float(row["slack"]),
                    qpos=row["qpos"],
                    mocap_pos=row["mocap_pos"],
                    mocap_quat=row["mocap_quat"],
                    contacts=row["contacts"][:count],
                )
        return None

    def close(self) -> None:
        """Removes the shared memory's name if this object created it; its arrays stay valid."""
        if self._is_owner:
            removed(self.name)


def size_of(model: mujoco.MjModel) -> int:
    """Returns the size of a scene's snapshot in bytes."""
    return 8 * _HEAD + snapshot_dtype(model).itemsize
