"""Plot of lateness and of active limits."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.watched import Flags, has_flag, run_lengths
from hapticbridge.picture import new_figure
from hapticbridge.report.curves import finish
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.panels import BINS, Array, curve
from hapticbridge.tick import TickFlag

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FLAGS = (
    (TickFlag.RAMPING, "force rises"),
    (TickFlag.FORCE_LIMITED, "force limited"),
    (TickFlag.SLEW_LIMITED, "slew limited"),
    (TickFlag.CONTROLLER_ACTIVE, "controller"),
    (TickFlag.CLUTCH, "let go: clutch or dead man"),
    (TickFlag.RESEATED, "re-seated"),
    (TickFlag.CONTACT, "contact"),
    (TickFlag.STALE_SAMPLE, "old sample"),
    (TickFlag.OVERRUN, "late tick"),
)
"""Flags shown over time, and their labels."""


def activities(evidence: Evidence) -> list[tuple[str, Flags]]:
    """Returns labels, and the ticks in which each was on, (n,)."""
    ticks, guarding = evidence.ticks, evidence.parameters.guarding
    found = [(name, has_flag(ticks, flag)) for flag, name in FLAGS]
    is_stale = has_flag(ticks, TickFlag.STALE_SAMPLE)
    fades = np.zeros_like(is_stale)
    if guarding.stale_ticks:
        fades = run_lengths(is_stale, 0) > guarding.stale_ticks
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


def _draw_lateness(axes: Axes, evidence: Evidence) -> None:
    lateness = 1e6 * evidence.lateness
    period = 1e6 * evidence.parameters.period
    axes.hist(lateness, bins=80, color="#1a5fb4", log=True, label="ticks")
    # after a stall of seconds the line of one period would not be visible
    if lateness.max() > 0.2 * period:
        axes.axvline(period, color="#b3261e", ls="--", label="one period: a deadline is missed")
    axes.set_xlabel("lateness: start of a tick after its deadline (µs)")
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
