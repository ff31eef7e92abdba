"""Plots of a run over time: one picture of it, and those of its page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.audit.motion import turn_between
from hapticbridge.errors import RecordingError
from hapticbridge.files import printable
from hapticbridge.kernel.record import TickFlag, due_times, force_on_hand, has_flag
from hapticbridge.plotting import new_figure, write_picture
from hapticbridge.recording import Recording
from hapticbridge.report.evidence import DRAWABLE, Evidence, is_motion_prescribed, recorded_coupling
from hapticbridge.run.description import method_of, parameters_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


Array = NDArray[np.float64]

# Curves of a recording over time, reduced without loss of peaks


PICTURE_BINS = 1500
"""Largest number of bins per curve. Each bin draws its minimum and maximum, so no peak is lost.
More bins enlarge the file without a visible gain."""

AXES = ("x", "y", "z")
COLOURS = ("#d55e00", "#009e73", "#0072b2")
"""Colours of the axes: vermilion, green and blue, distinct for colour-blind readers (Okabe &
Ito)."""

_ENERGIES = (
    ("coupling_work", "work of the coupling", "#0072b2", "-"),
    ("environment_energy", "created (+) or dissipated (−)", "#009e73", "-"),
    ("device_energy", "given to the device", "#e69f00", "-"),
    ("actuator_work", "work of the scene's motors", "#cc79a7", "-"),
    ("external_work", "work of inputs and resets", "#56b4e9", "-"),
    ("kinetic", "kinetic", "#555555", "--"),
    ("potential", "potential, from the start", "#a08000", "--"),
)
"""Energies that are drawn. The dashed ones are stored: together they grow by the sum of the works
and of what was created."""
_DRAWN = (
    "wrench_on_tool",
    "wrench_on_device",
    "tool_position",
    "handle_position",
    *(name for name, *_ in _ENERGIES),
)
HANDLE = {"lw": 5.0, "alpha": 0.3, "solid_capstyle": "butt"}
"""Line of the handle: broad and pale, so that it is seen on both sides of the tool's."""


