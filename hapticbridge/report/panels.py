"""What the pictures of a page share."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hapticbridge.report.curves import decimated

Array = NDArray[np.float64]

BINS = 400
"""Points per curve of a page: each is two pixels of its width. More makes the page larger: at 400
that of ten minutes has half a megabyte."""


def curve(axes: Axes, time: Array, values: Array, **style: object) -> None:
    """Draws a curve without losing a peak, however long it is."""
    axes.plot(*decimated(time, values, BINS), **style)  # type: ignore[arg-type]


def bounded(axes: Axes, time: Array, energy: Array, allowed: Array, label: str) -> None:
    """Draws an energy in J, and what it may be at most."""
    curve(axes, time, 1e3 * energy, color="#1a5fb4", label=label)
    curve(axes, time, 1e3 * allowed, color="#b3261e", ls="--", label="allowed at most")
    axes.set_ylabel("energy (mJ)")
