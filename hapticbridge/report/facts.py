"""Facts of a run in words and numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.device import DATA_SHEET_UNITS
from hapticbridge.files import read_json
from hapticbridge.guard import CONTROLLERS
from hapticbridge.record import TickFlag
from hapticbridge.report.evidence import Evidence
from hapticbridge.units import energy_rows, format_share, format_wrenches

Facts = list[tuple[str, str]]

MAX_EVENTS = 200
"""Largest number of events on a page."""

MAX_INPUTS = 10
"""Largest number of inputs among them. A run with scripted inputs has one per tick, which would
hide all other events."""

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

_WITHOUT = {"rate": "the loop's", "duration": "without end"}
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
    kept = report.timekeeping
    borne = {True: "bears the coupling", False: "does not bear it", None: "not judged"}
    words = borne[report.certified]
    if kept is not None and report.certified is not None:
        words = words + kept.clause if report.certified else kept.refutation or words
    facts.append(("device condition", words))
    if kept is not None and kept.remark:
        facts.append(("time kept", kept.remark))
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


def balance_of(report: AuditReport) -> str:
    """Returns the energies at the end of a run."""
    rows = energy_rows(report.energies, report.start_potential)
    return ", ".join(" ".join(row) for row in rows) or "nothing"


def percent(is_on: NDArray[np.bool_]) -> str:
    """Formats the share of ticks in which something was on; rare events are not rounded to 0 %."""
    share = 100 * float(np.mean(is_on))
    return f"{share:.2g}%" if share < 99.5 else f"{share:.0f}%"


def event_rows(events: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str, str]]:
    """Returns name, tick, time and details of events, in their order.

    At most ``MAX_EVENTS`` events are kept, at most ``MAX_INPUTS`` of them inputs. Inputs are
    dropped first, because they are many and the event that stopped a run is last.
    """
    is_input = [event.get("event") == "input" for event in events]
    inputs = [index for index, each in enumerate(is_input) if each][:MAX_INPUTS]
    others = [index for index, each in enumerate(is_input) if not each]
    kept = sorted((others + inputs)[:MAX_EVENTS])
    return [_event(events[index]) for index in kept]


def _event(event: Mapping[str, Any]) -> tuple[str, str, str, str]:
    rest = {k: v for k, v in event.items() if k not in ("event", "tick", "time_ns")}
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
