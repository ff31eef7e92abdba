"""Plot of a what-if."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hapticbridge.errors import RecordingError
from hapticbridge.picture import new_figure, write_picture
from hapticbridge.recording import due_times
from hapticbridge.report import DRAWABLE, decimated
from hapticbridge.report.curves import BINS
from hapticbridge.whatif.outcome import WhatIf
from hapticbridge.whatif.side_by_side import changes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLES = (("#555555", "-", 2.2), ("#1a5fb4", "-", 1.1), ("#b3261e", "--", 1.1))
"""Colour, line and width in points of each run; the recorded one lies behind the others."""


def figure_of(found: WhatIf, bins: int = BINS) -> Figure:
    """Draws force on the device, handle displacement, and the energies of both ports over time.

    Raises:
        RecordingError: A run holds a number that cannot be drawn.
    """
    figure = new_figure(8, 11)
    panels = figure.subplots(4, 1, sharex=True)
    origin = found.runs[0].ticks["handle_position"][0]
    for run, (colour, line, width) in zip(found.runs, _STYLES, strict=False):
        ticks = run.ticks
        if not len(ticks):
            continue
        time = due_times(ticks, run.period)
        drawn = (
            np.linalg.norm(ticks["wrench_on_device"][:, :3], axis=1),
            1e3 * np.linalg.norm(ticks["handle_position"] - origin, axis=1),
            1e3 * ticks["environment_energy"],
            1e3 * ticks["device_energy"],
        )
        for axes, values in zip(panels, drawn, strict=True):
            if not (np.abs(values) < DRAWABLE).all():
                raise RecordingError(f"the run '{run.name}' holds numbers that cannot be drawn")
            axes.plot(
                *decimated(time, values, bins), color=colour, ls=line, lw=width, label=run.name
            )
    labels = (
        "force on the device (N)",
        "handle's distance from its start (mm)",
        "energy that the environment\ncreated (+) or dissipated (−) (mJ)",
        "energy that the device was\ngiven (+) or gave (−) (mJ)",
    )
    for axes, label in zip(panels, labels, strict=True):
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.margins(x=0.01)
    for axes in panels[2:]:
        axes.axhline(0.0, color="black", lw=0.6)
    panels[-1].set_xlabel("time (s)")
    # above the curves, not on them
    panels[0].legend(
        loc="lower right", bbox_to_anchor=(1, 1), fontsize="small", ncols=3, frameon=False
    )
    changed = ", ".join(f"{name} {old} → {new}" for name, old, new in changes(found))
    title = f"{found.path.name}, what if {changed or 'nothing is changed'}"
    figure.suptitle(
        "".join(letter if letter.isprintable() else "�" for letter in title),
        fontsize="medium",
        parse_math=False,
        wrap=True,
    )
    return figure


def draw_what_if(found: WhatIf, path: Path) -> None:
    """Writes ``figure_of`` to a picture file.

    Raises:
        RecordingError: It cannot be drawn.
        HapticBridgeError: The file's extension is no picture format, or it cannot be written.
    """
    write_picture(figure_of(found), path)
