"""Pictures and pages of a recorded run."""

from __future__ import annotations

import io
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, select_autoescape
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.errors import RecordingError
from hapticbridge.recording import Recording

BINS = 1500
"""Points per curve at most; each is drawn as its least and greatest value in a bin, so that no peak
is lost. More makes a page larger without showing more at its width."""

_AXES = ("x", "y", "z")
_COLOURS = ("#b3261e", "#2e7d32", "#1a5fb4")


def _decimated(
    time: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Keeps the least and the greatest value of each bin, in their order."""
    size = -(-len(values) // BINS)
    if size <= 2:
        return time, values
    count = len(values) // size
    blocks = values[: count * size].reshape(count, size)
    picks = np.sort(np.stack([blocks.argmin(1), blocks.argmax(1)], axis=1), axis=1)
    index = (picks + size * np.arange(count)[:, None]).ravel()
    index = np.append(index, len(values) - 1)
    return time[index], values[index]


def draw_recording(recording: Recording) -> Figure:
    """Draws force, position and energies over time.

    Raises:
        RecordingError: The recording holds no tick or does not say its period.
    """
    ticks = recording.ticks
    if not len(ticks) or "period_s" not in recording.meta:
        raise RecordingError(f"'{recording.path}' holds nothing to draw")
    time = ticks["tick"] * float(recording.meta["period_s"])
    figure = Figure(figsize=(8, 8), layout="constrained")
    FigureCanvasAgg(figure)
    force_axes, position_axes, energy_axes = figure.subplots(3, 1, sharex=True)
    for i, (axis, colour) in enumerate(zip(_AXES, _COLOURS, strict=True)):
        force_axes.plot(*_decimated(time, ticks["wrench_on_tool"][:, i]), color=colour, label=axis)
        start = ticks["tool_position"][0, i]
        tool = 1e3 * (ticks["tool_position"][:, i] - start)
        handle = 1e3 * (ticks["handle_position"][:, i] - start)
        position_axes.plot(*_decimated(time, tool), color=colour, label=f"tool {axis}")
        position_axes.plot(*_decimated(time, handle), color=colour, ls=":", lw=1)
    for name, label in (
        ("coupling_work", "work of the coupling"),
        ("environment_energy", "created (+) or dissipated (−)"),
        ("device_energy", "given to the device"),
        ("kinetic", "kinetic"),
    ):
        energy_axes.plot(*_decimated(time, 1e3 * ticks[name]), label=label)
    force_axes.set_ylabel("force on the tool (N)")
    position_axes.set_ylabel("tool, handle dotted (mm)")
    energy_axes.set_ylabel("energy (mJ)")
    energy_axes.set_xlabel("time (s)")
    meta = recording.meta
    force_axes.set_title(
        f"{meta.get('scene', '')}: {meta.get('method', '')}, "
        f"K = {float(meta.get('stiffness', 'nan')):g} N/m, "
        f"B = {float(meta.get('damping', 'nan')):g} N s/m, "
        f"{1 / float(meta['period_s']):g} Hz"
    )
    for axes in (force_axes, position_axes, energy_axes):
        axes.grid(alpha=0.3)
        axes.legend(loc="upper right", fontsize="small", ncols=4)
    return figure


def plot_recording(recording: Recording, path: Path) -> None:
    """Writes ``draw_recording`` to a picture.

    Raises:
        RecordingError: The file's ending is no picture format, or it cannot be written.
    """
    figure = draw_recording(recording)
    formats = figure.canvas.get_supported_filetypes()
    if path.suffix.lstrip(".") not in formats:
        raise RecordingError(
            f"'{path}' does not end like a picture; endings: {', '.join(sorted(formats))}"
        )
    try:
        figure.savefig(path, dpi=100)
    except OSError as error:
        raise RecordingError(f"cannot write '{path}': {error.strerror}") from None


def write_report(recording: Recording, report: AuditReport, path: Path) -> None:
    """Writes one self-contained HTML page: verdict, facts, curves.

    Raises:
        RecordingError: The page cannot be written.
    """
    picture = ""
    if len(recording.ticks) and report.verdict != "invalid":
        buffer = io.StringIO()
        draw_recording(recording).savefig(buffer, format="svg")
        picture = buffer.getvalue()
        picture = picture[picture.index("<svg") :]
    environment = Environment(
        loader=PackageLoader("hapticbridge", "templates"), autoescape=select_autoescape()
    )
    page = environment.get_template("report.html").render(
        report=asdict(report),
        meta=recording.meta,
        device=json.loads(recording.meta.get("device", "{}")),
        versions=json.loads(recording.meta.get("versions", "{}")),
        events=recording.events,
        picture=picture,
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"cannot write '{path}': {error.strerror}") from None
