"""Pictures and pages of a recorded run."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, select_autoescape
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.device import DATA_SHEET_UNITS
from hapticbridge.errors import RecordingError
from hapticbridge.felt import coupling_sentences, was_always_held
from hapticbridge.picture import inline_svg, new_figure, write_picture
from hapticbridge.provenance import parameters_of
from hapticbridge.recording import Recording
from hapticbridge.rendering import method_named

BINS = 1500
"""Points per curve at most; each is drawn as its least and greatest value in a bin, so that no peak
is lost. More makes a page larger without showing more at its width."""

_AXES = ("x", "y", "z")
_COLOURS = ("#b3261e", "#2e7d32", "#1a5fb4")

DRAWABLE = 1e9
"""Newtons, metres and joules beyond this are no physics; the picture's axes would not bear them."""

_ENERGIES = (
    ("coupling_work", "work of the coupling"),
    ("environment_energy", "created (+) or dissipated (−)"),
    ("device_energy", "given to the device"),
    ("kinetic", "kinetic"),
)
_DRAWN = (
    "wrench_on_tool",
    "tool_position",
    "handle_position",
    *(name for name, _ in _ENERGIES),
)

MOST_EVENTS = 200
"""Events that a page lists; a run with scripted inputs has one per tick."""

FACTS = {
    "scene": "",
    "scene_parameters": "",
    "method": "",
    "started": "",
    "clock": "",
    "period_s": "s",
    "substeps": "",
    "stiffness": "N/m",
    "damping": "N s/m",
    "rotational_stiffness": "N m/rad",
    "rotational_damping": "N m s/rad",
    "scale": "",
    "force_scale": "",
    "force_limit": "N",
    "torque_limit": "N m",
    "ramp_ticks": "",
    "scene_sha256": "",
}
"""Metadata that a page shows, with their units; the gains are those of the law, B' and not B."""

DEVICE_FACTS = {"name": "", "axes": ""} | DATA_SHEET_UNITS
"""What a page shows of the device's data sheet, with units."""


def decimated(
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
        RecordingError: The recording holds no tick, a number that cannot be drawn, or no
            parameters of a run.
    """
    ticks, meta = recording.ticks, recording.meta
    if not len(ticks):
        raise RecordingError(f"'{recording.path}' holds nothing to draw")
    parameters = parameters_of(meta)
    if not all((np.abs(ticks[name]) < DRAWABLE).all() for name in _DRAWN):
        raise RecordingError(f"'{recording.path}' holds numbers that cannot be drawn")
    time = ticks["tick"] * parameters.period
    figure = new_figure(8, 8)
    force_axes, position_axes, energy_axes = figure.subplots(3, 1, sharex=True)
    position_axes.plot([], [], color="grey", ls=":", lw=1, label="handle")
    for i, (axis, colour) in enumerate(zip(_AXES, _COLOURS, strict=True)):
        force_axes.plot(*decimated(time, ticks["wrench_on_tool"][:, i]), color=colour, label=axis)
        start = ticks["tool_position"][0, i]
        tool = 1e3 * (ticks["tool_position"][:, i] - start)
        handle = 1e3 * (ticks["handle_position"][:, i] - start)
        position_axes.plot(*decimated(time, tool), color=colour, label=f"tool {axis}")
        position_axes.plot(*decimated(time, handle), color=colour, ls=":", lw=1)
    for name, label in _ENERGIES:
        energy_axes.plot(*decimated(time, 1e3 * ticks[name]), label=label)
    force_axes.set_ylabel("force on the tool (N)")
    position_axes.set_ylabel("way from the start (mm)")
    energy_axes.set_ylabel("energy (mJ)")
    energy_axes.set_xlabel("time (s)")
    method = method_named(meta.get("method", ""))
    told = coupling_sentences(
        parameters.coupling,
        method,
        parameters.period,
        parameters.substeps,
        is_always_held=was_always_held(ticks),
    ) or ("no coupling law",)
    title = f"{meta.get('scene', '')}: method {method.name}, {1 / parameters.period:g} Hz"
    # a control code would make a broken SVG
    title = "".join(letter if letter.isprintable() else "�" for letter in title) + f"\n{told[0]}"
    figure.suptitle(title, fontsize="medium", parse_math=False)
    for axes in (force_axes, position_axes, energy_axes):
        axes.grid(alpha=0.3)
        axes.margins(x=0.01)
        # above the curves, not on them
        axes.legend(
            loc="lower right", bbox_to_anchor=(1, 1), fontsize="small", ncols=4, frameon=False
        )
    return figure


def plot_recording(recording: Recording, path: Path) -> None:
    """Writes ``draw_recording`` to a picture.

    Raises:
        RecordingError: The recording cannot be drawn.
        HapticBridgeError: The file's ending is no picture format, or it cannot be written.
    """
    write_picture(draw_recording(recording), path)


def _picture(recording: Recording) -> str:
    """Returns the curves as inline SVG, or nothing where they cannot be drawn."""
    try:
        figure = draw_recording(recording)
    except RecordingError:
        return ""
    return inline_svg(figure)


def _mapping(text: str) -> dict[str, object]:
    """Returns a JSON object of the metadata; an empty one where it is damaged."""
    try:
        return dict(json.loads(text))
    except (ValueError, TypeError, RecursionError):
        return {}


def write_report(recording: Recording, report: AuditReport, path: Path) -> None:
    """Writes one self-contained HTML page: verdict, facts, curves.

    Raises:
        RecordingError: The page cannot be written.
    """
    environment = Environment(
        loader=PackageLoader("hapticbridge", "templates"), autoescape=select_autoescape()
    )
    page = environment.get_template("report.html").render(
        report=asdict(report),
        meta=recording.meta,
        facts=FACTS,
        device=_mapping(recording.meta.get("device", "")),
        device_facts=DEVICE_FACTS,
        versions=_mapping(recording.meta.get("versions", "")),
        events=recording.events[:MOST_EVENTS],
        more_events=max(len(recording.events) - MOST_EVENTS, 0),
        picture=_picture(recording),
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"cannot write '{path}': {error.strerror}") from None
