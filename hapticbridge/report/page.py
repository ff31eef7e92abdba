"""HTML page of a recorded run: verdict, setup, curves, and the moment of a fault."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.demand.guard import CONTROLLERS
from hapticbridge.demand.own_loop import EVENT as OWN_LOOP_EVENT
from hapticbridge.demand.pulse import end_words
from hapticbridge.device import DATA_SHEET_UNITS
from hapticbridge.errors import RecordingError
from hapticbridge.files import atomic_write, check_target, read_json, writing
from hapticbridge.kernel.record import TickFlag, due_times
from hapticbridge.kernel.restitution import BLOW_SPEED
from hapticbridge.plotting import inline_svg
from hapticbridge.recording import Recording
from hapticbridge.recording.format import SHOWN_EVENT
from hapticbridge.report.evidence import Blow, Evidence, blows_of
from hapticbridge.report.plots import (
    activities,
    draw_energies,
    draw_moment,
    draw_motion,
    draw_recording,
    draw_timing,
)
from hapticbridge.report.search import excess_of, pump_behind_trip
from hapticbridge.run.description import meta_float
from hapticbridge.units import energy_rows, format_energy, format_share, format_si, format_wrenches

# Facts of the run

Facts = list[tuple[str, str]]

MAX_EVENTS = 200
"""Largest number of events on a page."""

MAX_BLOWS = 50
"""Largest number of blows on a page. More would make the page long, and look alike."""

MAX_INPUTS = 10
"""Largest number of inputs and reports among them. A run with scripted inputs has one per tick,
which would hide all other events."""

_REPEATED = ("input", SHOWN_EVENT, OWN_LOOP_EVENT)
"""Events that a run has all the time."""

_LONGEST = 200
"""Largest number of characters of an event; an input lists every number that it wrote."""

_RUN = {
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
    "ramp_ticks": "ticks",
    "scene_sha256": "",
}
"""Metadata on a page, with units. The gains are those of the law."""

_NAMES = {
    "period_s": "period",
    "damping": "law damping",
    "rotational_damping": "law rotational damping",
}
"""Names on a page that differ from the metadata's."""

_DEVICE = {"name": "", "axes": ""} | DATA_SHEET_UNITS

_WITHOUT = {"rate": "the loop's", "duration": "without end", "loop_period": "no own loop"}
"""Meaning of a missing value in the data sheet; any other missing value is unknown."""

_GUARD = {
    "energy_credit_limit": "J",
    "assumed_damping": "N s/m",
    "max_damping": "N s/m",
    "assumed_rotational_damping": "N m s/rad",
    "max_rotational_damping": "N m s/rad",
    "stale_ticks": "ticks",
    "fade_ticks": "ticks",
    "has_hand": "",
    "stretch": "m",
    "angle": "rad",
    "full_speed": "m/s",
    "speed": "m/s",
    "turn_speed": "rad/s",
    "energy": "J",
    "reach": "m",
    "hold_force": "N",
    "hold_torque": "N m",
    "idle_force": "N",
    "idle_torque": "N m",
    "swing_energy": "J",
    "runaway_speed": "m/s",
    "stated_delay": "s",
    "delay_margin": "s",
    "motors": "(mask of axes)",
    "clutch": "(mask of buttons)",
    "dead_man": "(mask of buttons)",
}
"""Guard settings on a page, with units; see ``kernel.parameters.GuardParameters``."""


def json_object(text: str) -> dict[str, Any]:
    """Parses a JSON object of the metadata; returns an empty one if it is damaged."""
    try:
        return dict(read_json(text))
    except (ValueError, TypeError):
        return {}


def run_facts(meta: Mapping[str, str]) -> Facts:
    """Returns the run's settings: names, and values with units."""
    facts = {name: meta[name] for name in _RUN if name in meta}
    if values := json_object(facts.get("scene_parameters", "")):
        facts["scene_parameters"] = _format_mapping(values)
    elif facts.get("scene_parameters") == "{}":
        del facts["scene_parameters"]
    return [
        (_NAMES.get(n, _with_spaces(n)), _format_value(value, _RUN[n]))
        for n, value in facts.items()
    ]


