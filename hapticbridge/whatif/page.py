"""Page of a what-if: the recorded run beside the changed ones."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import unit_of
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.methods import RunCoupling
from hapticbridge.errors import RecordingError
from hapticbridge.files import printable
from hapticbridge.kernel.codes import Grip
from hapticbridge.kernel.hand_energy import INSTANT
from hapticbridge.kernel.record import due_times
from hapticbridge.plotting import inline_svg, new_figure, write_picture
from hapticbridge.report.evidence import (
    DRAWABLE,
    Evidence,
    is_motion_prescribed,
    recorded_coupling,
)
from hapticbridge.report.page import moment_of, write_page
from hapticbridge.report.plots import PAGE_BINS, PICTURE_BINS, decimated, finish
from hapticbridge.units import (
    format_energy,
    format_number,
    format_share,
    format_si,
    shown_energies,
)
from hapticbridge.whatif.what_if import WhatIf, WhatIfRun

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Table of a what-if's runs

Row = tuple[str, tuple[str, ...]]

COUPLINGS = {"effective": "K, B", "law": "K, B_law", "requested": "K, B as set"}
"""Titles of the couplings of a run."""


def rows(what_if: WhatIf) -> Iterator[Row]:
    """Yields a name and a text per run, in the order of its runs.

    A run whose force was lowered (``WhatIfRun.is_lowered``) has a dash in place of its numbers.
    """
    runs, reports = what_if.runs, [run.report for run in what_if.runs]
    for hand, grip in enumerate(runs[0].report.hands or ("",)):
        of_hand = [_coupling(run, hand) for run in runs]
        for name, title in COUPLINGS.items():
            couplings = [getattr(each, name, None) for each in of_hand]
            if any(couplings):
                yield (
                    title + (f" at '{grip}'" if grip else ""),
                    tuple(
                        f"{format_number(c.stiffness)} N/m, {c.damping:.4g} N s/m"
                        if c
                        else "unknown"
                        for c in couplings
                    ),
                )
    weights = tuple(str(run.recording.meta.get("tool_weight", "unknown")) for run in runs)
    if len(set(weights)) > 1:  # a device that cannot hold it makes the scene carry it
        yield "weight of the tool", weights
    yield "verdict", tuple(f"{r.words}, tripped" if r.trip else r.words for r in reports)
    for name, texts in _numbers(what_if):
        yield (
            name,
            tuple("–" if run.is_lowered else text for run, text in zip(runs, texts, strict=True)),
        )
    yield (
        "device bears it",
        tuple(each.answer for each in reports),
    )
    yield "ran", tuple(f"{run.report.duration:.3f} s" for run in runs)


def _numbers(what_if: WhatIf) -> Iterator[Row]:
    """Yields peaks and energies of the runs."""
    runs = what_if.runs
    for name in runs[0].peaks:
        unit = unit_of(Limits, name.split()[0])
        yield f"peak {name}", tuple(format_si(run.peaks[name], unit) for run in runs)
    shown = [shown_energies(run.report.energies, run.report.start_potential) for run in runs]
    for name in shown[0]:
        joules = [each.get(name, 0.0) for each in shown]
        if any(joules):
            yield name, tuple(map(format_energy, joules))
    if any(run.report.max_net_energy > INSTANT for run in runs):
        yield "net to the hand", tuple(format_energy(run.report.max_net_energy) for run in runs)
    yield "slack used", tuple(format_share(run.report.slack_share) for run in runs)


def _coupling(run: WhatIfRun, hand: int) -> RunCoupling | None:
    """Returns a hand's coupling at the start of a run; for a joint, at the fingers."""
    return recorded_coupling(run.recordings[hand]) if run.report.hands else run.report.coupling


def changes(what_if: WhatIf) -> Iterator[tuple[str, str, str]]:
    """Yields each change: name, and the value before and after with its unit."""
    for name, unit, before, after in what_if.changes:
        yield (
            name,
            f"{_format_value(before)} {unit}".rstrip(),
            f"{_format_value(after)} {unit}".rstrip(),
        )


def sentences(run: WhatIfRun) -> Iterator[str]:
    """Yields the reasons why a run is not passive and why it was stopped."""
    if run.report.verdict != "passive":
        yield run.report.reason
    if run.report.trip:
        yield f"tripped: {run.report.trip.sentence}"
    device = run.report.certification
    if device and device.verdict is False:
        yield device.words


