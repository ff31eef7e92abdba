"""What the pictures of a page share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hapticbridge.report.curves import decimated

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

BINS = 400
"""Points per curve of a page: each is two pixels of its width. More makes the page larger: at 400
that of ten minutes has half a megabyte."""


UNITS = ((1.0, "J"), (1e-3, "mJ"), (1e-6, "µJ"), (1e-9, "nJ"))
"""What an energy is drawn in; below a nanojoule there is rounding only."""

LEAST_SPAN = 1e-3
"""Of a panel, in its own unit; rounding would otherwise fill it and look like a motion."""


def curve(axes: Axes, time: Array, values: Array, **style: object) -> None:
    """Draws a curve without losing a peak, however long it is."""
    axes.plot(*decimated(time, values, BINS), **style)  # type: ignore[arg-type]


def energy_unit(*energies: Array) -> tuple[float, str]:
    """Returns the unit that shows energies in J as numbers of a few digits: its size and name."""
    largest = max(float(np.abs(energy).max(initial=0.0)) for energy in energies)
    return next((unit for unit in UNITS if largest >= unit[0]), UNITS[-1])


def bounded(axes: Axes, time: Array, energy: Array, allowed: Array, label: str) -> None:
    """Draws an energy in J, and what it may be at most."""
    size, unit = energy_unit(energy, allowed)
    curve(axes, time, energy / size, color="#1a5fb4", label=label)
    curve(axes, time, allowed / size, color="#b3261e", ls="--", label="allowed at most")
    axes.set_ylabel(f"energy ({unit})")
    widen(axes)


def widen(axes: Axes) -> None:
    """Sees to it that rounding does not fill a panel and look like a signal."""
    low, high = axes.get_ylim()
    if high - low < LEAST_SPAN:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * LEAST_SPAN, middle + 0.5 * LEAST_SPAN)
