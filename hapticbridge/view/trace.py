"""The curves of a run: gathered tick by tick, thinned without losing a peak."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PLOTS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("Force (N)", ("on the tool",)),
    ("Energy per port (mJ)", ("coupling", "device", "environment")),
    ("Passivity margin (mJ)", ("allowed − created",)),
    ("Lateness of a tick (µs)", ("latest",)),
)
"""The curves: title with unit, and the lines in each."""

LINES = sum(len(names) for _, names in PLOTS)
"""How many lines there are in all plots, in their order."""


class Trace:
    """The newest points of every curve.

    Each look adds one point: the largest force and lateness since the last look, and the energies
    now.

    Args:
        length: Points that are kept, >= 2; None keeps all.
    """

    def __init__(self, length: int | None = None) -> None:
        self._points: deque[tuple[float, ...]] = deque(maxlen=length)

    def add(self, rows: NDArray[np.void], slack: float) -> None:
        """Adds a point.

        Args:
            rows: Records since the last look, at least one.
            slack: What the environment may have created by now, in J; NaN where unknown.
        """
        last = rows[-1]
        if self._points and 1e-9 * float(last["deadline_ns"]) < self._points[-1][0]:
            self._points.clear()  # the run began anew
        created = float(last["environment_energy"])
        late = rows["wake_ns"] - rows["deadline_ns"]
        self._points.append(
            (
                1e-9 * float(last["deadline_ns"]),
                float(np.linalg.norm(rows["wrench_on_tool"][:, :3], axis=1).max()),
                1e3 * float(last["coupling_work"]),
                1e3 * float(last["device_energy"]),
                1e3 * created,
                1e3 * (slack - created),
                1e-3 * float(late.max()),
            )
        )

    def __len__(self) -> int:
        return len(self._points)

    def curves(self) -> tuple[Array, list[Array]]:
        """Returns times in s, and the lines of ``PLOTS`` in its units, newest last."""
        table = np.array(self._points, dtype=np.float64).reshape(len(self._points), 1 + LINES)
        return table[:, 0].copy(), [table[:, 1 + line].copy() for line in range(LINES)]
