"""Plot of the ticks around a fault."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hapticbridge.audit import AuditReport
from hapticbridge.picture import new_figure
from hapticbridge.report.curves import AXES, COLOURS, finish
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.panels import bounded

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ZOOM = 60
"""Number of ticks shown before and after the moment."""


def draw_moment(evidence: Evidence, report: AuditReport) -> Figure:
    """Draws the ticks around the one at which a port became active.

    The verdict is ``active``, at a tick of the run.
    """
    tick = report.tick or 0
    around = slice(max(0, tick - ZOOM), tick + ZOOM + 1)
    numbers = evidence.ticks["tick"][around]
    figure = new_figure(8, 6)
    energy, force, apart = figure.subplots(3, 1, sharex=True)
    given, allowed = evidence.judged(report)
    label = "given to the device, unpaid" if report.port == "device" else "created in the scene"
    bounded(energy, numbers, given[around], allowed[around], label)
    stretch = evidence.ticks["handle_position"] - evidence.ticks["tool_position"]
    for i, (axis, colour) in enumerate(zip(AXES, COLOURS, strict=True)):
        sent = evidence.ticks["wrench_on_device"][around, i]
        force.plot(numbers, sent, color=colour, marker=".", ms=3, lw=1, label=axis)
        apart.plot(numbers, 1e3 * stretch[around, i], color=colour, lw=1, label=axis)
    force.set_ylabel("force on\nthe device (N)")
    apart.set_ylabel("spring: handle\n− tool (mm)")
    for axes in (energy, force, apart):
        axes.axvline(tick, color="black", ls="--", lw=1, label=f"tick {tick}")
        finish(axes)
    apart.set_xlabel("tick")
    return figure
