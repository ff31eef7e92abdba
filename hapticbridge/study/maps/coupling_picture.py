"""How the map ``coupling`` is drawn: a panel a method, theory over verdicts."""

from __future__ import annotations

from functools import cache

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hapticbridge.passivity import maximum_stiffness
from hapticbridge.picture import new_figure
from hapticbridge.rendering import METHODS
from hapticbridge.study.maps.coupling_runs import (
    DAMPING,
    DEVICE_DAMPING,
    PERIOD,
    STIFFNESS,
    THEORIES,
    TOOL_MASS,
    of_method,
    verdicts_of,
)
from hapticbridge.study.maps.free_tool import worst_angle
from hapticbridge.study.maps.palette import THEORY_COLOUR
from hapticbridge.study.maps.verdicts import draw_verdicts, verdict_legend
from hapticbridge.study.table import Table

CONTOUR = 41
"""Points along each axis from which the free tool's bound is drawn; more make it smoother."""


def draw(table: Table) -> Figure:
    """Draws K against B by method, with the bounds and the measured limits on top."""
    figure = new_figure(8, 6.4)
    panels = figure.subplots(2, 3, sharex=True, sharey=True).ravel()
    for axes, name in zip(panels, THEORIES, strict=True):
        has_wall = METHODS[name].has_law
        _draw_cells(axes, of_method(table, "cell", name))
        _draw_theory(axes, THEORIES[name], has_wall=has_wall)
        limits = of_method(table, "limit", name)
        axes.plot(limits["damping"], limits.numbers("limit"), "o", color="black", ms=4, mfc="white")
        title = name if has_wall else f"{name}: free tool and tapping only"
        axes.set_title(title, fontsize="medium")
        axes.set_xlim(*DAMPING)
        axes.set_ylim(*STIFFNESS)
    for axes in panels[3:]:
        axes.set_xlabel("coupling damping B (N s/m)")
    for axes in panels[::3]:
        axes.set_ylabel("coupling stiffness K (N/m)")
    figure.suptitle(
        f"K against B, device damping b = {DEVICE_DAMPING:g} N s/m at {1 / PERIOD:g} Hz;\n"
        f"worst hands on a wall and with a tool of {1e3 * TOOL_MASS:g} g, and a hand that taps",
        fontsize="medium",
    )
    verdict_legend(
        figure,
        [
            ("(6): K = 2 (b − B)/T", "black", "-"),
            ("(7), Tustin's rule, at low frequency", "black", ":"),
            (f"free tool of {1e3 * TOOL_MASS:g} g by this method", THEORY_COLOUR, "--"),
            ("measured limit on a wall", "black", "o"),
        ],
    )
    return figure


def _draw_cells(axes: Axes, cells: Table) -> None:
    draw_verdicts(axes, cells["damping"], cells["stiffness"], verdicts_of(cells), log_y=True)


def _draw_theory(axes: Axes, theory: str, *, has_wall: bool) -> None:
    """Draws what was measured against: (6) and (7) only where a wall was."""
    damping = np.linspace(*DAMPING, 121)
    below = damping[damping < DEVICE_DAMPING]
    b = DEVICE_DAMPING
    if has_wall:
        axes.plot(below, maximum_stiffness(b, PERIOD, below), color="black", lw=1.8)
        # (7) as θ → 0: (K T)² = 2 b (K T + 2 B)
        axes.plot(
            damping, (b + np.sqrt(b**2 + 4 * b * damping)) / PERIOD, color="black", ls=":", lw=1.5
        )
    axes.contour(
        np.linspace(*DAMPING, CONTOUR),
        np.geomspace(*STIFFNESS, CONTOUR),
        np.minimum(_needed(theory), 10 * b),
        levels=[b],
        colors=THEORY_COLOUR,
        linestyles="--",
        linewidths=1.5,
    )


@cache
def _needed(theory: str) -> NDArray[np.float64]:
    """Returns the device damping in N s/m that a free tool needs, rows of K by columns of B.

    Kept, because methods share theories.
    """
    return np.array(
        [
            [
                worst_angle(theory, k, b, TOOL_MASS, PERIOD)[1]
                for b in np.linspace(*DAMPING, CONTOUR)
            ]
            for k in np.geomspace(*STIFFNESS, CONTOUR)
        ]
    )
