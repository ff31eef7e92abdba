"""How the map ``coupling`` is drawn: a panel a method, theory over verdicts."""

from __future__ import annotations

from functools import cache

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hapticbridge.plotting import new_figure
from hapticbridge.rendering import METHODS
from hapticbridge.study.maps.bound_of_method import law_in_words, needed_by_6, used_damping
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

FINE = 201
"""Points along each axis from which (6) is drawn; more make its corner sharper."""


def draw(table: Table) -> Figure:
    """Draws K against B by method, with the bounds and the measured limits on top."""
    figure = new_figure(8, 8.4)
    *panels, last = figure.subplots(3, 3, sharex=True, sharey=True).ravel()
    last.remove()
    for axes, name in zip(panels, THEORIES, strict=True):
        has_wall = METHODS[name].has_law
        _draw_cells(axes, of_method(table, "cell", name))
        _draw_theory(axes, name, has_wall=has_wall)
        limits = of_method(table, "limit", name)
        axes.plot(limits["damping"], limits.numbers("limit"), "o", color="black", ms=4, mfc="white")
        axes.set_title(f"{name}{_note(name)}", fontsize="medium")
        axes.set_xlim(*DAMPING)
        axes.set_ylim(*STIFFNESS)
    for axes in panels[5:]:
        axes.set_xlabel("coupling damping B (N s/m)")
        axes.tick_params(labelbottom=True)
    for axes in panels[::3]:
        axes.set_ylabel("coupling stiffness K (N/m)")
    figure.suptitle(
        f"K against B, device damping b = {DEVICE_DAMPING:g} N s/m at {1 / PERIOD:g} Hz;\n"
        f"worst hands on a wall and with a tool of {1e3 * TOOL_MASS:g} g, and a hand that taps.\n"
        "B is asked for; the law uses B′ = B, or less where a title says so (0 at least)",
        fontsize="medium",
    )
    verdict_legend(
        figure,
        [
            ("(6): b = K T/2 + B′", "black", "-"),
            ("(7), Tustin's rule, at low frequency", "black", ":"),
            (f"free tool of {1e3 * TOOL_MASS:g} g by this method", THEORY_COLOUR, "--"),
            ("measured limit on a wall", "black", "o"),
        ],
    )
    return figure


def _draw_cells(axes: Axes, cells: Table) -> None:
    draw_verdicts(axes, cells["damping"], cells["stiffness"], verdicts_of(cells), log_y=True)


def _note(name: str) -> str:
    """Returns what a panel's title says beside the method's name."""
    method = METHODS[name]
    if not method.has_law:
        return ": free, and tapping"
    return f", {law_in_words(name)}" if method.lag else ""


def _draw_theory(axes: Axes, name: str, *, has_wall: bool) -> None:
    """Draws what was measured against: (6) and (7) only where a wall was."""
    b = DEVICE_DAMPING
    if has_wall:
        fine = np.linspace(*DAMPING, FINE), np.geomspace(*STIFFNESS, FINE)
        by_6 = needed_by_6(name, fine[1][:, None], fine[0], PERIOD)
        axes.contour(*fine, by_6, levels=[b], colors="black", linewidths=1.8)
    if has_wall and METHODS[name].lag == 0.0:
        # (7) as θ → 0: (K T)² = 2 b (K T + 2 B)
        damping = np.linspace(*DAMPING, FINE)
        low = (b + np.sqrt(b**2 + 4 * b * damping)) / PERIOD
        axes.plot(damping, low, color="black", ls=":", lw=1.5)
    axes.contour(
        np.linspace(*DAMPING, CONTOUR),
        np.geomspace(*STIFFNESS, CONTOUR),
        np.minimum(_needed(_first_alike(name)), 10 * b),
        levels=[b],
        colors=THEORY_COLOUR,
        linestyles="--",
        linewidths=1.5,
    )


def _first_alike(name: str) -> str:
    """Returns the first method with the same free tool's bound, which is so computed once."""
    mine = THEORIES[name], METHODS[name].lag
    return next(each for each in THEORIES if (THEORIES[each], METHODS[each].lag) == mine)


@cache
def _needed(name: str) -> NDArray[np.float64]:
    """Returns the device damping in N s/m that a free tool needs, rows of K by columns of B."""
    stiffness, damping = np.geomspace(*STIFFNESS, CONTOUR), np.linspace(*DAMPING, CONTOUR)
    used = used_damping(name, stiffness[:, None], damping, PERIOD)
    return np.array(
        [
            [worst_angle(THEORIES[name], k, float(b), TOOL_MASS, PERIOD)[1] for b in row]
            for k, row in zip(stiffness, used, strict=True)
        ]
    )
