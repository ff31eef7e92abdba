"""Verdict on a recording."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.energy import EnergyBalance, Reached
from hapticbridge.audit.events import RunEvents
from hapticbridge.audit.guard import has_flag
from hapticbridge.audit.replay import Replay, Resimulation
from hapticbridge.audit.report import AuditReport
from hapticbridge.audit.structure import TOLERANCE, Fault, file_fault, structure_fault
from hapticbridge.certificate import (
    condition_sentences,
    damping_margin,
    delay_ticks,
    is_run_certified,
    run_conditions,
)
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.guard import Limits, limits_for
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.record import UNITS, TickFlag
from hapticbridge.recording import RecordingFile, open_recording
from hapticbridge.rendering import Method, method_named
from hapticbridge.run_description import STARTS, meta_start, parameters_of
from hapticbridge.summary import coupling_sentences, was_never_lossless

# Unusual endings of a run.


def how_it_ended(events: Sequence[Mapping[str, Any]]) -> str:
    """Returns a clause that names the event that ended the run; empty for an ordinary end."""
    clauses = []
    for event in events:
        name, reason = event.get("event"), event.get("reason")
        if name == "trip":
            clauses.append(f"the guard tripped at tick {event.get('tick')}: {_shorten(reason)}")
        elif name == "bridge_died":
            clauses.append(f"the bridge died after tick {event.get('tick')}")
        elif name == "recorder_died":
            clauses.append("the recorder died during the run")
        elif name == "suspended":
            clauses.append(f"the machine was asleep for {event.get('seconds', 0):.3g} s")
        elif name == "stop" and event.get("signal"):
            clauses.append(f"stopped by {event['signal']} at tick {event.get('tick')}")
        elif name == "stop" and reason not in ("duration", "signal", "caller", None, ""):
            clauses.append(f"stopped by {_shorten(reason)}")
    has_trip = any(event.get("event") == "trip" for event in events)
    if has_trip:  # its exception is reported as a stop too
        clauses = [clause for clause in clauses if not clause.startswith("stopped by")]
    return "; ".join(clauses)


def _shorten(reason: object) -> str:
    """Returns a reason's text without its leading tick, at most 200 characters."""
    text = str(reason)
    head, mark, rest = text.partition(": ")
    return rest[:200] if mark and head.startswith("tick ") else text[:200]


# Verdict on energies, block by block.

_RECORDED = ("kinetic", "potential", "actuator_work", "external_work")


@dataclass(frozen=True, slots=True)
class _Excess:
    """First tick beyond a limit, and the excess in J."""

    tick: int
    joules: float


@dataclass(slots=True)
class PassivityVerdict:
    """Verdict collected over the blocks of a recording.

    Attributes:
        is_watched: True if the device port is judged by its energy. A device that meets its
            condition behind a coupling law is proven safe without it.
        energies: Energies after the newest tick, in J.
        slack_share: Largest share of the slack that was used.
        commanded: Energy that commands have added to the coupling, in J.
    """

    is_watched: bool
    energies: dict[str, float] = field(default_factory=dict)
    slack_share: float = 0.0
    commanded: float = 0.0
    _unstrict: _Excess | None = None
    _active: _Excess | None = None
    _kicked: _Excess | None = None

    def add(self, ticks: NDArray[np.void], balance: EnergyBalance) -> None:
        """Adds at least one record with its balance."""
        created = balance.environment_energy
        rounding = TOLERANCE * (1 + balance.throughput)
        unstrict = created > rounding
        allowed = balance.slack + rounding
        self.slack_share = max(
            self.slack_share, float(np.max(np.where(unstrict, created / allowed, 0.0)))
        )
        start = int(ticks["tick"][0])
        self._unstrict = self._unstrict or _first(unstrict, created, start)
        self._active = self._active or _first(created > allowed, created - balance.slack, start)
        if self.is_watched:
            kicked = balance.kicked > rounding
            self._kicked = self._kicked or _first(kicked, balance.kicked, start)
        self.commanded = float(balance.commanded[-1])
        last = ticks[-1]
        self.energies = {name: float(last[name]) for name in _RECORDED} | {
            "coupling_work": float(balance.coupling_work[-1]),
            "environment_energy": float(created[-1]),
            "device_energy": float(balance.device_energy[-1]),
            "slack": float(balance.slack[-1]),
        }

    def findings(self, *, strict: bool) -> dict[str, Any]:
        """Returns the fields of ``AuditReport`` that follow from the energies.

        ``strict`` accepts only (14) itself.
        """
        unstrict, active, kicked = self._unstrict, self._active, self._kicked
        if kicked is not None and not (active is not None and active.tick <= kicked.tick):
            return {
                "verdict": "active",
                "environment": "within slack" if unstrict else "strict",
                "reason": f"from tick {kicked.tick} the device is given {kicked.joules:.3g} J more "
                "than its damping burns and scene and coupling give up",
                "tick": kicked.tick,
                "port": "device",
                "joules": kicked.joules,
                "slack_share": self.slack_share,
            }
        if unstrict is None:
            # rounding may leave it above zero; + 0.0 removes the sign of zero
            lost = max(-self.energies["environment_energy"], 0.0) + 0.0
            return {
                "verdict": "passive",
                "environment": "strict",
                "reason": f"the environment never gave out more than it got ({lost:.3g} J "
                "dissipated)",
            }
        if active is None and not strict:
            return {
                "verdict": "passive",
                "environment": "within slack",
                "reason": "energy was created at times, within the slack that the coupling leaves "
                f"({self.slack_share:.0%} of it used)",
                "slack_share": self.slack_share,
            }
        excess = active or unstrict
        limit = "its slack" if active else "(14), asked for strictly"
        return {
            "verdict": "active",
            "environment": "active" if active else "within slack",
            "reason": f"from tick {excess.tick} the environment exceeds {limit} by "
            f"{excess.joules:.3g} J",
            "tick": excess.tick,
            "port": "environment",
            "joules": excess.joules,
            "slack_share": self.slack_share,
        }


