"""HTML page of a recorded run: verdict, setup, curves, and the moment of a fault."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hapticbridge.audit import AuditReport
from hapticbridge.errors import RecordingError
from hapticbridge.files import atomic_write
from hapticbridge.plotting import inline_svg
from hapticbridge.record import due_times
from hapticbridge.recording import Recording
from hapticbridge.report.cause import excess_of, pump_behind_trip
from hapticbridge.report.evidence import Evidence, draw_recording
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
from hapticbridge.report.plots import (
    activities,
    draw_energies,
    draw_moment,
    draw_motion,
    draw_timing,
)
from hapticbridge.run_description import meta_float
from hapticbridge.units import format_si

# Self-contained HTML pages

PAGES = (".html", ".htm")
"""Allowed extensions of a page; browsers show others as text."""


def check_page_name(path: Path) -> None:
    """Checks that a page can be written under a name, before anything is computed for it.

    Raises:
        RecordingError: The extension is not one of ``PAGES``, or the folder does not exist.
    """
    if path.suffix.lower() not in PAGES:
        raise RecordingError(f"the page '{path}' must end in {' or '.join(PAGES)}")
    if not path.absolute().parent.is_dir():
        raise RecordingError(f"cannot write '{path}': its folder does not exist")


def write_page(path: Path, template: str, **variables: object) -> None:
    """Writes a page; an existing file is replaced.

    ``template`` is a file in ``hapticbridge/templates``; ``variables`` are its variables.

    Raises:
        RecordingError: The page cannot be written, or not under this name.
    """
    check_page_name(path)
    from jinja2 import Environment, PackageLoader, select_autoescape  # noqa: PLC0415 - for pages

    environment = Environment(
        loader=PackageLoader("hapticbridge", "templates"), autoescape=select_autoescape()
    )
    environment.filters["quantity"] = format_si
    page = environment.get_template(template).render(variables)
    try:
        with atomic_write(path) as draft:
            draft.write_text(page, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise RecordingError(f"cannot write '{path}': {error.strerror}") from None


# First sentences of a page

PLACES = {
    "environment": "environment: the simulated scene, as the tool meets it",
    "device": "device: the handle in the hand",
}
"""Descriptions of the ports for readers new to them."""


def lead_sentence(report: AuditReport, worst: float | None) -> str:
    """Returns the main result of a run in one sentence.

    ``worst`` is the largest energy beyond the bound in J; None if unknown.
    """
    if report.verdict == "invalid":
        return f"This recording proves nothing: {report.reason}"
    if report.verdict == "active" and worst is not None:
        return _excess_sentence(report, format_si(worst, "J"))
    return report.reason.partition("; ")[0]


def _excess_sentence(report: AuditReport, joules: str) -> str:
    if report.port == "device":
        return f"Not safe: the hand got up to {joules} that neither it nor the scene put in"
    limit = "the coupling's slack pays for" if report.environment == "active" else "it got"
    return f"Not safe: the scene gave out up to {joules} more than {limit}"


def notes(report: AuditReport) -> list[str]:
    """Returns notes on the verdict: reason of a stop, device condition, warnings of the run."""
    if report.verdict == "invalid":
        return []
    warned = [f"The run warned: {sentence}." for sentence in report.findings]
    remarks = report.reason.partition("; ")[2]
    # a run that was passive only because its force was switched off must not look like any other
    stop = [f"{remarks[:1].upper()}{remarks[1:]}."] if remarks else []
    return [*stop, *_device_notes(report), *warned]


def is_warned(report: AuditReport) -> bool:
    """Returns True for a passive run that was stopped or is not certified for any hand."""
    return report.verdict == "passive" and (report.certified is False or "trip" in report.events)


def _device_notes(report: AuditReport) -> list[str]:
    if report.verdict != "passive":
        return []
    kept = report.timekeeping
    if report.certified:
        clause = "" if kept is None or not kept.clause else f",{kept.clause}"
        return [f"The device bears this coupling, in any hand{clause}."]
    if report.certified is None:
        return ["It is not known if the device bears this coupling in any hand."]
    if kept is not None and kept.refutation:  # the reason has the numbers
        return ["The device is not certified. This run stayed passive; another one need not."]
    return [
        f"The device does not bear this coupling: {'; '.join(report.conditions)}. This run stayed "
        "passive; another one need not."
    ]


def telling_time(recording: Recording, report: AuditReport | None = None) -> float:
    """Returns the time in s of a report's fault, or else of the largest force on the tool.

    Raises:
        RecordingError: The recording has no tick or no period.
    """
    if not len(recording.ticks):
        raise RecordingError(f"'{recording.path}' is empty: the run had no tick")
    tick = None if report is None else report.tick
    if tick is None:
        tick = int(np.argmax(np.linalg.norm(recording.ticks["wrench_on_tool"][:, :3], axis=1)))
    due = due_times(recording.ticks, meta_float(recording.meta, "period_s"))
    return float(due[min(tick, len(due) - 1)])


def write_report(
    recording: Recording,
    report: AuditReport,
    path: Path,
    scene: bytes | None = None,
    *,
    others: Sequence[Recording] = (),
    in_process: bool = False,
) -> None:
    """Writes one self-contained HTML page of less than 1 MB, for any length of run.

    ``scene`` is a PNG picture of the scene at ``telling_time``, or None. ``others`` are the records
    of the other hands of a run of several. An existing file is replaced. ``in_process`` is as for
    ``audit``.

    Raises:
        RecordingError: The page cannot be written, or not under this name.
    """
    hands, meta = Evidence.of_hands((recording, *others)), recording.meta
    evidence = hands[0] if hands else None
    rows = event_rows(recording.events)
    run = _evidence_parts(hands, report, in_process) if hands else None
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
        lead=lead_sentence(report, None if moment is None else moment["excess"].worst),
        notes=[*notes(report), *_trip_notes(recording, report, in_process=in_process)],
        is_warned=is_warned(report),
        curves="" if evidence is not None else _bare_curves(recording, *others),
    )


def _trip_notes(recording: Recording, report: AuditReport, *, in_process: bool) -> Iterator[str]:
    cause = pump_behind_trip(recording, report, in_process=in_process)
    if cause is not None:
        yield f"Likely cause: {cause.kind}. {cause.evidence}. What to change: {cause.remedy}."


def _bare_curves(*hands: Recording) -> str:
    """Returns the curves of a run with a damaged data sheet; empty if they cannot be drawn."""
    try:
        return inline_svg(draw_recording(*hands))
    except RecordingError:
        return ""


def _evidence_parts(
    hands: Sequence[Evidence], report: AuditReport, in_process: bool
) -> dict[str, Any]:
    evidence = hands[0]
    lateness = evidence.lateness
    is_timed = bool(lateness.any())
    return {
        "head": head_facts(report, evidence),
        "hands": [
            {
                "name": each.parameters.grip if len(hands) > 1 else "",
                "motion": inline_svg(draw_motion(each)),
                "energies": inline_svg(draw_energies(each)),
            }
            for each in hands
        ],
        "timing": inline_svg(draw_timing(evidence)),
        "balance": balance_of(report),
        "moment": moment_of(evidence, report, in_process=in_process),
        "lateness": [float(np.percentile(lateness, p)) for p in (50, 99, 100)] if is_timed else [],
        "shares": [(name, percent(on)) for name, on in activities(evidence) if on.any()],
    }


def moment_of(
    evidence: Evidence, report: AuditReport, *, in_process: bool = False
) -> dict[str, Any] | None:
    """Returns picture, place and excess of an active run's fault; None for any other run."""
    excess = excess_of(evidence, report, in_process=in_process)
    if excess is None:
        return None
    return {
        "drawn": inline_svg(draw_moment(evidence, report)),
        "place": PLACES.get(report.port, report.port),
        "excess": excess,
    }