def device_facts(meta: Mapping[str, str]) -> Facts:
    """Returns the device's data sheet."""
    sheet = json_object(meta.get("device", ""))
    for name, meant in _WITHOUT.items():
        if name in sheet and sheet[name] is None:
            sheet[name] = meant
    return [
        (_with_spaces(n), _format_value(sheet[n], unit))
        for n, unit in _DEVICE.items()
        if n in sheet
    ]


def software_facts(meta: Mapping[str, str]) -> Facts:
    """Returns versions and machine."""
    facts = json_object(meta.get("versions", "")) | json_object(meta.get("host", ""))
    return [(name, str(value)) for name, value in facts.items()]


def guard_facts(evidence: Evidence) -> Facts:
    """Returns the active settings of the guard."""
    guarding = asdict(evidence.parameters.guarding)
    facts = [("controller", controller_of(evidence))]
    for name, unit in _GUARD.items():
        value = guarding[name]
        if value not in (0, math.inf):
            facts.append((_with_spaces(name), _format_value(value, unit)))
    return facts


def controller_of(evidence: Evidence) -> str:
    """Returns the name of the run's passivity controller."""
    names = {code: name for name, code in CONTROLLERS.items()}
    return names[evidence.parameters.guarding.controller]


def head_facts(report: AuditReport, evidence: Evidence) -> Facts:
    """Returns the main facts: setup, course of the run, and checks."""
    parameters, meta = evidence.parameters, evidence.recording.meta
    flags = evidence.ticks["flags"]
    hand, tool = (
        tuple(float(np.linalg.norm(wrench[:, part], axis=1).max()) for part in _PARTS)
        for wrench in (evidence.ticks["wrench_on_device"], evidence.ticks["wrench_on_tool"])
    )
    in_time = "in simulated time" if meta.get("clock") == "simulated" else "no deadline missed"
    if late := int(np.count_nonzero(flags & int(TickFlag.OVERRUN))):
        missed = round(report.duration / parameters.period) - report.ticks
        in_time = f"deadlines missed: {missed}, at {late} of them"
    facts = [
        ("scene", meta.get("scene", "")),
        ("device", f"{evidence.info.name}, {len(evidence.info.axes)} axes"),
        ("method", f"{evidence.method.name}, {1 / parameters.period:g} Hz"),
        *(("coupling", sentence) for sentence in report.coupling_sentences[:1]),
        ("ran", f"{report.duration:.3f} s, {report.ticks} ticks, {in_time}"),
        ("largest force", format_wrenches(None if evidence.info.is_prescribed else hand, tool)),
        ("controller", _controller_words(evidence)),
    ]
    if (certification := report.certification) is not None:
        facts.append(("device condition", certification.fact))
        if certification.kept.remark:
            facts.append(("time kept", certification.kept.remark))
        if certification.own_loop:
            facts.append(("device's loop", certification.own_loop.words))
    if report.scales:
        facts.append(("scales", report.scales))
    if report.slack_share:
        facts.append(("slack used", format_share(report.slack_share)))
    return [*facts, ("simulated again", report.resimulation or "not reached")]


_PARTS = slice(0, 3), slice(3, 6)


def _controller_words(evidence: Evidence) -> str:
    name = controller_of(evidence)
    active = (evidence.ticks["flags"] & int(TickFlag.CONTROLLER_ACTIVE)) != 0
    if not active.any():
        return name if name == "off" else f"{name}, never at work"
    most = {
        unit: float(evidence.ticks[field].max())
        for field, unit in (
            ("injected_damping", "N s/m"),
            ("injected_rotational_damping", "N m s/rad"),
        )
    }
    amounts = [f"{damping:.3g} {unit}" for unit, damping in most.items() if damping]
    injected = f", up to {' and '.join(amounts)} injected" if amounts else ""
    return f"{name}, at work in {percent(active)} of the ticks{injected}"


def blow_row(blow: Blow) -> tuple[str, ...]:
    """Returns time, speed, e, energies and the end of the pulse of a blow, in words."""
    energies = (blow.burned, blow.returned, blow.paid, blow.worked)
    return (
        f"{blow.time:.3f} s",
        format_si(blow.speed, "m/s"),
        f"{blow.asked:.2f}",
        f"{blow.had:.2f}",
        *(format_energy(energy) for energy in energies),
        end_words(blow.ended_by),
    )


