"""The page of a recorded run: verdict, what was run, curves, and the moment of a fault."""

from __future__ import annotations

import base64
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, select_autoescape

from hapticbridge.audit import AuditReport
from hapticbridge.device import DATA_SHEET_UNITS
from hapticbridge.errors import RecordingError
from hapticbridge.picture import inline_svg
from hapticbridge.provenance import meta_float
from hapticbridge.recording import Recording
from hapticbridge.report.cause import likely_cause
from hapticbridge.report.curves import draw_recording
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.panels import (
    ACTIVITIES,
    draw_energies,
    draw_moment,
    draw_motion,
    draw_timing,
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


def _mapping(text: str) -> dict[str, object]:
    """Returns a JSON object of the metadata; an empty one where it is damaged."""
    try:
        return dict(json.loads(text))
    except (ValueError, TypeError, RecursionError):
        return {}


def telling_time(recording: Recording, report: AuditReport) -> float:
    """Returns when a picture tells most of a run: at its fault, or at the largest force, in s.

    Args:
        recording: With one tick at least.
        report: The audit's verdict on it.

    Raises:
        RecordingError: The recording does not tell its period.
    """
    tick = report.tick
    if tick is None:
        tick = int(np.argmax(np.linalg.norm(recording.ticks["wrench_on_tool"][:, :3], axis=1)))
    return tick * meta_float(recording.meta, "period_s")


def write_report(
    recording: Recording, report: AuditReport, path: Path, scene: bytes | None = None
) -> None:
    """Writes one self-contained HTML page, of less than 1 MB however long the run was.

    Args:
        recording: What was judged.
        report: The audit's verdict on it.
        path: Where to; an existing file is replaced.
        scene: A picture of the scene as PNG, if there is one; ``telling_time`` says when.

    Raises:
        RecordingError: The page cannot be written.
    """
    environment = Environment(
        loader=PackageLoader("hapticbridge", "templates"), autoescape=select_autoescape()
    )
    evidence = Evidence.of(recording)
    page = environment.get_template("report.html").render(
        report=asdict(report),
        meta=recording.meta,
        facts=FACTS,
        device=_mapping(recording.meta.get("device", "")),
        device_facts=DEVICE_FACTS,
        versions=_mapping(recording.meta.get("versions", "")),
        host=_mapping(recording.meta.get("host", "")),
        events=recording.events[:MOST_EVENTS],
        more_events=max(len(recording.events) - MOST_EVENTS, 0),
        scene=scene and base64.b64encode(scene).decode(),
        run=None if evidence is None else _drawn(evidence, report),
        curves="" if evidence is not None else _bare_curves(recording),
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"cannot write '{path}': {error.strerror}") from None


def _bare_curves(recording: Recording) -> str:
    """Returns the curves of a run whose data sheet is damaged; nothing where its numbers are."""
    try:
        return inline_svg(draw_recording(recording))
    except RecordingError:
        return ""


def _drawn(evidence: Evidence, report: AuditReport) -> dict[str, object]:
    """Returns what the page tells of a run whose numbers can be drawn."""
    cause = likely_cause(evidence, report)
    lateness, flags = evidence.lateness, evidence.ticks["flags"]
    return {
        "motion": inline_svg(draw_motion(evidence)),
        "energies": inline_svg(draw_energies(evidence)),
        "timing": inline_svg(draw_timing(evidence)),
        "moment": cause and inline_svg(draw_moment(evidence, report)),
        "time": report.tick and report.tick * evidence.parameters.period,
        "cause": cause,
        "rate": 1 / evidence.parameters.period,
        "lateness": [float(1e6 * np.percentile(lateness, p)) for p in (50, 99, 100)],
        "shares": [(name, float(np.mean((flags & int(flag)) != 0))) for flag, name in ACTIVITIES],
        "injected": float(evidence.ticks["injected_damping"].max()),
        "peaks": [
            float(np.linalg.norm(evidence.ticks["wrench_on_device"][:, part], axis=1).max())
            for part in (slice(0, 3), slice(3, 6))
        ],
    }
