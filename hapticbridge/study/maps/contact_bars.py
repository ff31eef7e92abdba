"""Bars of the map ``contact``: how many runs had each verdict, with figures beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes

from hapticbridge.study.maps.verdicts import COLOURS, VERDICTS, say_missing

Columns: TypeAlias = Sequence[tuple[str, float, str, float, str]]
"""Of figures beside the bars: heading, right edge as a share of the bars' width, what stands there,
its factor and format."""


def draw_bars(
    axes: Axes, found: Sequence[Mapping[str, Any]], names: Sequence[str], columns: Columns
) -> None:
    """Draws a bar an entry, runs by verdict, with what they came to in columns beside it.

    Args:
        axes: Where; the columns stand to their right.
        found: An entry a bar; without one the axes say that no point could be computed.
        names: Of the bars.
        columns: What to write beside them.
    """
    if not found:
        say_missing(axes)
        return
    places = np.arange(len(found))[::-1]
    left = np.zeros(len(found))
    for verdict, colour in zip(VERDICTS[:3], COLOURS[:3], strict=True):
        width = np.array([one[verdict.replace(" ", "_")] for one in found])
        axes.barh(places, width, left=left, color=colour, height=0.8)
        left = left + width
    beside = axes.get_yaxis_transform()
    for heading, share, name, factor, form in columns:
        edge = 1 + share
        axes.text(edge, len(found) - 0.3, heading, transform=beside, size=7, ha="right")
        for place, one in zip(places, found, strict=True):
            text = format(factor * one[name], form)
            axes.text(edge, place, text, transform=beside, size=8, ha="right", va="center")
    axes.set_yticks(places, names, size=8)
    axes.set_xlim(0, max(left.max(), 1.0))
    axes.set_ylim(-0.6, len(found) - 0.4)
    axes.set_xlabel("runs by verdict")
