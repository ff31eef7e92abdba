"""The picture of energies per port, against what is allowed."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from hapticbridge.picture import new_figure
from hapticbridge.report.curves import finish
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.panels import bounded, curve

_PORTS = (
    ("coupling_work", "coupling"),
    ("actuator_work", "the scene's actuators"),
    ("external_work", "external"),
    ("device_energy", "device"),
)


def draw_energies(evidence: Evidence) -> Figure:
    """Draws the energy of each port, and what environment and device may have at most."""
    ticks, time = evidence.ticks, evidence.time
    is_watched = bool(evidence.kicked.any())
    figure = new_figure(8, 8 if is_watched else 6)
    panels = figure.subplots(3 if is_watched else 2, 1, sharex=True)
    ports, bound = panels[:2]
    for name, label in _PORTS:
        if ticks[name].any():
            curve(ports, time, 1e3 * ticks[name], label=label)
    stored = ticks["kinetic"] + ticks["potential"]
    curve(ports, time, 1e3 * (stored - stored[0]), color="grey", ls="--", label="stored")
    ports.set_ylabel("given through a port (mJ)")
    bounded(bound, time, evidence.created, evidence.allowed, "created by the environment")
    if is_watched:
        free = np.zeros_like(time)
        bounded(panels[2], time, evidence.kicked, free, "given to the device, beyond what is paid")
    for axes in panels:
        finish(axes)
    panels[-1].set_xlabel("time (s)")
    return figure
