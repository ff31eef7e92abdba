"""Elements shared by a page's plots."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hapticbridge.report.curves import decimated

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

BINS = 400
"""Number of bins per curve on a page; each is two pixels wide. With 400, the page of a ten-minute
run has half a megabyte."""


UNITS = ((1.0, "J"), (1e-3, "mJ"), (1e-6, "µJ"), (1e-9, "nJ"))
"""Units of energy on plots; below a nanojoule there is only rounding."""

LEAST_SPAN = 1e-3
"""Smallest range of a panel's axis, in its own unit. A smaller range would magnify rounding
noise."""


def curve(axes: Axes, time: Array, values: Array, **style: object) -> None:
    """Draws a curve of any length without losing a peak."""
    axes.plot(*decimated(time, values, BINS), **style)  # type: ignore[arg-type]


def energy_unit(*energies: Array) -> tuple[float, str]:
    """Returns size and name of the unit that shows energies in J with few digits."""
    largest = max(float(np.abs(energy).max(initial=0.0)) for energy in energies)
    return next((unit for unit in UNITS if largest >= unit[0]), UNITS[-1])


def bounded(axes: Axes, time: Array, energy: Array, allowed: Array, label: str) -> None:
    """Draws an energy in J and its bound."""
    size, unit = energy_unit(energy, allowed)
    curve(axes, time, energy / size, color="#1a5fb4", label=label)
    curve(axes, time, allowed / size, color="#b3261e", ls="--", label="allowed at most")
    axes.set_ylabel(f"energy ({unit})")
    widen(axes)


def widen(axes: Axes) -> None:
    """Enforces a minimum axis range so that rounding noise is not magnified."""
    low, high = axes.get_ylim()
    if high - low < LEAST_SPAN:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * LEAST_SPAN, middle + 0.5 * LEAST_SPAN)
