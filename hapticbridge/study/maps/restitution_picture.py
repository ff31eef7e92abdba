"""How the map ``restitution`` is drawn: energy over the angle above, all settings below."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from hapticbridge.plotting import new_figure
from hapticbridge.study.maps.falling_rod import APPROACH, LENGTH, MASS
from hapticbridge.study.maps.palette import THEORY_COLOUR
from hapticbridge.study.maps.verdicts import say_missing
from hapticbridge.study.table import Table

SLIDE = 0.8
"""Speed in m/s along the floor, forwards, backwards or none."""

SHOWN = 0.75
"""The friction coefficient whose curves are drawn, that of the example in which Newton gains."""

DRAWN = ("scenes", "bouncy, implicitfast")

COLOURS = {
    "inelastic": "#b0b0b0",
    "newton": THEORY_COLOUR,
    "poisson": "#7fb2ee",
    "stronge": "#0d2c54",
}
"""Of the laws, tints of theory's; ``inelastic`` is any of them with e = 0. What was measured is
black."""

STYLES = {"inelastic": ":", "newton": "-", "poisson": "--", "stronge": "-."}
MEASURED: Mapping[str, Any] = {
    "color": "black",
    "ls": "",
    "marker": "o",
    "ms": 3.5,
    "mfc": "white",
}

Summary = dict[str, Any]
"""What one contact setting came to."""


def draw(table: Table, by_setting: Mapping[str, Summary]) -> Figure:
    """Draws the energy over the angle, and how far each law is from MuJoCo.

    Args:
        table: Of the map.
        by_setting: What each contact setting came to.
    """
    figure = new_figure(8, 7.2)
    panels = figure.subplots(2, 2, gridspec_kw={"height_ratios": [1, 1.1]})
    for axes, name in zip(panels[0], DRAWN, strict=True):
        _draw_curves(axes, table, name)
    panels[0, 0].set_ylabel("change of kinetic energy (J)")
    _draw_bars(panels[1, 0], by_setting)
    _draw_gains(panels[1, 1], by_setting)
    figure.suptitle(
        f"A rod of {MASS:g} kg and {LENGTH:g} m falls at {APPROACH:g} m/s on MuJoCo's floor;\n"
        f"above: it slides at {SLIDE:g} m/s, friction {SHOWN:g}",
        fontsize="medium",
    )
    _legend(figure)
    return figure


def _draw_curves(axes: Axes, table: Table, name: str) -> None:
    rows = (table["setting"] == name) & (table["friction"] == SHOWN) & (table["slide"] == SLIDE)
    mine = table.select(rows)
    if not len(mine):
        say_missing(axes)
        return
    angle = np.degrees(mine["angle"])
    for law, colour in COLOURS.items():
        axes.plot(angle, mine[law], color=colour, ls=STYLES[law], lw=1.6)
    axes.plot(angle, mine["energy_change"], **MEASURED)
    axes.axhline(0.0, color="black", lw=0.6)
    axes.set_xlabel("angle of the rod above the floor (°)")
    axes.set_title(f"{name}: e = {mine['restitution'][0]:.2g}", fontsize="medium")


def _legend(figure: Figure) -> None:
    """Names laws and measurement, whether or not a panel shows them."""
    handles = [
        Line2D([], [], color=colour, ls=STYLES[law], lw=1.6, label=_named(law))
        for law, colour in COLOURS.items()
    ]
    handles.append(Line2D([], [], label="MuJoCo", **MEASURED))
    figure.legend(
        handles=handles, loc="outside lower center", ncols=5, fontsize="small", frameon=False
    )


def _named(law: str) -> str:
    return "any law, e = 0" if law == "inelastic" else law.capitalize()


def _draw_bars(axes: Axes, by_setting: Mapping[str, Summary]) -> None:
    place = np.arange(len(by_setting))
    for shift, (law, colour) in enumerate(COLOURS.items()):
        distances = [row["rms_distance_to_law"][law] for row in by_setting.values()]
        axes.barh(place + 0.2 * (shift - 1.5), distances, 0.2, color=colour)
    axes.set_yticks(place, [name.replace(", ", ",\n", 1) for name in by_setting], fontsize="small")
    axes.invert_yaxis()
    axes.set_xlabel("distance from MuJoCo, RMS (J)")


def _draw_gains(axes: Axes, by_setting: Mapping[str, Summary]) -> None:
    place = np.arange(len(by_setting))
    axes.barh(
        place - 0.18,
        [row["largest_energy_change"] for row in by_setting.values()],
        0.36,
        fc="black",
    )
    axes.barh(
        place + 0.18,
        [row["largest_by_newton"] for row in by_setting.values()],
        0.36,
        color=COLOURS["newton"],
    )
    axes.set_yticks(place, [name.replace(", ", ",\n", 1) for name in by_setting], fontsize="small")
    axes.invert_yaxis()
    axes.axvline(0.0, color="black", lw=0.6)
    axes.set_xlabel("largest change of energy (J)\nblack: MuJoCo, blue: Newton")
