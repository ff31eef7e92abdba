"""How a map shows verdicts: one colour each, from safe to unstable."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

VERDICTS = ("strict", "within slack", "active", "unstable")
"""From safe to unsafe. The first three are the environment's; ``unstable`` is the loop's."""

MISSING = "no point could be computed"
"""What a picture or a paragraph says where every point of a group failed."""

COLOURS = ("#a8d5ba", "#f4e3a1", "#f0a868", "#c0504d")
"""Of the verdicts; told apart by lightness as well as by hue."""


def verdict_numbers(is_stable: ArrayLike, environment: NDArray[np.object_]) -> NDArray[np.int64]:
    """Returns the place of each run's verdict in ``VERDICTS``."""
    numbers = np.array([VERDICTS.index(name) for name in environment], dtype=np.int64)
    return np.where(np.asarray(is_stable, dtype=bool), numbers, VERDICTS.index("unstable"))


def draw_verdicts(
    axes: Axes,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    verdict: NDArray[np.int64],
    *,
    log_x: bool = False,
    log_y: bool = False,
) -> None:
    """Colours a grid of runs by verdict.

    Args:
        axes: Where.
        x: Of each run, shape (n,); the runs fill a grid.
        y: Likewise.
        verdict: From ``verdict_numbers``.
        log_x: Whether x is even in its logarithm.
        log_y: Whether y is.

    Without a run the axes say that no point could be computed.
    """
    if log_x:
        axes.set_xscale("log")
    if log_y:
        axes.set_yscale("log")
    if not len(x):
        say_missing(axes)
        return
    columns, rows = np.unique(x), np.unique(y)
    cells = np.full((rows.size, columns.size), np.nan)
    cells[np.searchsorted(rows, y), np.searchsorted(columns, x)] = verdict
    axes.pcolormesh(
        _edges(columns, is_log=log_x),
        _edges(rows, is_log=log_y),
        cells,
        cmap=ListedColormap(COLOURS),
        vmin=-0.5,
        vmax=len(VERDICTS) - 0.5,
        rasterized=True,
    )


def say_missing(axes: Axes) -> None:
    """Writes into axes that there is nothing to show, because every point of a group failed."""
    axes.text(0.5, 0.5, MISSING, ha="center", va="center", transform=axes.transAxes)


def _edges(centres: NDArray[np.float64], *, is_log: bool) -> NDArray[np.float64]:
    """Returns the borders between cells, and as far outside the first and the last."""
    at = np.log(centres) if is_log else centres
    if at.size == 1:
        middle = np.array([at[0] - 0.5, at[0] + 0.5])
    else:
        inner = (at[1:] + at[:-1]) / 2
        middle = np.concatenate([[2 * at[0] - inner[0]], inner, [2 * at[-1] - inner[-1]]])
    return np.asarray(np.exp(middle) if is_log else middle)


def verdict_legend(
    figure: Figure, lines: Sequence[tuple[str, str, str]] = (), columns: int = 4
) -> None:
    """Names the colours, and the lines of theory, below a figure.

    Args:
        figure: Drawn already.
        lines: Label, colour and line style each; the styles ``o`` and ``s`` are white circles and
            squares.
        columns: Of the legend.
    """
    handles: list[object] = [
        Patch(facecolor=colour, label=name) for name, colour in zip(VERDICTS, COLOURS, strict=True)
    ]
    axes = figure.axes[0]
    for label, colour, style in lines:
        is_marker = style in ("o", "s")
        handles += axes.plot(
            [],
            [],
            color=colour,
            label=label,
            ls="" if is_marker else style,
            marker=style if is_marker else "",
            mfc="white",
        )
    figure.legend(
        handles=handles, loc="outside lower center", ncols=columns, fontsize="small", frameon=False
    )
