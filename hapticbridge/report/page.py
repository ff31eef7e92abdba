"""HTML page of a recorded run: verdict, setup, curves, and the moment of a fault."""

from __future__ import annotations

import base64
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hapticbridge.audit import AuditReport
from hapticbridge.errors import RecordingError
from hapticbridge.picture import inline_svg
from hapticbridge.provenance import meta_float
from hapticbridge.recording import Recording, due_times
from hapticbridge.report.curves import draw_recording
from hapticbridge.report.energies import draw_energies
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.facts import (
    balance_of,
    device_facts,
    event_rows,
    guard_facts,
    head_facts,
    percent,
    run_facts,
    software_facts,
)
from hapticbridge.report.html import write_page
from hapticbridge.report.lead import PLACES, is_warned, lead_sentence, notes
from hapticbridge.report.likely import likely_cause
from hapticbridge.report.moment import draw_moment
from hapticbridge.report.motion import draw_motion
from hapticbridge.report.timing import activities, draw_timing


def telling_time(recording: Recording, report: AuditReport) -> float:
    """Returns the time in s of the fault, or else of the largest force.

    Raises:
        RecordingError: The recording has no tick or no period.
    """
    if not len(recording.ticks):
        raise RecordingError(f"'{recording.path}' holds no tick")
    tick = report.tick
    if tick is None:
        tick = int(np.argmax(np.linalg.norm(recording.ticks["wrench_on_tool"][:, :3], axis=1)))
    due = due_times(recording.ticks, meta_float(recording.meta, "period_s"))
    return float(due[min(tick, len(due) - 1)])


def write_report(
    recording: Recording, report: AuditReport, path: Path, scene: bytes | None = None
) -> None:
    """Writes one self-contained HTML page of less than 1 MB, for any length of run.

    ``scene`` is a PNG picture of the scene at ``telling_time``, or None. An existing file is
    replaced.

    Raises:
        RecordingError: The page cannot be written, or not under this name.
    """
    evidence, meta = Evidence.of(recording), recording.meta
    rows = event_rows(recording.events)
    run = None if evidence is None else _evidence_parts(evidence, report)
    moment = None if run is None else run["moment"]
    write_page(
        path,
        "report.html",
        report=asdict(report),
        name=report.path.name,
        details={
            "Run": run_facts(meta),
            "Device": device_facts(meta),
            "Guard": [] if evidence is None else guard_facts(evidence),
            "Software": software_facts(meta),
        },
        events=rows,
        more_events=len(recording.events) - len(rows),
        scene=scene and base64.b64encode(scene).decode(),
        run=run,
        moment=moment,
        lead=lead_sentence(report, None if moment is None else moment["worst"]),
        notes=notes(report),
        is_warned=is_warned(report),
        curves="" if evidence is not None else _bare_curves(recording),
    )


def _bare_curves(recording: Recording) -> str:
    """Returns the curves of a run with a damaged data sheet; empty if they cannot be drawn."""
    try:
        return inline_svg(draw_recording(recording))
    except RecordingError:
        return ""


def _evidence_parts(evidence: Evidence, report: AuditReport) -> dict[str, Any]:
    lateness = evidence.lateness
    is_timed = bool(lateness.any())
    return {
        "head": head_facts(report, evidence),
        "motion": inline_svg(draw_motion(evidence)),
        "energies": inline_svg(draw_energies(evidence)),
        "timing": inline_svg(draw_timing(evidence)),
        "balance": balance_of(report),
        "moment": moment_of(evidence, report),
        "lateness": [float(np.percentile(lateness, p)) for p in (50, 99, 100)] if is_timed else [],
        "shares": [(name, percent(on)) for name, on in activities(evidence) if on.any()],
    }


def moment_of(evidence: Evidence, report: AuditReport) -> dict[str, Any] | None:
    """Returns time, energy and cause of an active run's fault; None for any other run."""
    cause = likely_cause(evidence, report)
    if cause is None or report.tick is None:
        return None
    energy, allowed = evidence.judged(report)
    excess = energy - allowed
    worst = int(np.argmax(excess))
    return {
        "drawn": inline_svg(draw_moment(evidence, report)),
        "place": PLACES.get(report.port, report.port),
        "time": float(evidence.time[report.tick]),
        "cause": cause,
        "worst": float(excess[worst]),
        "worst_tick": int(evidence.ticks["tick"][worst]),
        "worst_time": float(evidence.time[worst]),
    }
