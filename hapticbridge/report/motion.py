"""Plot of force and pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hapticbridge.audit.differences import turn_between
from hapticbridge.picture import new_figure
from hapticbridge.report.curves import AXES, COLOURS, finish
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.panels import curve, widen

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_motion(evidence: Evidence) -> Figure:
    """Draws force and torque on the tool, and the poses of tool and handle."""
    ticks, time = evidence.ticks, evidence.time
    figure = new_figure(8, 7.6)
    force, torque, way, turn = figure.subplots(4, 1, sharex=True)
    start = ticks["tool_position"][0]
    way.plot([], [], color="grey", ls=":", lw=1, label="handle")
    for i, (axis, colour) in enumerate(zip(AXES, COLOURS, strict=True)):
        curve(force, time, ticks["wrench_on_tool"][:, i], color=colour, label=axis)
        curve(torque, time, 1e3 * ticks["wrench_on_tool"][:, 3 + i], color=colour, label=axis)
        tool = 1e3 * (ticks["tool_position"][:, i] - start[i])
        curve(way, time, tool, color=colour, label=f"tool {axis}")
        handle = 1e3 * (ticks["handle_position"][:, i] - start[i])
        curve(way, time, handle, color=colour, ls=":", lw=1)
    turned = (("tool", "#222222", "-"), ("handle", "grey", ":"))
    first = np.broadcast_to(ticks["tool_quaternion"][0], (len(ticks), 4))
    for name, colour, style in turned:
        angle = np.linalg.norm(turn_between(first, ticks[f"{name}_quaternion"]), axis=1)
        curve(turn, time, np.degrees(angle), color=colour, ls=style, label=name)
    for axes, label in (
        (force, "force on\nthe tool (N)"),
        (torque, "torque on\nthe tool (mN m)"),
        (way, "displacement\n(mm)"),
        (turn, "rotation\n(°)"),
    ):
        axes.set_ylabel(label)
        widen(axes)
        finish(axes)
    turn.set_xlabel("time (s)")
    return figure