def balance_of(report: AuditReport) -> str:
    """Returns the energies at the end of a run."""
    rows = energy_rows(report.energies, report.start_potential, report.credit)
    return ", ".join(" ".join(row) for row in rows) or "nothing"


def percent(is_on: NDArray[np.bool_]) -> str:
    """Formats the share of ticks in which something was on; rare events are not rounded to 0 %."""
    percentage = 100 * float(np.mean(is_on))
    return f"{percentage:.2g}%" if percentage < 99.5 else f"{percentage:.0f}%"


def event_rows(events: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str, str]]:
    """Returns name, tick, time and details of events, in their order.

    At most ``MAX_EVENTS`` events are kept, at most ``MAX_INPUTS`` of them inputs and reports. These
    are dropped first, because they are many and the event that stopped a run is last.
    """
    is_input = [event.get("event") in _REPEATED for event in events]
    inputs = [index for index, each in enumerate(is_input) if each][:MAX_INPUTS]
    others = [index for index, each in enumerate(is_input) if not each]
    kept = sorted((others + inputs)[:MAX_EVENTS])
    return [_event(events[index]) for index in kept]


def _event(event: Mapping[str, Any]) -> tuple[str, str, str, str]:
    rest = {k: v for k, v in event.items() if k not in ("event", "tick", "time_ns", "posts")}
    time = event.get("time_ns")
    at = f"{1e-9 * time:.3f} s" if isinstance(time, int) else "–"
    text = _format_mapping({k: v for k, v in rest.items() if v not in ("", None)})
    text = text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
    return str(event.get("event"))[:_LONGEST], str(event.get("tick", "–"))[:_LONGEST], at, text


def _format_mapping(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {_format_value(value, '')}" for name, value in values.items())


def _with_spaces(name: str) -> str:
    return name.replace("_", " ")


def _format_value(value: object, unit: str) -> str:
    """Formats a value with its unit; numbers, also those given as text, lose rounding digits."""
    if value is None:
        return "unknown"
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    try:
        text = str(value) if isinstance(value, bool) else f"{float(str(value)):.10g}"
    except ValueError:
        return str(value)  # text has no unit
    return f"{text} {unit}".rstrip()


# Self-contained HTML pages

PAGES = (".html", ".htm")
"""Allowed extensions of a page; browsers show others as text."""


def check_page_name(path: Path) -> None:
    """Checks that a page can be written under a name, before anything is computed for it.

    Raises:
        RecordingError: The extension is not one of ``PAGES``, or no such file can be made.
    """
    if path.suffix.lower() not in PAGES:
        raise RecordingError(f"the page '{path}' must end in {' or '.join(PAGES)}")
    check_target(path, RecordingError)


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
    with writing(path, RecordingError), atomic_write(path) as draft:
        draft.write_text(page, encoding="utf-8", errors="backslashreplace")


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
        return f"This recording proves nothing: {report.sentence}"
    if report.verdict == "active" and worst is not None:
        return _excess_sentence(report, format_si(worst, "J"))
    return report.sentence


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
    # a run that was passive only because its force was switched off must not look like any other
    remarks = "; ".join(report.remarks)
    stop = [f"{remarks[:1].upper()}{remarks[1:]}."] if remarks else []
    certification = report.certification
    device = [certification.note] if certification and report.verdict == "passive" else []
    return [*stop, *device, *warned]


def is_warned(report: AuditReport) -> bool:
    """Returns True for a passive run that was stopped or is not certified for any hand."""
    return report.verdict == "passive" and (report.certified is False or report.trip is not None)


def telling_time(recording: Recording, report: AuditReport | None = None) -> float:
    """Returns the time in s of a report's fault, or else of the largest force on the tool.

    Raises:
        RecordingError: The recording has no tick or no period.
    """
    if not len(recording.ticks):
        raise RecordingError(f"'{recording.path}' is empty: it holds no tick")
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
        report=report,
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
    is_timed, blows = bool(lateness.any()), blows_of(evidence)
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
        "blows": [blow_row(each) for each in blows[:MAX_BLOWS]],
        "more_blows": max(len(blows) - MAX_BLOWS, 0),
        "blow_speed": BLOW_SPEED,
        "has_pulses": evidence.parameters.impact_pulses > 0.0,
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
