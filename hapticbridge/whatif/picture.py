"""The picture of a what-if: force, position and energy of all runs over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hapticbridge.errors import RecordingError
from hapticbridge.picture import new_figure, write_picture
from hapticbridge.report import DRAWABLE, decimated
from hapticbridge.whatif.outcome import WhatIf

_STYLES = (("#555555", "-", 2.2), ("#1a5fb4", "-", 1.1), ("#b3261e", "--", 1.1))
"""Colour, line and width in points per run; the recorded one is behind the others."""


def figure_of(found: WhatIf) -> Figure:
    """Draws the force on the device, the way of the handle, and what the environment created.

    Raises:
        RecordingError: A run holds nothing, or a number beyond what can be drawn.
    """
    figure = new_figure(8, 9)
    force_axes, way_axes, energy_axes = figure.subplots(3, 1, sharex=True)
    origin = found.runs[0].ticks["handle_position"][0]
    for run, (colour, line, width) in zip(found.runs, _STYLES, strict=False):
        ticks = run.ticks
        if not len(ticks):
            continue
        time = ticks["tick"] * run.period
        force = np.linalg.norm(ticks["wrench_on_device"][:, :3], axis=1)
        way = 1e3 * np.linalg.norm(ticks["handle_position"] - origin, axis=1)
        energy = 1e3 * ticks["environment_energy"]
        for axes, values in ((force_axes, force), (way_axes, way), (energy_axes, energy)):
            if not (np.abs(values) < DRAWABLE).all():
                raise RecordingError(f"the run '{run.name}' holds numbers that cannot be drawn")
            axes.plot(*decimated(time, values), color=colour, ls=line, lw=width, label=run.name)
    energy_axes.axhline(0.0, color="black", lw=0.6)
    force_axes.set_ylabel("force on the device (N)")
    way_axes.set_ylabel("handle's distance from its start (mm)")
    energy_axes.set_ylabel("energy that the environment\ncreated (+) or dissipated (−) (mJ)")
    energy_axes.set_xlabel("time (s)")
    for axes in (force_axes, way_axes, energy_axes):
        axes.grid(alpha=0.3)
        axes.margins(x=0.01)
    # above the curves, not on them
    force_axes.legend(
        loc="lower right", bbox_to_anchor=(1, 1), fontsize="small", ncols=3, frameon=False
    )
    told = ", ".join(f"{name} {_short(old)} → {_short(new)}" for name, _, old, new in found.changes)
    title = f"{found.path.name}, what if {told or 'nothing is changed'}"
    figure.suptitle(
        "".join(letter if letter.isprintable() else "�" for letter in title),
        fontsize="medium",
        parse_math=False,
        wrap=True,
    )
    return figure


def draw_what_if(found: WhatIf, path: Path) -> None:
    """Writes ``figure_of`` to a picture.

    Raises:
        RecordingError: It cannot be drawn.
        HapticBridgeError: The file's ending is no picture format, or it cannot be written.
    """
    write_picture(figure_of(found), path)


def _short(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
