"""How the map ``tool_mass`` is drawn: a panel a method, theory and limits over verdicts."""

from __future__ import annotations

from functools import cache

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hapticbridge.plotting import new_figure
from hapticbridge.study.maps.bound_of_method import limit_by_6
from hapticbridge.study.maps.free_tool import least_mass, worst_angle
from hapticbridge.study.maps.palette import THEORY_COLOUR
from hapticbridge.study.maps.tool_mass_runs import (
    DAMPING,
    DEVICE_DAMPING,
    MASS,
    PERIOD,
    STIFFNESS,
    THEORIES,
    is_stable,
    law_damping,
    of_method,
)
from hapticbridge.study.maps.verdicts import draw_verdicts, verdict_legend, verdict_numbers
from hapticbridge.study.table import Table

Array = NDArray[np.float64]

CONTOUR = 61
"""Points along each axis from which the worst hand's bound is drawn; more make it smoother and take
a tenth of a millisecond each."""

_MARKERS = {"held still": "s", "worst hand": "o"}

_LINES = (
    ("(6): b = K T/2 + B′", "black", "-"),
    ("implicitfast: slack used up, K = B/T", "black", "-."),
    ("least mass by theory, held still", THEORY_COLOUR, ":"),
    ("limit by theory, worst hand", THEORY_COLOUR, "--"),
)


def draw(table: Table) -> Figure:
    """Draws stiffness against mass by method, theory on top."""
    figure = new_figure(8, 7.6)
    panels = figure.subplots(2, 3, sharex=True, sharey=True).ravel()
    for axes, name in zip(panels, THEORIES, strict=True):
        cells = of_method(table, "cell", name)
        verdict = verdict_numbers(is_stable(cells), cells.texts("environment"))
        draw_verdicts(axes, cells["mass"], cells["stiffness"], verdict, log_x=True, log_y=True)
        _draw_theory(axes, name)
        for what, marker in _MARKERS.items():
            rows = of_method(table, what, name)
            axes.plot(
                rows.numbers("limit"), rows["stiffness"], marker, color="black", mfc="white", ms=4.5
            )
        axes.set_title(name, fontsize="medium")
        axes.set_xlim(*MASS)
        axes.set_ylim(*STIFFNESS)
    for axes in panels[3:]:
        axes.set_xlabel("tool mass m (kg)")
        axes.set_xticks(np.geomspace(MASS[0], MASS[1] / 10, 4))  # the last would touch the next
    for axes in panels[::3]:
        axes.set_ylabel("coupling stiffness K (N/m)")
    figure.suptitle(
        f"Which tool at which stiffness: free tool, B = {DAMPING:g} N s/m, "
        f"device damping b = {DEVICE_DAMPING:g} N s/m, {1 / PERIOD:g} Hz;\n"
        "the law of 'compensated' uses B′ = B − K T, of 'lossless' B − K T/2 (0 at least)",
        fontsize="medium",
    )
    measured = [(f"measured, {what}", "black", marker) for what, marker in _MARKERS.items()]
    verdict_legend(figure, [*_LINES, *measured], columns=3)
    return figure


@cache
def _needed(name: str) -> tuple[Array, Array, Array]:
    """Returns mass, stiffness and the device damping that theory asks for, (n,), (n,), (n, n)."""
    mass, stiffness = np.geomspace(*MASS, CONTOUR), np.geomspace(*STIFFNESS, CONTOUR)
    needed = [
        [worst_angle(THEORIES[name], k, law_damping(name, k), m, PERIOD)[1] for m in mass]
        for k in stiffness
    ]
    return mass, stiffness, np.array(needed)


def _draw_theory(axes: Axes, name: str) -> None:
    mass, stiffness, needed = _needed(name)
    least = np.array(
        [least_mass(THEORIES[name], k, law_damping(name, k), PERIOD) for k in stiffness]
    )
    is_shown = np.isfinite(least) & (least > 0)
    axes.plot(least[is_shown], stiffness[is_shown], color=THEORY_COLOUR, ls=":", lw=2.2)
    axes.contour(
        mass,
        stiffness,
        # where the tool is unstable by itself no damping is enough; the cap makes that a number
        np.minimum(needed, 3 * DEVICE_DAMPING),
        levels=[DEVICE_DAMPING],
        colors=THEORY_COLOUR,
        linestyles="--",
        linewidths=1.6,
    )
    if name == "implicitfast":
        # its spring lags by a step, so E_k = K δx² − ½ m (Δv)², against a slack of ½ (K + B/T) δx²
        axes.axhline(DAMPING / PERIOD, color="black", ls="-.", lw=1.4)
    axes.axhline(float(limit_by_6(name, DEVICE_DAMPING, PERIOD, DAMPING)), color="black", lw=1.8)