def decimated(
    time: NDArray[np.float64], values: NDArray[np.float64], bins: int = PICTURE_BINS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Keeps the minimum and the maximum of each bin, in their order.

    Args:
        time: Shape (n,), n >= 1.
        values: Shape (n,).
        bins: Number of bins, >= 1.

    Returns:
        At most 2 bins + 1 times and values.
    """
    size = -(-len(values) // bins)
    if size <= 2:
        return time, values
    count = len(values) // size
    blocks = values[: count * size].reshape(count, size)
    picks = np.sort(np.stack([blocks.argmin(1), blocks.argmax(1)], axis=1), axis=1)
    index = (picks + size * np.arange(count)[:, None]).ravel()
    if rest := len(values) - count * size:  # a fault often lies at the end of a run
        last = values[-rest:]
        index = np.append(index, count * size + np.sort([last.argmin(), last.argmax()]))
    index = np.append(index, len(values) - 1)
    return time[index], values[index]


def draw_recording(*hands: Recording) -> Figure:
    """Draws force, position and energies over time; of several hands, each in a column.

    Raises:
        RecordingError: The recording has no tick, no run parameters, or a number that cannot be
            drawn.
    """
    has_several_hands = len(hands) > 1
    figure = new_figure(5.5 * len(hands) if has_several_hands else 8, 8)
    columns = figure.subplots(3, len(hands), sharex=True, squeeze=False).T
    for recording, panels in zip(hands, columns, strict=True):
        _draw_hand(recording, panels, has_several_hands=has_several_hands)
    meta = hands[0].meta
    method, period = method_of(meta), parameters_of(meta).period
    title = printable(f"{meta.get('scene', '')}: method {method.name}, {1 / period:g} Hz")
    if not has_several_hands:
        title += f"\n{_coupling_sentence(hands[0])}"
    figure.suptitle(title, fontsize="medium", parse_math=False)
    return figure


def _coupling_sentence(recording: Recording) -> str:
    return recorded_coupling(recording).sentences()[0]


def _draw_hand(
    recording: Recording, panels: NDArray[np.object_], *, has_several_hands: bool
) -> None:
    ticks, meta = recording.ticks, recording.meta
    if not len(ticks):
        raise RecordingError(f"'{recording.path}' has no tick to draw")
    parameters = parameters_of(meta)
    if not all((np.abs(ticks[name]) < DRAWABLE).all() for name in _DRAWN):
        raise RecordingError(f"'{recording.path}' holds numbers that cannot be drawn")
    time = due_times(ticks, parameters.period)
    force_axes, position_axes, energy_axes = panels
    position_axes.plot([], [], color="grey", **HANDLE, label="handle")
    hand = force_on_hand(ticks, parameters.axes)
    is_held = not is_motion_prescribed(meta)
    is_joint = parameters.is_joint
    unit = 1.0 if is_joint else 1e3
    for i, (axis, colour) in enumerate(zip(AXES[:1] if is_joint else AXES, COLOURS, strict=False)):
        tool_force = decimated(time, ticks["wrench_on_tool"][:, i])
        if is_held:
            force_axes.plot(*decimated(time, hand[:, i]), color=colour, label=f"hand {axis}")
        force_axes.plot(*tool_force, color=colour, ls=":", lw=1, label=f"tool {axis}")
        start = ticks["tool_position"][0, i]
        tool = unit * (ticks["tool_position"][:, i] - start)
        handle = unit * (ticks["handle_position"][:, i] - start)
        position_axes.plot(*decimated(time, tool), color=colour, label=f"tool {axis}")
        position_axes.plot(*decimated(time, handle), color=colour, **HANDLE)
    for name, label, colour, style in _ENERGIES:
        joules = ticks[name] - (ticks[name][0] if name == "potential" else 0.0)
        if joules.any():
            energy_axes.plot(*decimated(time, 1e3 * joules), color=colour, ls=style, label=label)
    force_axes.set_ylabel("force on hand and tool (N)" if is_held else "force on the tool (N)")
    position_axes.set_ylabel("displacement (mm)")
    if is_joint:
        force_axes.set_ylabel("force on the fingers (N), on the joint (N or N m)")
        position_axes.set_ylabel("displacement of the joint (m or rad)")
    energy_axes.set_ylabel("energy (mJ)")
    energy_axes.set_xlabel("time (s)")
    for axes in panels:
        finish(axes)
    if has_several_hands:
        coupling = recorded_coupling(recording)
        shown = coupling.effective or coupling.law
        gains = f"K = {shown.stiffness:.4g} N/m, B = {shown.damping:.3g} N s/m" if shown else ""
        head = f"{printable(parameters.grip)}: {gains}"
        force_axes.set_title(head, fontsize="small", loc="left", pad=46, parse_math=False)


def finish(axes: Axes) -> None:
    """Adds the grid, and a legend above the curves."""
    axes.grid(alpha=0.3)
    axes.margins(x=0.01)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), fontsize="small", ncols=4, frameon=False)


def plot_recording(path: Path, *hands: Recording) -> None:
    """Writes ``draw_recording`` to a picture file.

    Raises:
        RecordingError: The recording cannot be drawn.
        HapticBridgeError: The file's extension is no picture format, or it cannot be written.
    """
    write_picture(draw_recording(*hands), path)


# Elements shared by a page's plots

PAGE_BINS = 400
"""Number of bins per curve on a page; each is two pixels wide. With 400, the page of a ten-minute
run has half a megabyte."""


UNITS = ((1.0, "J"), (1e-3, "mJ"), (1e-6, "µJ"), (1e-9, "nJ"))
"""Units of energy on plots; below a nanojoule there is only rounding."""

MIN_SPAN = 1e-3
"""Smallest range of a panel's axis, in its own unit. A smaller range would magnify rounding
noise."""


def curve(axes: Axes, time: Array, values: Array, **style: object) -> None:
    """Draws a curve of any length without losing a peak."""
    axes.plot(*decimated(time, values, PAGE_BINS), **style)  # type: ignore[arg-type]


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
    size = -(-len(is_on) // PAGE_BINS)
    starts = np.arange(0, len(is_on), size)
    any_on = np.logical_or.reduceat(is_on, starts)
    edges = np.diff(any_on.astype(np.int8), prepend=0, append=0)
    times = np.append(time[starts], 2 * time[-1] - time[-2] if len(time) > 1 else time[-1])
    return list(zip(times[edges == 1], times[edges == -1], strict=True))