def _first(is_beyond: NDArray[np.bool_], joules: NDArray[np.float64], start: int) -> _Excess | None:
    if not is_beyond.any():
        return None
    at = int(np.argmax(is_beyond))
    return _Excess(start + at, float(joules[at]))


# Comparison of records with their second computation.

CONTROLLED_TOLERANCE = 1e-5
"""Relative tolerance while the passivity controller acts. It divides a small debt by a squared
small velocity, which costs five digits. The re-simulation checks the rest."""


def physics_fault(ticks: NDArray[np.void], balance: EnergyBalance) -> Fault | None:
    """Returns the earliest disagreement between records and their second computation, or None."""
    start = int(ticks["tick"][0])
    vectors = (
        ("handle_position", balance.handle_position, "m", "device pose and scale"),
        ("wrench_on_tool", balance.wrench_on_tool, "N or N m", "coupling law and poses"),
        ("wrench_on_device", balance.wrench_on_device, "N or N m", "wrench on the tool and limits"),
    )
    faults = []
    for name, expected, unit, by in vectors:
        difference = np.abs(ticks[name] - expected).max(axis=1)
        allowed = TOLERANCE * (1 + np.abs(expected).max(axis=1))
        if name == "wrench_on_device":
            is_active = has_flag(ticks, TickFlag.CONTROLLER_ACTIVE)
            allowed = np.where(is_active, allowed * CONTROLLED_TOLERANCE / TOLERANCE, allowed)
        faults.append(_first_fault(name, start, difference, allowed, unit, by))
    faults.append(
        _first_fault(
            "handle_quaternion",
            start,
            balance.handle_turn,
            np.full(len(ticks), TOLERANCE),
            "rad",
            "device pose",
        )
    )
    energies = (
        ("coupling_work", balance.coupling_work, balance.throughput),
        ("device_energy", balance.device_energy, balance.device_throughput),
        ("environment_energy", balance.environment_energy, balance.throughput),
    )
    for name, joules, throughput in energies:
        difference = np.abs(ticks[name] - joules)
        scale = throughput + np.abs(ticks["potential"])
        faults.append(
            _first_fault(
                name,
                start,
                difference,
                TOLERANCE * (1 + scale),
                "J",
                "recorded poses and wrenches",
            )
        )
    is_off = (ticks["flags"] & int(TickFlag.CONTROLLER_ACTIVE)) == 0
    for kind, name in enumerate(("injected_damping", "injected_rotational_damping")):
        unit = UNITS[name]
        damping = np.where(is_off, np.abs(ticks[name]), 0.0)
        faults.append(_first_fault(name, start, damping, np.zeros(len(ticks)), unit, "flags"))
        expected = balance.injected_damping[:, kind]
        allowed = CONTROLLED_TOLERANCE * (1 + np.abs(expected))
        wrong = np.abs(ticks[name] - expected)
        faults.append(_first_fault(name, start, wrong, allowed, unit, "poses and energies"))
    found = [fault for fault in faults if fault is not None]
    return min(found, key=lambda fault: fault.tick or 0) if found else None


def _first_fault(
    name: str,
    start: int,
    difference: NDArray[np.float64],
    allowed: NDArray[np.float64],
    unit: str,
    by: str,
) -> Fault | None:
    wrong = ~(difference <= allowed)  # True also for NaN from an overflow
    if not wrong.any():
        return None
    at = int(np.argmax(wrong))
    tick, amount = start + at, float(difference[at])
    return Fault(
        f"{name} of tick {tick} is {amount:.3g} {unit} off what {by} give",
        tick,
        name,
        amount if unit == "J" else 0.0,
    )


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
        outside = RunEvents.of(recording.events, parameters, home)
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
    if parameters.law_evaluations > 1:
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
        self.judgement, self.duration = PassivityVerdict(is_watched), 0.0
        # an error of the re-simulation is raised after the records themselves have been judged
        self._error: RecordingError | None = None
        try:
            self._simulation = Resimulation(recording, parameters)
        except RecordingError as error:
            self._error = error

    def by(self, outside: RunEvents, late: int) -> Fault | None:
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
            balance = EnergyBalance.of(ticks, self._parameters, reached, outside, late, following)
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
