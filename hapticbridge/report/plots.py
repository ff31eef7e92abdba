"""Elements shared by a page's plots."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.audit.motion import turn_between
from hapticbridge.plotting import new_figure
from hapticbridge.record import TickFlag, force_on_hand, has_flag
from hapticbridge.report.evidence import AXES, COLOURS, HANDLE, Evidence, decimated, finish

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


Array = NDArray[np.float64]

BINS = 400
"""Number of bins per curve on a page; each is two pixels wide. With 400, the page of a ten-minute
run has half a megabyte."""


UNITS = ((1.0, "J"), (1e-3, "mJ"), (1e-6, "µJ"), (1e-9, "nJ"))
"""Units of energy on plots; below a nanojoule there is only rounding."""

MIN_SPAN = 1e-3
"""Smallest range of a panel's axis, in its own unit. A smaller range would magnify rounding
noise."""


def curve(axes: Axes, time: Array, values: Array, **style: object) -> None:
    """Draws a curve of any length without losing a peak."""
    axes.plot(*decimated(time, values, BINS), **style)  # type: ignore[arg-type]


def energy_unit(*energies: Array) -> tuple[float, str]:
    """Returns size and name of the unit that shows energies in J with few digits."""
    largest = max(float(np.abs(energy).max(initial=0.0)) for energy in energies)
    return next((unit for unit in UNITS if largest >= unit[0]), UNITS[-1])


def bounded(axes: Axes, time: Array, energy: Array, allowed: Array, label: str) -> None:
    """Draws an energy in J and its bound."""
    size, unit = energy_unit(energy, allowed)
    curve(axes, time, energy / size, color="#1a5fb4", label=label)
    curve(axes, time, allowed / size, color="#b3261e", ls="--", label="allowed at most")
    axes.set_ylabel(f"energy ({unit})")
    widen(axes)


def widen(axes: Axes) -> None:
    """Enforces a minimum axis range so that rounding noise is not magnified."""
    low, high = axes.get_ylim()
    if high - low < MIN_SPAN:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * MIN_SPAN, middle + 0.5 * MIN_SPAN)


# Plot of each port's energy and its bound

_PORTS = (
    ("coupling_work", "coupling", "#0072b2"),
    ("actuator_work", "the scene's actuators", "#009e73"),
    ("external_work", "external", "#cc79a7"),
    ("device_energy", "device", "#e69f00"),
)


def draw_energies(evidence: Evidence) -> Figure:
    """Draws the energy of each port, and the bounds of environment and device."""
    ticks, time = evidence.ticks, evidence.time
    is_watched = bool(evidence.excess.any())
    figure = new_figure(8, 6.6 if is_watched else 4.8)
    panels = figure.subplots(3 if is_watched else 2, 1, sharex=True)
    ports, bound = panels[:2]
    stored = ticks["kinetic"] + ticks["potential"]
    size, unit = energy_unit(*(ticks[name] for name, *_ in _PORTS), stored - stored[0])
    for name, label, colour in _PORTS:
        if ticks[name].any():
            curve(ports, time, ticks[name] / size, color=colour, label=label)
    curve(ports, time, (stored - stored[0]) / size, color="grey", ls="--", label="stored")
    ports.set_ylabel(f"given through\na port ({unit})")
    widen(ports)
    bounded(bound, time, evidence.created, evidence.allowed, "created by the environment")
    if is_watched:
        free = np.zeros_like(time)
        bounded(panels[2], time, evidence.excess, free, "given to the device, beyond what is paid")
    for axes in panels:
        finish(axes)
    panels[-1].set_xlabel("time (s)")
    return figure


# Plot of the ticks around a fault

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
    judged, allowed = evidence.judged(report)
    label = "given to the device, unpaid" if report.port == "device" else "created in the scene"
    bounded(energy, numbers, judged[around], allowed[around], label)
    stretch = evidence.ticks["handle_position"] - evidence.ticks["tool_position"]
    is_held = not evidence.info.is_prescribed
    forces = evidence.ticks["wrench_on_tool"][:, :3]
    if is_held:
        forces = force_on_hand(evidence.ticks, evidence.parameters.axes)
    for i, (axis, colour) in enumerate(zip(AXES, COLOURS, strict=True)):
        force.plot(numbers, forces[around, i], color=colour, marker=".", ms=3, lw=1, label=axis)
        apart.plot(numbers, 1e3 * stretch[around, i], color=colour, lw=1, label=axis)
    force.set_ylabel("force on\nthe hand (N)" if is_held else "force on\nthe tool (N)")
    apart.set_ylabel("spring: handle\n− tool (mm)")
    for axes in (energy, force, apart):
        axes.axvline(tick, color="black", ls="--", lw=1, label=f"tick {tick}")
        finish(axes)
    apart.set_xlabel("tick")
    return figure


# Plot of force and pose


def draw_motion(evidence: Evidence) -> Figure:
    """Draws the force on hand and tool, the torque on the tool, and the poses of tool and handle.

    The force on the hand is left out for a prescribed motion, which no hand feels.
    """
    ticks, time = evidence.ticks, evidence.time
    is_held = not evidence.info.is_prescribed
    figure = new_figure(8, 9.0 if is_held else 7.6)
    *hand, force, torque, way, turn = figure.subplots(4 + is_held, 1, sharex=True)
    on_hand = force_on_hand(ticks, evidence.parameters.axes)
    start = ticks["tool_position"][0]
    way.plot([], [], color="grey", **HANDLE, label="handle")
    for i, (axis, colour) in enumerate(zip(AXES, COLOURS, strict=True)):
        for axes in hand:
            curve(axes, time, on_hand[:, i], color=colour, label=axis)
        curve(force, time, ticks["wrench_on_tool"][:, i], color=colour, label=axis)
        curve(torque, time, 1e3 * ticks["wrench_on_tool"][:, 3 + i], color=colour, label=axis)
        tool = 1e3 * (ticks["tool_position"][:, i] - start[i])
        curve(way, time, tool, color=colour, label=f"tool {axis}")
        handle = 1e3 * (ticks["handle_position"][:, i] - start[i])
        curve(way, time, handle, color=colour, **HANDLE)
    turned = (("tool", "#222222", "-"), ("handle", "grey", ":"))
    first = np.broadcast_to(ticks["tool_quaternion"][0], (len(ticks), 4))
    for name, colour, style in turned:
        angle = np.linalg.norm(turn_between(first, ticks[f"{name}_quaternion"]), axis=1)
        curve(turn, time, np.degrees(angle), color=colour, ls=style, label=name)
    for axes, label in (
        *((axes, "force on\nthe hand (N)") for axes in hand),
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


# Plot of lateness and of active limits


FLAGS = (
    (TickFlag.RAMPING, "force rises"),
    (TickFlag.FORCE_LIMITED, "force limited"),
    (TickFlag.CONTROLLER_ACTIVE, "controller"),
    (TickFlag.CLUTCH, "let go: clutch or dead man"),
    (TickFlag.REANCHORED, "re-anchored"),
    (TickFlag.CONTACT, "contact"),
    (TickFlag.STALE_SAMPLE, "old sample"),
    (TickFlag.OVERRUN, "late tick"),
    (TickFlag.SWINGING, "lowered: it swings"),
    (TickFlag.RUNS_AWAY, "taken away: wrong way"),
    (TickFlag.PROBED, "probed: late or not"),
    (TickFlag.UNANSWERED, "motor not known"),
)
"""Flags shown over time, and their labels."""


def activities(evidence: Evidence) -> list[tuple[str, NDArray[np.bool_]]]:
    """Returns labels, and the ticks in which each was on, (n,)."""
    ticks, guarding = evidence.ticks, evidence.parameters.guarding
    found = [(name, has_flag(ticks, flag)) for flag, name in FLAGS]
    is_stale = has_flag(ticks, TickFlag.STALE_SAMPLE)
    fades = np.zeros_like(is_stale)
    if guarding.stale_ticks:
        row = np.arange(len(ticks))
        newest = np.maximum.accumulate(np.where(is_stale, -1, row))
        fades = row - newest > guarding.stale_ticks
    trips = [event.get("tick") for event in evidence.events if event.get("event") == "trip"]
    # the tick that trips is often not recorded; the last recorded one stands for it
    is_tripped = np.zeros_like(is_stale)
    is_tripped[[min(max(t, 0), len(ticks) - 1) for t in trips if isinstance(t, int)]] = True
    return [*found, ("faded: no samples", fades), ("tripped", is_tripped)]


def draw_timing(evidence: Evidence) -> Figure:
    """Draws the lateness of ticks, and when limiter and controller were active.

    Panels without content are left out: lateness in simulated time, injected damping without an
    active controller.
    """
    kinds = (("injected_damping", "N s/m"), ("injected_rotational_damping", "N m s/rad"))
    injected = [(evidence.ticks[f], unit) for f, unit in kinds if evidence.ticks[f].any()]
    is_timed = bool(evidence.lateness.any())
    heights = [2.2] * is_timed + [2.8] + [1.6] * len(injected)
    figure = new_figure(8, sum(heights))
    panels = list(np.atleast_1d(figure.subplots(len(heights), 1, height_ratios=heights)))
    if is_timed:
        _draw_lateness(panels.pop(0), evidence)
    active, time = panels.pop(0), evidence.time
    end = time[-1] + evidence.parameters.period
    shown = activities(evidence)
    for row, (_, is_on) in enumerate(shown):
        bars = [(start, stop - start) for start, stop in _stretches(is_on, time)]
        active.broken_barh(bars, (row - 0.4, 0.8), color="#e66100")
    active.set_yticks(range(len(shown)), [name for name, _ in shown])
    active.set_xlim(time[0], end)
    active.set_ylim(len(shown) - 0.5, -0.5)  # first row on top
    active.grid(alpha=0.3, axis="x")
    for damped, (damping, unit) in zip(panels, injected, strict=True):
        curve(damped, time, damping, color="#e66100", label="injected by the controller")
        damped.set_ylabel(f"damping ({unit})")
        finish(damped)
        damped.set_xlim(time[0], end)
    (panels or [active])[-1].set_xlabel("time (s)")
    return figure


MIN_LATENESS = 1.0
"""Lateness in µs below which ticks are drawn at the left edge: a clock is read no finer."""


def _draw_lateness(axes: Axes, evidence: Evidence) -> None:
    lateness = np.maximum(1e6 * evidence.lateness, MIN_LATENESS)
    period = 1e6 * evidence.parameters.period
    bins = np.geomspace(MIN_LATENESS, max(lateness.max(), 10 * MIN_LATENESS), 81)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.hist(lateness, bins=list(bins), color="#1a5fb4", log=True, label="ticks")
    # after a stall of seconds the line of one period would not be visible
    if lateness.max() > 0.2 * period:
        axes.axvline(period, color="#b3261e", ls="--", label="one period: a deadline is missed")
    axes.set_xlabel("lateness: start of a tick after its deadline (µs; at the left edge 1 or less)")
    axes.set_ylabel("ticks")
    finish(axes)


def _stretches(is_on: NDArray[np.bool_], time: Array) -> list[tuple[float, float]]:
    """Returns start and end times of active stretches; pauses shorter than a bin are closed."""
    size = -(-len(is_on) // BINS)
    starts = np.arange(0, len(is_on), size)
    any_on = np.logical_or.reduceat(is_on, starts)
    edges = np.diff(any_on.astype(np.int8), prepend=0, append=0)
    times = np.append(time[starts], 2 * time[-1] - time[-2] if len(time) > 1 else time[-1])
    return list(zip(times[edges == 1], times[edges == -1], strict=True))
