"""Judges a recording: is it whole, is it what it says, and was the environment passive?"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.balance import Balance
from hapticbridge.audit.ending import how_it_ended
from hapticbridge.audit.physics import physics_fault
from hapticbridge.audit.replay import replay
from hapticbridge.audit.structure import TOLERANCE, Fault, structure_fault
from hapticbridge.certificate import condition_sentences, is_run_certified, run_conditions
from hapticbridge.device import DeviceInfo
from hapticbridge.device.lateness import delay_ticks
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.felt import coupling_sentences
from hapticbridge.guard import Limits, limits_for
from hapticbridge.jsonable import jsonable
from hapticbridge.kernel.state import RunParameters
from hapticbridge.provenance import STARTS, meta_start, parameters_of
from hapticbridge.recording import Recording, read_recording
from hapticbridge.rendering import Method, method_named


@dataclass(frozen=True, slots=True)
class AuditReport:
    """What an audit found.

    Attributes:
        path: The recording.
        verdict: ``passive``, ``active`` or ``invalid``.
        environment: ``strict`` (BC97 (14) held), ``within slack`` or ``active``; None if invalid.
        certified: Whether the recorded device bears the coupling; None where its damping is
            unknown or its motion is prescribed.
        reason: The verdict in a sentence.
        tick: First tick at fault, or None.
        port: The port at fault, ``environment`` or ``device``, or the field.
        joules: Energy at fault: created beyond what is allowed, or the mismatch.
        slack_share: Largest share of the slack that was used, 0 if strict.
        resimulation: ``bit for bit``, ``within 1e-9 (other processor)``, ``disagrees`` or ``not
            re-simulated: …``.
        is_cut: The file lacks its end; the verdict is on what it holds.
        ticks: Number of records.
        duration: Their number times the period, in s.
        conditions: The device condition per kind of axis, as sentences.
        rendered: What was felt away from contact, and what was used, as sentences.
        unchecked: What records alone do not tell and only the re-simulation confirms, or nothing;
            without a re-simulation such a recording is not called passive but invalid.
        energies: Energies at the end, in J.
        events: How many events of each kind.
    """

    path: Path
    verdict: Literal["passive", "active", "invalid"]
    environment: Literal["strict", "within slack", "active"] | None
    certified: bool | None
    reason: str
    tick: int | None = None
    port: str = ""
    joules: float = 0.0
    slack_share: float = 0.0
    resimulation: str = ""
    is_cut: bool = False
    ticks: int = 0
    duration: float = 0.0
    conditions: tuple[str, ...] = ()
    rendered: tuple[str, ...] = ()
    unchecked: str = ""
    energies: dict[str, float] = field(default_factory=dict)
    events: dict[str, int] = field(default_factory=dict)

    def to_json(self) -> str:
        """Returns the report as one JSON object; a number that is not finite becomes null."""
        values = asdict(self) | {"path": str(self.path)}
        return json.dumps(jsonable(values), indent=2, allow_nan=False)

    @property
    def exit_code(self) -> int:
        """0 if passive and certified or the device is unknown, else 1."""
        return 0 if self.verdict == "passive" and self.certified is not False else 1


@np.errstate(all="ignore")  # numbers of a damaged file overflow; what comes out is then a fault
def audit(path: str | Path, *, strict: bool = False) -> AuditReport:
    """Judges a recording from the file alone.

    Structure (checksums, schema, contiguous ticks, finite numbers, digest), the wrench against the
    coupling law, energies recomputed from poses and wrenches, the device condition, and, where the
    versions match, a re-simulation that must agree bit for bit. Unless the device condition proves
    the device's port, it is judged by what happened: the verdict is ``active`` from the tick on at
    which the device was given more than its damping burns and scene and coupling give up.

    Args:
        path: The recording.
        strict: Accept only (14) itself, not the slack that the device condition leaves.

    Raises:
        RecordingError: The file is not a recording at all.
    """
    recording = read_recording(path)
    facts: dict[str, Any] = {
        "path": recording.path,
        "is_cut": recording.is_cut,
        "ticks": len(recording.ticks),
        "events": _event_counts(recording),
        "certified": None,
    }
    try:
        parameters = parameters_of(recording.meta)
        info, method = _device_and_method(recording, parameters)
        burning, rotational = info.burning_damping
        parameters = replace(
            parameters, device_damping=burning, device_rotational_damping=rotational
        )
        facts |= _device_facts(info, parameters, method)
    except RecordingError as error:
        return _invalid(facts, Fault(str(error)))
    facts["duration"] = len(recording.ticks) * parameters.period
    facts["unchecked"] = _unchecked(parameters, method)
    resumed = np.array([float(e["tick"]) for e in recording.events if _is_resume(e)])
    fault = structure_fault(recording, parameters, resumed)
    if fault:
        return _invalid(facts, fault)
    ticks = recording.ticks
    try:
        starts = {name: meta_start(recording.meta, name) for name in STARTS}
        balance = Balance.of(
            ticks,
            parameters,
            np.array(starts["handle_start"]),
            np.array(starts["tool_start"]),
            starts["start_kinetic"][0] + starts["start_potential"][0],
            resumed,
            delay_ticks(info, parameters.period) or 0,
        )
        facts["energies"] = _energies(ticks, balance)
        fault = physics_fault(ticks, balance)
        if fault:
            return _invalid(facts, fault)
        outcome = replay(recording, parameters)
    except RecordingError as error:
        return _invalid(facts, Fault(str(error)))
    facts["resimulation"] = outcome.agreement
    if outcome.disagrees:
        reason = (
            f"simulated again, tick {outcome.tick} differs in {outcome.field} by "
            f"{outcome.difference:.3g}: the recording was changed, or in mid-run the scene, other "
            "than by set_input"
        )
        return _invalid(facts, Fault(reason, outcome.tick, outcome.field))
    report = _judged(facts, balance, strict=strict)
    if report.verdict == "passive" and report.unchecked and not outcome.has_run:
        report = _invalid(facts, Fault(outcome.agreement))
    ended = how_it_ended(recording)
    tripped = f"; {ended}" if ended else ""
    unchecked = f"; {report.unchecked}" if report.unchecked else ""
    return replace(report, reason=report.reason + tripped + unchecked)


def _is_resume(event: dict[str, Any]) -> bool:
    return event.get("event") == "resume" and isinstance(event.get("tick"), int)


def _event_counts(recording: Recording) -> dict[str, int]:
    counts: dict[str, int] = {}
    for event in recording.events:
        name = str(event.get("event", "unnamed"))
        counts[name] = counts.get(name, 0) + 1
    return counts


def _device_and_method(
    recording: Recording, parameters: RunParameters
) -> tuple[DeviceInfo, Method]:
    try:
        info = DeviceInfo.from_json(recording.meta.get("device", ""))
        limits_for(info, Limits(force=parameters.force_limit, torque=parameters.torque_limit))
        method = method_named(recording.meta.get("method", ""))
    except HapticBridgeError as error:
        raise RecordingError(f"the metadata do not describe a run: {error}") from None
    if recording.meta.get("discretization") != method.discretization:
        raise RecordingError(f"metadata 'discretization' is not that of method '{method.name}'")
    return info, method


def _device_facts(info: DeviceInfo, parameters: RunParameters, method: Method) -> dict[str, Any]:
    try:
        return {
            "certified": is_run_certified(run_conditions(info, parameters, method), method),
            "conditions": condition_sentences(info, parameters, method),
            "rendered": coupling_sentences(
                parameters.coupling, method, parameters.period, parameters.substeps
            ),
        }
    except HapticBridgeError as error:  # numbers beyond what the theory computes with
        raise RecordingError(f"the metadata are out of range: {error}") from None


def _unchecked(parameters: RunParameters, method: Method) -> str:
    """Says what only the re-simulation can confirm, because records alone do not tell it."""
    if not method.has_coupling:
        return "the wrench is the contacts': checked by re-simulation alone"
    if not method.has_law:
        return "the wrench is MuJoCo's constraint force: checked by re-simulation alone"
    if parameters.laws > 1:
        return "the wrench is a mean over substeps: it and its work checked by re-simulation alone"
    return ""


def _invalid(facts: dict[str, Any], fault: Fault) -> AuditReport:
    return AuditReport(
        **facts,
        verdict="invalid",
        environment=None,
        reason=fault.reason,
        tick=fault.tick,
        port=fault.port,
        joules=fault.joules,
    )


def _energies(ticks: NDArray[np.void], balance: Balance) -> dict[str, float]:
    last = ticks[-1]
    return {
        "kinetic": float(last["kinetic"]),
        "potential": float(last["potential"]),
        "coupling_work": float(balance.coupling_work[-1]),
        "actuator_work": float(last["actuator_work"]),
        "external_work": float(last["external_work"]),
        "environment_energy": float(balance.environment_energy[-1]),
        "device_energy": float(balance.device_energy[-1]),
        "slack": float(balance.slack[-1]),
    }


def _judged(facts: dict[str, Any], balance: Balance, *, strict: bool) -> AuditReport:
    created = balance.environment_energy
    rounding = TOLERANCE * (1 + balance.throughput)
    unstrict = created > rounding
    active = created > balance.slack + rounding
    share = float(np.max(np.where(unstrict, created / (balance.slack + rounding), 0.0)))
    # a device that meets its condition needs no watch behind a coupling law: that is the proof
    is_watched = facts["certified"] is not True
    kicked = is_watched & (balance.kicked > rounding)
    if kicked.any() and not (active & (np.arange(len(active)) <= np.argmax(kicked))).any():
        tick = int(np.argmax(kicked))
        excess = float(balance.kicked[tick])
        return AuditReport(
            **facts,
            verdict="active",
            environment="within slack" if unstrict.any() else "strict",
            reason=f"from tick {tick} the device is given {excess:.3g} J more than its damping "
            "burns and scene and coupling give up",
            tick=tick,
            port="device",
            joules=excess,
            slack_share=share,
        )
    lost = -float(created[-1])
    if not unstrict.any():
        reason = f"the environment never gave out more than it got ({lost:.3g} J dissipated)"
        return AuditReport(**facts, verdict="passive", environment="strict", reason=reason)
    if not active.any() and not strict:
        reason = (
            f"energy was created at times, within the slack that the coupling leaves "
            f"({share:.0%} of it used)"
        )
        return AuditReport(
            **facts,
            verdict="passive",
            environment="within slack",
            reason=reason,
            slack_share=share,
        )
    tick = int(np.argmax(active if active.any() else unstrict))
    excess = float(created[tick] - (balance.slack[tick] if active.any() else 0.0))
    limit = "its slack" if active.any() else "(14), asked for strictly"
    return AuditReport(
        **facts,
        verdict="active",
        environment="active" if active.any() else "within slack",
        reason=f"from tick {tick} the environment exceeds {limit} by {excess:.3g} J",
        tick=tick,
        port="environment",
        joules=excess,
        slack_share=share,
    )
