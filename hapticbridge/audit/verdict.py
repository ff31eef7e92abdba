"""Verdict on a recording."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.balance import Balance
from hapticbridge.audit.ending import how_it_ended
from hapticbridge.audit.interventions import Interventions
from hapticbridge.audit.judgement import Judgement
from hapticbridge.audit.physics import physics_fault
from hapticbridge.audit.reached import Reached
from hapticbridge.audit.replay import Replay, Resimulation
from hapticbridge.audit.report import AuditReport
from hapticbridge.audit.structure import Fault, file_fault, structure_fault
from hapticbridge.certificate import (
    condition_sentences,
    damping_margin,
    is_run_certified,
    run_conditions,
)
from hapticbridge.device import DeviceInfo
from hapticbridge.device.lateness import delay_ticks
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.felt import coupling_sentences, was_never_lossless
from hapticbridge.guard import Limits, limits_for
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.provenance import STARTS, meta_start, parameters_of
from hapticbridge.recording import RecordingFile, open_recording
from hapticbridge.rendering import Method, method_named


@np.errstate(all="ignore")  # numbers of a damaged file may overflow; the result is then a fault
def verdict_on(path: str | Path, *, strict: bool) -> AuditReport:
    """Judges a recording; implements ``audit.audit``.

    Raises:
        RecordingError: The file is not a recording.
    """
    recording = open_recording(path)
    facts: dict[str, Any] = {
        "path": recording.path,
        "is_cut": recording.is_cut,
        "ticks": recording.count,
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
        home = np.array(meta_start(recording.meta, "tool_start"))
        outside = Interventions.of(recording.events, parameters, home)
        facts |= _device_facts(info, parameters, outside.worst(info, method), method, recording)
        rendered = facts["rendered"]
        facts["rendered"] = rendered + outside.sentences()
    except RecordingError as error:
        return _invalid(facts, Fault(str(error)))
    facts["duration"] = recording.count * parameters.period
    facts["unchecked"] = _unchecked(parameters, method)
    fault = file_fault(recording) or structure_fault(recording.blocks(), parameters, outside)
    if fault:
        return _invalid(facts, fault)
    passed = _Passed(recording, parameters, is_watched=facts["certified"] is not True)
    try:
        fault = passed.by(outside, delay_ticks(info, parameters.period) or 0)
        facts["energies"], facts["duration"] = passed.judgement.energies, passed.duration
        facts["rendered"] = rendered + outside.sentences(passed.judgement.commanded)
        if fault:
            return _invalid(facts, fault)
        outcome = passed.outcome()
    except RecordingError as error:
        return _invalid(facts, Fault(str(error)))
    facts["resimulation"] = outcome.agreement
    if outcome.disagrees:
        reason = (
            f"simulated again, tick {outcome.tick} differs in {outcome.field} by "
            f"{outcome.difference:.3g}: the recording was changed, or the scene was changed during "
            "the run other than by set_input"
        )
        return _invalid(facts, Fault(reason, outcome.tick, outcome.field))
    report = AuditReport(**facts, **passed.judgement.findings(strict=strict))
    if report.verdict == "passive" and report.unchecked and not outcome.has_run:
        report = _invalid(facts, Fault(outcome.agreement))
    ended = how_it_ended(recording.events)
    tripped = f"; {ended}" if ended else ""
    unchecked = f"; {report.unchecked}" if report.unchecked else ""
    return replace(report, reason=report.reason + tripped + unchecked)


def _event_counts(recording: RecordingFile) -> dict[str, int]:
    counts: dict[str, int] = {}
    for event in recording.events:
        name = str(event.get("event", "unnamed"))
        counts[name] = counts.get(name, 0) + 1
    return counts


def _device_and_method(
    recording: RecordingFile, parameters: RunParameters
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


def _device_facts(
    info: DeviceInfo,
    parameters: RunParameters,
    worst: RunParameters,
    method: Method,
    recording: RecordingFile,
) -> dict[str, Any]:
    try:
        conditions = run_conditions(info, worst, method)
        return {
            "certified": is_run_certified(conditions, method),
            "conditions": condition_sentences(info, worst, method),
            "damping_margin": damping_margin(conditions),
            "rendered": coupling_sentences(
                parameters.coupling,
                method,
                parameters.period,
                parameters.substeps,
                is_always_held=was_never_lossless(recording.count, recording.flags),
            ),
        }
    except HapticBridgeError as error:  # numbers outside the theory's range
        raise RecordingError(f"the metadata are out of range: {error}") from None


def _unchecked(parameters: RunParameters, method: Method) -> str:
    """Returns the part that only the re-simulation confirms; empty if there is none."""
    if not method.has_coupling:
        return "the wrench comes from contacts: checked by re-simulation alone"
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


class _Passed:
    """Checks of a recording's ticks, block by block."""

    def __init__(
        self, recording: RecordingFile, parameters: RunParameters, *, is_watched: bool
    ) -> None:
        self._recording, self._parameters = recording, parameters
        self.judgement, self.duration = Judgement(is_watched), 0.0
        # an error of the re-simulation is raised after the records themselves have been judged
        self._error: RecordingError | None = None
        try:
            self._simulation = Resimulation(recording, parameters)
        except RecordingError as error:
            self._error = error

    def by(self, outside: Interventions, late: int) -> Fault | None:
        """Checks every tick; returns the earliest fault of the records themselves.

        ``late`` is the delay in ticks from a sample to the wrench that answers it.

        Raises:
            RecordingError: The metadata lack the start of the energy balance.
        """
        starts = {name: np.array(meta_start(self._recording.meta, name)) for name in STARTS}
        energy = float(starts["start_kinetic"][0] + starts["start_potential"][0])
        handle, tool = starts["handle_start"], starts["tool_start"]
        reached = Reached.at_start(self._parameters, handle, tool, energy)
        fault = None
        late = min(late, self._recording.count)
        for ticks, following in _with_following(self._recording.blocks(), late):
            balance = Balance.of(ticks, self._parameters, reached, outside, late, following)
            reached = balance.reached
            self.judgement.add(ticks, balance)
            self.duration = 1e-9 * float(ticks["deadline_ns"][-1])
            fault = fault or physics_fault(ticks, balance)
            if fault is None and self._error is None:
                try:
                    self._simulation.add(ticks)
                except RecordingError as error:
                    self._error = error
        return fault

    def outcome(self) -> Replay:
        """Returns the agreement of the re-simulation.

        Raises:
            RecordingError: The file was changed.
        """
        if self._error is not None:
            raise self._error
        return self._simulation.outcome()


def _with_following(
    blocks: Iterable[NDArray[np.void]], count: int
) -> Iterator[tuple[NDArray[np.void], NDArray[np.void]]]:
    """Yields each block with up to ``count`` of the following records."""
    waiting: deque[NDArray[np.void]] = deque()
    for block in chain(blocks, [None]):
        if block is not None:
            waiting.append(block)
        while waiting and (block is None or sum(map(len, waiting)) - len(waiting[0]) >= count):
            ticks = waiting.popleft()
            yield ticks, np.concatenate([ticks[:0], *waiting])[:count]
