"""Plot of each port's energy and its bound."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hapticbridge.picture import new_figure
from hapticbridge.report.curves import finish
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.panels import bounded, curve, energy_unit, widen

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PORTS = (
    ("coupling_work", "coupling", "#0072b2"),
    ("actuator_work", "the scene's actuators", "#009e73"),
    ("external_work", "external", "#cc79a7"),
    ("device_energy", "device", "#e69f00"),
)


def draw_energies(evidence: Evidence) -> Figure:
    """Draws the energy of each port, and the bounds of environment and device."""
    ticks, time = evidence.ticks, evidence.time
    is_watched = bool(evidence.kicked.any())
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
        bounded(panels[2], time, evidence.kicked, free, "given to the device, beyond what is paid")
    for axes in panels:
        finish(axes)
    panels[-1].set_xlabel("time (s)")
    return figure
