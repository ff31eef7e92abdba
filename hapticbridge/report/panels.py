"""The pictures of a report: motion, energies against what is allowed, timing, and the moment."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.audit.differences import turn_between
from hapticbridge.picture import new_figure
from hapticbridge.report.curves import AXES, COLOURS, decimated, finish
from hapticbridge.report.evidence import Evidence
from hapticbridge.tick import TickFlag

Array = NDArray[np.float64]

BINS = 400
"""Points per curve of a page: each is two pixels of its width. More makes the page larger: at 400
that of ten minutes has half a megabyte."""

ZOOM = 60
"""Ticks before and after the moment that its picture shows."""

_LEAST_SPAN = 1e-3
"""Of a panel, in its own unit; rounding would otherwise fill it and look like a motion."""

ACTIVITIES = (
    (TickFlag.RAMPING, "start ramp"),
    (TickFlag.FORCE_LIMITED, "force limited"),
    (TickFlag.SLEW_LIMITED, "slew limited"),
    (TickFlag.CONTROLLER_ACTIVE, "controller"),
    (TickFlag.CLUTCH, "clutch"),
    (TickFlag.CONTACT, "contact"),
    (TickFlag.STALE_SAMPLE, "old sample"),
    (TickFlag.OVERRUN, "late tick"),
)
"""Flags that a page shows over time, and their names there."""

_PORTS = (
    ("coupling_work", "coupling"),
    ("actuator_work", "the scene's actuators"),
    ("external_work", "external"),
    ("device_energy", "device"),
)


def draw_motion(evidence: Evidence) -> Figure:
    """Draws force and torque on the tool, and the poses of tool and handle."""
    ticks, time = evidence.ticks, evidence.time
    figure = new_figure(8, 9)
    force, torque, way, turn = figure.subplots(4, 1, sharex=True)
    start = ticks["tool_position"][0]
    way.plot([], [], color="grey", ls=":", lw=1, label="handle")
    for i, (axis, colour) in enumerate(zip(AXES, COLOURS, strict=True)):
        _curve(force, time, ticks["wrench_on_tool"][:, i], color=colour, label=axis)
        _curve(torque, time, 1e3 * ticks["wrench_on_tool"][:, 3 + i], color=colour, label=axis)
        tool = 1e3 * (ticks["tool_position"][:, i] - start[i])
        _curve(way, time, tool, color=colour, label=f"tool {axis}")
        handle = 1e3 * (ticks["handle_position"][:, i] - start[i])
        _curve(way, time, handle, color=colour, ls=":", lw=1)
    turned = (("tool", "#222222", "-"), ("handle", "grey", ":"))
    first = np.broadcast_to(ticks["tool_quaternion"][0], (len(ticks), 4))
    for name, colour, style in turned:
        angle = np.linalg.norm(turn_between(first, ticks[f"{name}_quaternion"]), axis=1)
        _curve(turn, time, np.degrees(angle), color=colour, ls=style, label=name)
    for axes, label in (
        (force, "force on the tool (N)"),
        (torque, "torque on the tool (mN m)"),
        (way, "way from the start (mm)"),
        (turn, "turned from the start (°)"),
    ):
        axes.set_ylabel(label)
        _widen(axes)
        finish(axes)
    turn.set_xlabel("time (s)")
    return figure


def draw_energies(evidence: Evidence) -> Figure:
    """Draws the energy of each port, and what environment and device may have at most."""
    ticks, time = evidence.ticks, evidence.time
    is_watched = bool(evidence.kicked.any())
    figure = new_figure(8, 8 if is_watched else 6)
    panels = figure.subplots(3 if is_watched else 2, 1, sharex=True)
    ports, bound = panels[:2]
    for name, label in _PORTS:
        if ticks[name].any():
            _curve(ports, time, 1e3 * ticks[name], label=label)
    stored = ticks["kinetic"] + ticks["potential"]
    _curve(ports, time, 1e3 * (stored - stored[0]), color="grey", ls="--", label="stored")
    ports.set_ylabel("given through a port (mJ)")
    _bounded(bound, time, evidence.created, evidence.allowed, "created by the environment")
    if is_watched:
        free = np.zeros_like(time)
        _bounded(panels[2], time, evidence.kicked, free, "given to the device, beyond what is paid")
    for axes in panels:
        finish(axes)
    panels[-1].set_xlabel("time (s)")
    return figure


def draw_timing(evidence: Evidence) -> Figure:
    """Draws how late ticks began, and when limiter, controller and the like were at work."""
    figure = new_figure(8, 6)
    late, active = figure.subplots(2, 1, height_ratios=[1, 1.2])
    lateness = 1e6 * evidence.lateness
    period = 1e6 * evidence.parameters.period
    late.hist(lateness, bins=80, color="#1a5fb4", log=True, label="ticks")
    # a stall of seconds would otherwise push the line of one period out of sight
    if lateness.max() > 0.2 * period:
        late.axvline(period, color="#b3261e", ls="--", label="one period: a deadline is missed")
    late.set_xlabel("lateness: start of a tick after its deadline (µs)")
    late.set_ylabel("ticks")
    finish(late)
    time, flags = evidence.time, evidence.ticks["flags"]
    for row, (flag, _) in enumerate(ACTIVITIES):
        bars = [(start, end - start) for start, end in _stretches((flags & int(flag)) != 0, time)]
        active.broken_barh(bars, (row - 0.4, 0.8), color="#e66100")
    active.set_yticks(range(len(ACTIVITIES)), [name for _, name in ACTIVITIES])
    active.set_xlim(time[0], time[-1] + evidence.parameters.period)
    active.invert_yaxis()
    active.set_xlabel("time (s)")
    active.grid(alpha=0.3, axis="x")
    return figure


def draw_moment(evidence: Evidence, report: AuditReport) -> Figure:
    """Draws the ticks around the one at which a port became active.

    Args:
        evidence: Of the run.
        report: The audit's verdict ``active``, with a tick that the run has.
    """
    tick = report.tick or 0
    around = slice(max(0, tick - ZOOM), tick + ZOOM + 1)
    numbers = evidence.ticks["tick"][around]
    figure = new_figure(8, 7)
    energy, force, apart = figure.subplots(3, 1, sharex=True)
    if report.port == "device":
        allowed = np.zeros(len(numbers))
        _bounded(energy, numbers, evidence.kicked[around], allowed, "given to the device, unpaid")
    else:
        created, allowed = evidence.created[around], evidence.allowed[around]
        _bounded(energy, numbers, created, allowed, "created by the environment")
    stretch = evidence.ticks["handle_position"] - evidence.ticks["tool_position"]
    for i, (axis, colour) in enumerate(zip(AXES, COLOURS, strict=True)):
        sent = evidence.ticks["wrench_on_device"][around, i]
        force.plot(numbers, sent, color=colour, marker=".", ms=3, lw=1, label=axis)
        apart.plot(numbers, 1e3 * stretch[around, i], color=colour, lw=1, label=axis)
    force.set_ylabel("force on the device (N)")
    apart.set_ylabel("spring: handle − tool (mm)")
    for axes in (energy, force, apart):
        axes.axvline(tick, color="black", ls="--", lw=1, label=f"tick {tick}")
        finish(axes)
    apart.set_xlabel("tick")
    return figure


def _widen(axes: Axes) -> None:
    low, high = axes.get_ylim()
    if high - low < _LEAST_SPAN:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * _LEAST_SPAN, middle + 0.5 * _LEAST_SPAN)


def _curve(axes: Axes, time: Array, values: Array, **style: object) -> None:
    axes.plot(*decimated(time, values, BINS), **style)  # type: ignore[arg-type]


def _bounded(axes: Axes, time: Array, energy: Array, allowed: Array, label: str) -> None:
    _curve(axes, time, 1e3 * energy, color="#1a5fb4", label=label)
    _curve(axes, time, 1e3 * allowed, color="#b3261e", ls="--", label="allowed at most")
    axes.set_ylabel("energy (mJ)")


def _stretches(is_on: NDArray[np.bool_], time: Array) -> list[tuple[float, float]]:
    """Returns from when to when something was on; shorter pauses than a bin are closed."""
    size = -(-len(is_on) // BINS)
    starts = np.arange(0, len(is_on), size)
    any_on = np.logical_or.reduceat(is_on, starts)
    edges = np.diff(any_on.astype(np.int8), prepend=0, append=0)
    times = np.append(time[starts], 2 * time[-1] - time[-2] if len(time) > 1 else time[-1])
    return list(zip(times[edges == 1], times[edges == -1], strict=True))
