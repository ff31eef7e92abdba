"""Curves of a recording over time, reduced without loss of peaks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.felt import coupling_sentences, was_always_held
from hapticbridge.picture import new_figure, write_picture
from hapticbridge.provenance import parameters_of
from hapticbridge.recording import Recording, due_times
from hapticbridge.rendering import method_named

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BINS = 1500
"""Largest number of bins per curve. Each bin draws its minimum and maximum, so no peak is lost.
More bins enlarge the file without a visible gain."""

AXES = ("x", "y", "z")
COLOURS = ("#d55e00", "#009e73", "#0072b2")
"""Colours of the axes: vermilion, green and blue, distinct for colour-blind readers (Okabe &
Ito)."""

DRAWABLE = 1e9
"""Largest magnitude in N, m or J that is drawn; a larger one is not physical and breaks the plot's
axes."""

_ENERGIES = (
    ("coupling_work", "work of the coupling", "#0072b2", "-"),
    ("environment_energy", "created (+) or dissipated (−)", "#009e73", "-"),
    ("device_energy", "given to the device", "#e69f00", "-"),
    ("kinetic", "kinetic", "#555555", "--"),
)
_DRAWN = (
    "wrench_on_tool",
    "tool_position",
    "handle_position",
    *(name for name, *_ in _ENERGIES),
)


def decimated(
    time: NDArray[np.float64], values: NDArray[np.float64], bins: int = BINS
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


def draw_recording(recording: Recording) -> Figure:
    """Draws force, position and energies over time.

    Raises:
        RecordingError: The recording has no tick, no run parameters, or a number that cannot be
            drawn.
    """
    ticks, meta = recording.ticks, recording.meta
    if not len(ticks):
        raise RecordingError(f"'{recording.path}' has no tick to draw")
    parameters = parameters_of(meta)
    if not all((np.abs(ticks[name]) < DRAWABLE).all() for name in _DRAWN):
        raise RecordingError(f"'{recording.path}' holds numbers that cannot be drawn")
    time = due_times(ticks, parameters.period)
    figure = new_figure(8, 8)
    force_axes, position_axes, energy_axes = figure.subplots(3, 1, sharex=True)
    position_axes.plot([], [], color="grey", ls=":", lw=1, label="handle")
    for i, (axis, colour) in enumerate(zip(AXES, COLOURS, strict=True)):
        force_axes.plot(*decimated(time, ticks["wrench_on_tool"][:, i]), color=colour, label=axis)
        start = ticks["tool_position"][0, i]
        tool = 1e3 * (ticks["tool_position"][:, i] - start)
        handle = 1e3 * (ticks["handle_position"][:, i] - start)
        position_axes.plot(*decimated(time, tool), color=colour, label=f"tool {axis}")
        position_axes.plot(*decimated(time, handle), color=colour, ls=":", lw=1)
    for name, label, colour, style in _ENERGIES:
        drawn = decimated(time, 1e3 * ticks[name])
        energy_axes.plot(*drawn, color=colour, ls=style, label=label)
    force_axes.set_ylabel("force on the tool (N)")
    position_axes.set_ylabel("displacement (mm)")
    energy_axes.set_ylabel("energy (mJ)")
    energy_axes.set_xlabel("time (s)")
    method = method_named(meta.get("method", ""))
    sentences = coupling_sentences(
        parameters.coupling,
        method,
        parameters.period,
        parameters.substeps,
        is_always_held=was_always_held(ticks),
    ) or ("no coupling law",)
    title = f"{meta.get('scene', '')}: method {method.name}, {1 / parameters.period:g} Hz"
    # a control character would break the SVG
    title = (
        "".join(letter if letter.isprintable() else "�" for letter in title) + f"\n{sentences[0]}"
    )
    figure.suptitle(title, fontsize="medium", parse_math=False)
    for axes in (force_axes, position_axes, energy_axes):
        finish(axes)
    return figure


def finish(axes: Axes) -> None:
    """Adds the grid, and a legend above the curves."""
    axes.grid(alpha=0.3)
    axes.margins(x=0.01)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), fontsize="small", ncols=4, frameon=False)


def plot_recording(recording: Recording, path: Path) -> None:
    """Writes ``draw_recording`` to a picture file.

    Raises:
        RecordingError: The recording cannot be drawn.
        HapticBridgeError: The file's extension is no picture format, or it cannot be written.
    """
    write_picture(draw_recording(recording), path)
