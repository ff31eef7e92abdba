"""How the figures of the walk look."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hapticbridge.plotting import new_figure


def panels(rows: int, *, height: float, columns: int = 1) -> tuple[Figure, tuple[Axes, ...]]:
    """Returns a figure 8 inches wide and its axes, row by row.

    Args:
        rows: Panels above each other.
        height: Of the figure in inches.
        columns: Panels beside each other.
    """
    figure = new_figure(8, height)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat:
        axes.grid(alpha=0.3)
    return figure, tuple(grid.flat)