def _format_value(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else "none" if value is None else str(value)


# Plot of a what-if

_STYLES = (("#555555", "-", 2.2), ("#1a5fb4", "-", 1.1), ("#b3261e", "--", 1.1))
"""Colour, line and width in points of each run; the recorded one lies behind the others."""


def figure_of(what_if: WhatIf, bins: int = PICTURE_BINS) -> Figure:
    """Draws force, handle displacement, and the energies of both ports over time.

    The force is that on the hand; on the tool if the recorded motion was prescribed.

    Raises:
        RecordingError: A run holds a number that cannot be drawn.
    """
    hands = what_if.runs[0].report.hands or ("",)
    figure = new_figure(8 if len(hands) == 1 else 5.5 * len(hands), 11)
    columns = figure.subplots(4, len(hands), sharex=True, squeeze=False).T
    for hand, (grip, panels) in enumerate(zip(hands, columns, strict=True)):
        _draw_hand(what_if, hand, panels, bins)
        if grip:
            panels[0].set_title(printable(grip), fontsize="small", loc="left", parse_math=False)
    changed = ", ".join(f"{name} {old} → {new}" for name, old, new in changes(what_if))
    title = f"{what_if.path.name}, what if {changed or 'nothing is changed'}"
    figure.suptitle(printable(title), fontsize="medium", parse_math=False, wrap=True)
    return figure


def _draw_hand(what_if: WhatIf, hand: int, panels: NDArray[np.object_], bins: int) -> None:
    before = what_if.runs[0].recordings[hand]
    is_held = not is_motion_prescribed(before.meta)
    is_joint = Grip.from_text(before.meta.get("grip", "")).is_joint
    wrench = "wrench_on_device" if is_held else "wrench_on_tool"
    unit = 1.0 if is_joint else 1e3
    origin = before.ticks["handle_position"][0]
    for run, (colour, line, width) in zip(what_if.runs, _STYLES, strict=False):
        ticks = run.recordings[hand].ticks
        if not len(ticks):
            continue
        time = due_times(ticks, run.period)
        drawn = (
            np.linalg.norm(ticks[wrench][:, :3], axis=1),
            unit * np.linalg.norm(ticks["handle_position"] - origin, axis=1),
            1e3 * ticks["environment_energy"],
            1e3 * ticks["device_energy"],
        )
        for axes, values in zip(panels, drawn, strict=True):
            if not (np.abs(values) < DRAWABLE).all():
                raise RecordingError(f"the run '{run.name}' holds numbers that cannot be drawn")
            axes.plot(
                *decimated(time, values, bins), color=colour, ls=line, lw=width, label=run.name
            )
    labels = (
        "force on the hand (N)" if is_held else "force on the tool (N)",
        f"handle's distance from its start ({'m or rad' if is_joint else 'mm'})",
        "energy that the environment\ncreated (+) or dissipated (−) (mJ)",
        "energy that the device was\ngiven (+) or gave (−) (mJ)",
    )
    for axes, label in zip(panels, labels, strict=True):
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.margins(x=0.01)
    for axes in panels[2:]:
        axes.axhline(0.0, color="black", lw=0.6)
    panels[-1].set_xlabel("time (s)")
    finish(panels[0])


def draw_what_if(what_if: WhatIf, path: Path) -> None:
    """Writes ``figure_of`` to a picture file.

    Raises:
        RecordingError: It cannot be drawn.
        HapticBridgeError: The file's extension is no picture format, or it cannot be written.
    """
    write_picture(figure_of(what_if), path)


def write_what_if(what_if: WhatIf, path: Path, scene: bytes | None = None) -> None:
    """Writes one self-contained HTML page of less than 1 MB, for any length of run.

    ``scene`` is a PNG picture of the recorded scene, or None. An existing file is replaced.

    Raises:
        RecordingError: The page cannot be written, or not under this name.
    """
    try:
        drawn = inline_svg(figure_of(what_if, PAGE_BINS))
    except RecordingError:  # a run that cannot be drawn still has a verdict
        drawn = ""
    write_page(
        path,
        "what_if.html",
        name=what_if.path.name,
        recording=str(what_if.path),
        changes=list(changes(what_if)),
        runs=[_run_facts(run) for run in what_if.runs],
        rows=list(rows(what_if)),
        notes=what_if.notes,
        drawn=drawn,
        scene=scene and base64.b64encode(scene).decode(),
    )


def _run_facts(run: WhatIfRun) -> dict[str, Any]:
    evidence, report = Evidence.of(run.recording), run.report
    return {
        "name": run.name,
        "report": report,
        "sentences": list(sentences(run)),
        "moment": evidence and moment_of(evidence, report),
    }
