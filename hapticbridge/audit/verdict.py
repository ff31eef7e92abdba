"""Verdict on a recording, and the report that states it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.agreement import (
    event_statements,
    first_contradiction,
    metadata_statements,
)
from hapticbridge.audit.energy import EnergyBalance, energy_balances, energy_deviations
from hapticbridge.audit.events import AuditedRun, AuditState, RunEvents
from hapticbridge.audit.replay import AuditedHand, ReplayOutcome, comparison
from hapticbridge.audit.structure import (
    TOLERANCE,
    Fault,
    file_fault,
    first_row,
    structure_fault,
)
from hapticbridge.audit.timing import TimingTally
from hapticbridge.audit.wrench_limits import AuditedBlock, wrench_deviations
from hapticbridge.certificate import (
    condition_sentences,
    damping_margin,
    is_run_certified,
    run_conditions,
    worst_verdict,
)
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.files import finite_or_null
from hapticbridge.hand_energy import INSTANT, HandEnergy, worst_of
from hapticbridge.loop_setting import fresh_share
from hapticbridge.record import CLOCK_FIELDS
from hapticbridge.recording import RecordingFile
from hapticbridge.recording.reader import open_hands
from hapticbridge.rendering import Method, RunCoupling
from hapticbridge.run_description import meta_start, requested_of
from hapticbridge.summary import Environment, was_never_lossless
from hapticbridge.timekeeping import RunTimes, Timekeeping
from hapticbridge.units import format_energy

Verdict = Literal["passive", "unverified", "active", "invalid"]


@dataclass(frozen=True, slots=True)
class AuditReport:
    """Result of an audit.

    Attributes:
        path: The recording.
        verdict: ``passive``, ``active`` or ``invalid``; ``unverified`` if the records alone are
            passive, but the run was not simulated again.
        environment: ``strict`` (Σ E_k <= 0 held), ``within slack`` or ``active``; None if invalid.
        certified: True if the recorded device bears the coupling and the run kept its time; None if
            its damping is unknown or its motion is prescribed.
        reason: The verdict in a sentence.
        tick: First tick at fault, or None.
        port: Port at fault, ``environment`` or ``device``, or the field.
        joules: Energy at fault in J: created beyond the bound, or the mismatch.
        slack_share: Largest share of the slack that was used; 0 if strict.
        resimulation: ``bit for bit``, ``within 1e-9 (other processor)``, ``disagrees`` or ``not
            re-simulated: …``.
        is_cut: True if the file lacks the end of its run, or did before a repair; the verdict is on
            the rest.
        cut: Reasons for that, as a sentence; else empty.
        ticks: Number of records.
        duration: Time of the run's clock at the last record in s, with missed deadlines. If the
            recorded times are impossible, the number of records times the period.
        conditions: Device condition per kind of axis, as sentences.
        coupling: Requested, law and effective coupling at the start; None if invalid.
        coupling_sentences: Sentences on them, and on changes by commands. They hold away from
            contact, or everywhere if the tool was never released.
        unchecked: Parts that only the re-simulation confirms; empty if there are none. Without a
            re-simulation it names the changes that would pass: those of ``wrench_on_device`` and
            ``share`` that fit each other.
        timekeeping: Time that the run kept, and the device conditions at this time; None where the
            records could not be read.
        damping_margin: Smallest share of the device's damping that the coupling leaves at the time
            that the run kept, 1 − needed / b over the kinds of axis. It is negative if more is
            needed than available; None if b is unknown or the motion prescribed.
        energies: Energies at the end, in J.
        start_potential: Potential energy before the first tick in J; its zero is arbitrary.
        hand_energies: Energy that each hand got and what paid for it; empty if invalid.
        events: Number of events of each kind.
        findings: Faults of the scene of which the run warned, as sentences.
        accepts_unverified: True if ``unverified`` counts as a success in ``exit_code``.
        hands: Name of each hand's grip, if several hold the scene; else empty. The environment is
            judged over all of them, and each device by itself; ``certified`` is False if one lacks
            damping. Conditions and couplings name their hand, ``energies`` are sums over all hands.
    """

    path: Path
    verdict: Verdict
    environment: Environment | None
    certified: bool | None
    reason: str
    tick: int | None = None
    port: str = ""
    joules: float = 0.0
    slack_share: float = 0.0
    resimulation: str = ""
    is_cut: bool = False
    cut: str = ""
    ticks: int = 0
    duration: float = 0.0
    conditions: tuple[str, ...] = ()
    coupling: RunCoupling | None = None
    coupling_sentences: tuple[str, ...] = ()
    unchecked: str = ""
    timekeeping: Timekeeping | None = None
    damping_margin: float | None = None
    energies: dict[str, float] = field(default_factory=dict)
    start_potential: float = 0.0
    hand_energies: tuple[HandEnergy, ...] = ()
    events: dict[str, int] = field(default_factory=dict)
    findings: tuple[str, ...] = ()
    accepts_unverified: bool = False
    hands: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """The verdict in a few words; see ``verdict_words``."""
        return verdict_words(self.verdict, self.environment or "", self.port)

    def to_json(self) -> str:
        """Returns the report as one JSON object; a number that is not finite becomes null."""
        values = asdict(self) | {"path": str(self.path), "margin": self.margin}
        values["max_net_energy"] = self.max_net_energy
        if not self.hands:
            del values["hands"]
        return json.dumps(finite_or_null(values), indent=2, allow_nan=False)

    @property
    def max_net_energy(self) -> float:
        """Largest net energy to a hand in J."""
        return max((each.net for each in self.hand_energies), default=0.0)

    @property
    def hand_energy(self) -> HandEnergy:
        """Energy of the hand that decides (``hand_energy.worst_of``)."""
        return worst_of(self.hand_energies or (HandEnergy(),))

    @property
    def exit_code(self) -> int:
        """0 if passive (or unverified, if accepted) and not known to lack damping, else 1."""
        accepted = ("passive", "unverified")[: 1 + self.accepts_unverified]
        return 0 if self.verdict in accepted and self.certified is not False else 1

    @property
    def margin(self) -> float:
        """Smallest unused share of the slack (1 − ``slack_share``) and of the device's damping.

        1 means nothing was used, 0 is the limit, negative values are beyond it. The device's share
        is ``damping_margin``, if known. The margin is never above 0 for an active verdict, and NaN
        for an invalid one.
        """
        if self.verdict == "invalid":
            return math.nan
        parts = [1.0 - self.slack_share]
        if self.damping_margin is not None:
            parts.append(self.damping_margin)
        if self.verdict == "active":
            parts.append(0.0)
        return min(parts)


def verdict_words(verdict: str, environment: str, port: str) -> str:
    """Returns a verdict with its environment or port, as ``passive (strict)``.

    An unknown environment or port is empty.
    """
    beside = {"passive": environment, "unverified": environment, "active": port}.get(verdict)
    return f"{verdict} ({beside})" if beside else verdict


# End of a run


def unusual_end(events: Sequence[Mapping[str, Any]]) -> str:
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


Facts = dict[str, Any]

# Energies over the whole recording

_RECORDED = ("kinetic", "potential", "actuator_work", "external_work")


@dataclass(slots=True)
class PassivityTally:
    """Energies of a recording against their bounds, collected block by block.

    Attributes:
        is_watched: True if the device port is judged by any excess of its energy. A device that
            meets its condition behind a coupling law is judged by unpaid energy alone.
        energies: Energies after the newest tick, in J.
        slack_share: Largest share of the slack that was used.
        hand_energy: Energy that the hand got and what paid for it.
        unstrict: First tick beyond (14) itself, with the energy created.
        active: First tick beyond the slack, with the energy beyond it.
        excess: First tick in which the device received excess energy, and that energy.
    """

    is_watched: bool
    energies: dict[str, float] = field(default_factory=dict)
    slack_share: float = 0.0
    hand_energy: HandEnergy = field(default_factory=HandEnergy)
    unstrict: tuple[int, float] | None = None
    active: tuple[int, float] | None = None
    excess: tuple[int, float] | None = None

    def add(self, ticks: NDArray[np.void], balance: EnergyBalance) -> None:
        """Adds at least one record with its balance."""
        created, start = balance.environment_energy, int(ticks["tick"][0])
        rounding = TOLERANCE * (1 + balance.throughput)
        is_unstrict = created > rounding
        allowed = balance.slack + rounding
        used = float(np.max(np.where(is_unstrict, created / allowed, 0.0)))
        self.slack_share = max(self.slack_share, used)
        self.unstrict = self.unstrict or _first(is_unstrict, created, start)
        self.active = self.active or _first(created > allowed, created - balance.slack, start)
        if self.is_watched:
            excess = balance.excess_device_energy
            self.excess = self.excess or _first(excess > rounding, excess, start)
        else:
            unpaid = balance.unpaid_energy
            self.excess = self.excess or _first(unpaid > INSTANT, unpaid, start)
        last = ticks[-1]
        self.hand_energy = HandEnergy(
            net=max(self.hand_energy.net, float(np.max(balance.net_energy))),
            unpaid=max(self.hand_energy.unpaid, float(np.max(balance.unpaid_energy))),
            springs=balance.springs,
            scene=balance.scene_loss,
            motors=float(last["actuator_work"]),
            inputs=float(last["external_work"]),
        )
        self.energies = {name: float(last[name]) for name in _RECORDED} | {
            "coupling_work": float(balance.coupling_work[-1]),
            "environment_energy": float(created[-1]),
            "device_energy": float(balance.device_energy[-1]),
            "slack": float(balance.slack[-1]),
        }


def _first(
    is_beyond: NDArray[np.bool_], joules: NDArray[np.float64], start: int
) -> tuple[int, float] | None:
    row = first_row(is_beyond)
    return None if row is None else (start + row, float(joules[row]))


# Decision


@dataclass(frozen=True, slots=True)
class Decision:
    """Verdict and its reason; the fields are those of ``AuditReport``."""

    verdict: Verdict
    environment: Environment | None
    reason: str
    tick: int | None = None
    port: str = ""
    joules: float = 0.0
    slack_share: float = 0.0


def decide_on_hands(
    fault: Fault | None, energies: Sequence[PassivityTally], *, gap: str, strict: bool
) -> Decision:
    """Decides over the tallies of all hands, as ``decide`` does; the worst verdict counts."""
    ranks = ("invalid", "active", "unverified", "passive")
    found = [decide(fault, each, gap=gap, strict=strict) for each in energies]
    found = found or [decide(fault, None, gap=gap, strict=strict)]
    return min(found, key=lambda each: (ranks.index(each.verdict), each.tick or 0))


def decide(
    fault: Fault | None, energies: PassivityTally | None, *, gap: str, strict: bool
) -> Decision:
    """Decides between ``passive``, ``unverified``, ``active`` and ``invalid``.

    Args:
        fault: Fault that makes the recording invalid, or None.
        energies: Energies of a recording without a fault.
        gap: Clause with the reason why the run was not simulated again; empty if it was.
        strict: True accepts only (14) itself, not the slack that the device condition leaves.
    """
    found = _decide_on_records(fault, energies, strict=strict)
    if found.verdict != "passive" or not gap:
        return found
    reason = f"{gap} {found.reason}"
    return replace(found, verdict="unverified", reason=reason)


def _decide_on_records(
    fault: Fault | None, energies: PassivityTally | None, *, strict: bool
) -> Decision:
    if fault is not None or energies is None:
        fault = fault or Fault("the recording is empty: the run had no tick")
        return Decision("invalid", None, fault.reason, fault.tick, fault.port, fault.joules)
    unstrict, active, excess = energies.unstrict, energies.active, energies.excess
    if excess is not None and not (active is not None and active[0] <= excess[0]):
        tick, joules = excess
        reason = (
            f"until tick {tick} the hand got {format_energy(joules)} beyond what it put in, what "
            "the device's damping burned, and what scene and coupling released"
        )
        other: Environment = "within slack" if unstrict else "strict"
        return Decision("active", other, reason, tick, "device", joules, energies.slack_share)
    if unstrict is None:
        # rounding may leave it above zero
        lost = max(-energies.energies["environment_energy"], 0.0)
        spent = f"{format_energy(lost)} dissipated" if lost else "nothing was dissipated"
        reason = f"the environment never gave out more than it got ({spent})"
        return Decision("passive", "strict", reason)
    share = energies.slack_share
    if active is None and not strict:
        reason = (
            "energy was created at times, within the slack that the coupling leaves "
            f"({share:.0%} of it used)"
        )
        return Decision("passive", "within slack", reason, slack_share=share)
    tick, joules = active or unstrict
    limit = "its slack" if active else "zero, the strict limit,"
    reason = f"from tick {tick} the environment exceeds {limit} by {format_energy(joules)}"
    state: Environment = "active" if active else "within slack"
    return Decision("active", state, reason, tick, "environment", joules, share)


# Audit of one file


@np.errstate(all="ignore")  # numbers of a damaged file may overflow; the result is then a fault
def verdict_on(
    path: str | Path,
    *,
    strict: bool,
    accepts_unverified: bool,
    in_process: bool,
) -> AuditReport:
    """Judges a recording; implements ``audit.audit``.

    Raises:
        RecordingError: The file is not a recording.
        ForeignSceneError: Its scene crashed MuJoCo, or takes too much memory or time.
    """
    recordings = open_hands(path)
    recording = recordings[0]
    facts: dict[str, Any] = {
        "path": recording.path,
        "is_cut": bool(recording.cut_sentence),
        "cut": recording.cut_sentence,
        "ticks": recording.count,
        "events": _event_counts(recording),
        "findings": tuple(
            str(event.get("sentence", ""))[:MAX_FINDING]
            for event in recording.events
            if event.get("event") == "finding"
        ),
        "certified": None,
        "accepts_unverified": accepts_unverified,
    }
    energies: list[PassivityTally] = []
    outcome = ReplayOutcome("")
    try:
        hands = [AuditedHand(each, AuditedRun.of(each)) for each in recordings]
        of_hands = [_device_facts(hand.run, hand.recording) for hand in hands]
        for hand, own in zip(hands, of_hands, strict=True):
            own["coupling_sentences"] += hand.run.events.changes_of_coupling(hand.run.method)
        facts |= _joined(of_hands, recordings)
        facts["duration"] = recording.count * hands[0].run.parameters.period
        facts["unchecked"] = _unchecked(hands[0].run)
        fault = file_fault(recording) or first_contradiction(metadata_statements(recordings))
        fault = fault or _hands_fault(hands)
        if fault is None:
            energies = [PassivityTally(is_watched=own["certified"] is not True) for own in of_hands]
            with comparison(hands, is_trusted=in_process) as replayed:
                fault = _fault_in_ticks(hands, energies, of_hands, facts)
                facts |= _joined(of_hands, recordings)
                if fault is None:
                    outcome = replayed()
                    facts["resimulation"] = outcome.agreement
                    fault = _replay_fault(outcome)
    except RecordingError as error:
        fault = Fault(str(error))
    gap = "" if outcome.has_run else f"the run was {outcome.agreement}; in its records alone"
    if any(event.get("unsound") for event in recording.events):
        gap = "MuJoCo could not simulate the scene to the end; until then"
    found = asdict(decide_on_hands(fault, energies, gap=gap, strict=strict))
    if fault is None:
        if not outcome.has_run:
            facts["unchecked"] = facts["unchecked"] or _UNCHECKED_WITHOUT_REPLAY
        notes = (found["reason"], *_notes(facts, recording.events))
        found["reason"] = "; ".join(note for note in notes if note)
    return AuditReport(**facts, **found)


def _hand_words(facts: Mapping[str, Any]) -> str:
    """Returns a clause for each hand that got more than ``INSTANT``; empty without one."""
    grips = facts.get("hands") or ("",)
    return "; ".join(
        f"net to the hand{f' at {grip!r}' if grip else ''} {energy.sentence}"
        for grip, energy in zip(grips, facts["hand_energies"], strict=True)
        if energy.net > INSTANT
    )


def _joined(of_hands: Sequence[dict[str, Any]], recordings: Sequence[RecordingFile]) -> Facts:
    """Returns the facts on all hands' devices; of one hand, just its own.

    Sentences name their hand. Of margin and kept time those of the worst device count.
    """
    if len(of_hands) == 1:
        return of_hands[0]
    grips = tuple(each.meta.get("grip", "") for each in recordings)
    found: Facts = {"hands": grips, "coupling": of_hands[0]["coupling"]}
    for name in ("conditions", "coupling_sentences"):
        found[name] = tuple(
            f"{grip}: {sentence}"
            for grip, own in zip(grips, of_hands, strict=True)
            for sentence in own[name]
        )
    certified = [own["certified"] for own in of_hands]
    found["certified"] = worst_verdict(certified)
    margins = [own["damping_margin"] for own in of_hands if own["damping_margin"] is not None]
    found["damping_margin"] = min(margins, default=None)
    worst = [own for own in of_hands if own["certified"] == found["certified"]]
    kept = [own["timekeeping"] for own in worst if "timekeeping" in own]
    if kept:
        found["timekeeping"] = max(kept, key=lambda each: bool(each.slowness))
    return found


_OF_A_HAND = ("coupling_work", "device_energy")


def _energies_of_hands(tallies: Sequence[PassivityTally]) -> dict[str, float]:
    """Returns the energies at the end in J; what each hand has of its own is added up."""
    found = dict(tallies[0].energies)
    for name in _OF_A_HAND:
        found[name] = sum(tally.energies[name] for tally in tallies)
    return found


_SHARED = ("tick", *CLOCK_FIELDS, "kinetic", "potential", "actuator_work", "external_work")
"""Fields that the records of all hands have in common."""


def _hands_fault(hands: Sequence[AuditedHand]) -> Fault | None:
    """Returns the first contradiction between the records of several hands, or None."""
    first = hands[0].recording
    for hand in hands[1:]:
        blocks = zip(first.blocks(), hand.recording.blocks(), strict=True)
        start = 0
        for ours, theirs in blocks:
            for name in _SHARED:
                row = first_row(ours[name] != theirs[name])
                if row is not None:
                    reason = f"{name} of tick {start + row} differs between the hands"
                    return Fault(reason, start + row, name)
            start += len(ours)
    return None


def _fault_in_ticks(
    hands: Sequence[AuditedHand],
    energies: Sequence[PassivityTally],
    of_hands: Sequence[dict[str, Any]],
    facts: dict[str, Any],
) -> Fault | None:
    """Computes all ticks a second time, and compares what the file states with them.

    ``energies`` collect each hand's balance; what is found joins the facts of each hand, and those
    of the run. Returns the first fault.
    """
    faults = [structure_fault(hand.recording.blocks(), hand.run.events) for hand in hands]
    fault = next(filter(None, faults), None)
    if fault is not None:
        return fault
    timings = [TimingTally(hand.run.parameters) for hand in hands]
    fault, facts["duration"] = _check_records(hands, energies, timings)
    facts["energies"] = _energies_of_hands(energies)
    facts["start_potential"] = meta_start(hands[0].recording.meta, "start_potential")[0]
    facts["hand_energies"] = tuple(each.hand_energy for each in energies)
    for hand, own, timing, tally in zip(hands, of_hands, timings, energies, strict=True):
        own.update(_time_facts(hand, timing, own["certified"], tally.hand_energy))
        fault = fault or first_contradiction(event_statements(hand.recording, timing))
    return fault


def _notes(facts: Mapping[str, Any], events: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Returns what a reason adds on a recording without a fault, in clauses; some are empty."""
    kept = facts.get("timekeeping")
    energy = worst_of(facts["hand_energies"])
    cause = kept.refutation(energy) if kept else ""
    doubt = kept.fault if kept else ""
    if facts["certified"] is False and cause in ("", energy.fault):
        doubt = cause or (kept.lack if kept else "the device has less than the coupling needs")
    silence = kept.silence if kept else ""
    return silence, doubt, _hand_words(facts), unusual_end(events), facts["unchecked"]


def _check_records(
    hands: Sequence[AuditedHand],
    energies: Sequence[PassivityTally],
    timings: Sequence[TimingTally],
) -> tuple[Fault | None, float]:
    """Compares all records with their second computation; collects energies and times per hand.

    All hands share the scene's slack, and the tank of the first one. What each did to the scene is
    its recorded ``coupling_work``, which the second computation of its own records confirms.

    Returns:
        The earliest fault or None, and the due time of the last record in s.
    """
    fault, duration = None, 0.0
    streams = [
        energy_balances(
            hand.recording.blocks(),
            AuditState.at_start(hand.recording, hand.run.parameters),
            hand.run.events,
            min(hand.run.delay, hand.recording.count),
            _work_of([other.recording for other in hands if other is not hand]),
        )
        for hand in hands
    ]
    for parts in zip(*streams, strict=True):
        slack = np.sum([balance.slack for _, balance in parts], axis=0)
        throughput = np.sum([balance.throughput for _, balance in parts], axis=0)
        faults = []
        for hand, (block, own) in enumerate(parts):
            run = hands[hand].run
            tank = parts[0][1].contact_tank
            balance = replace(own, slack=slack, throughput=throughput, contact_tank=tank)
            energies[hand].add(block.ticks, balance)
            timings[hand].add(block, run.events)
            duration = 1e-9 * float(block.ticks["deadline_ns"][-1])
            faults.append(_block_fault(block, balance, run.events))
        found = [each for each in faults if each is not None]
        fault = fault or min(found, key=lambda each: each.tick or 0, default=None)
    return fault, duration


def _work_of(recordings: Sequence[RecordingFile]) -> Iterator[NDArray[np.float64]] | None:
    """Returns the recorded work of some hands' couplings by block; None without hands."""
    if not recordings:
        return None
    blocks = zip(*(recording.blocks() for recording in recordings), strict=True)
    return (np.sum([ticks["coupling_work"] for ticks in each], axis=0) for each in blocks)


def _block_fault(block: AuditedBlock, balance: EnergyBalance, events: RunEvents) -> Fault | None:
    """Returns the earliest disagreement between records and their second computation, or None."""
    start = int(block.ticks["tick"][0])
    deviations = chain(wrench_deviations(block, events), energy_deviations(block, balance))
    faults = [fault for each in deviations if (fault := each.fault(start))]
    return min(faults, key=lambda fault: fault.tick or 0, default=None)


def _replay_fault(outcome: ReplayOutcome) -> Fault | None:
    if not outcome.disagrees:
        return None
    if outcome.warning:
        reason = f"simulated again, tick {outcome.tick} is refused: {outcome.warning}"
        return Fault(reason, outcome.tick, outcome.field)
    return Fault(
        f"simulated again, tick {outcome.tick} differs in {outcome.field} by "
        f"{outcome.difference:.3g}: the recording was changed, or the scene was changed during "
        "the run other than by set_input",
        outcome.tick,
        outcome.field,
    )


MAX_FINDING = 500
"""Largest number of characters of a recorded warning, which is read from a foreign file."""


def _event_counts(recording: RecordingFile) -> dict[str, int]:
    counts: dict[str, int] = {}
    for event in recording.events:
        name = str(event.get("event", "unnamed"))
        counts[name] = counts.get(name, 0) + 1
    return counts


def _device_facts(run: AuditedRun, recording: RecordingFile) -> dict[str, Any]:
    info, method, parameters = run.info, run.method, run.parameters
    try:
        worst = run.worst
        coupling = RunCoupling.of(
            method,
            parameters.timestep,
            requested_of(recording.meta),
            law=parameters.coupling,
            measured=parameters.effective,
            is_always_implicit=not parameters.scene_ticks
            and was_never_lossless(recording.count, recording.flags),
        ).felt_at(parameters.grip, parameters.scale, parameters.force_scale)
        conditions = run_conditions(info, worst, method)
        return {
            "certified": is_run_certified(conditions, method),
            "conditions": condition_sentences(info, worst, method),
            "damping_margin": damping_margin(conditions),
            "coupling": coupling,
            "coupling_sentences": coupling.sentences(info),
        }
    except HapticBridgeError as error:  # numbers outside the theory's range
        raise RecordingError(f"the metadata are out of range: {error}") from None


def _time_facts(
    hand: AuditedHand, timing: TimingTally, certified: bool | None, energy: HandEnergy
) -> dict[str, Any]:
    """Returns the time that a run kept, and its device's verdict and margin at this time."""
    run, recording = hand.run, hand.recording
    times = RunTimes(
        ticks=timing.ticks,
        fresh=fresh_share(run.info, run.parameters.period, timing.fresh, timing.due),
        new_samples=timing.fresh,
        due=timing.due,
        mean_delay=timing.delays / max(timing.ticks, 1),
        mean_jitter=timing.jitter / max(timing.ticks, 1),
        delay_energy=timing.max_uncovered,
        is_realtime=any(event.get("event") == "real_time" for event in recording.events),
        flags=recording.flags,
        has_tripped=any(event.get("event") == "trip" for event in recording.events),
        scene_steps=timing.scene_steps,
        scene_silence=run.parameters.period * timing.longest_silence,
        silence=timing.silence,
        silent_tick=timing.silent_tick,
    )
    conditions = run_conditions(run.info, run.worst, run.method) if run.method.has_law else ()
    kept = Timekeeping.from_times(times, run.worst, conditions)
    facts: dict[str, Any] = {"timekeeping": kept, "certified": kept.certified(certified, energy)}
    if kept.conditions:
        facts["damping_margin"] = damping_margin(kept.conditions)
    return facts


def _unchecked(run: AuditedRun) -> str:
    """Returns the part that no second computation covers; empty if there is none."""
    method: Method = run.method
    if not method.has_coupling:
        return "the wrench comes from contacts: checked by re-simulation alone"
    if not method.has_law:
        return "no coupling law gives the wrench: checked by re-simulation alone"
    if run.parameters.law_evaluations > 1:
        return "the wrench is a mean over substeps: it and its work checked by re-simulation alone"
    return ""


_UNCHECKED_WITHOUT_REPLAY = (
    "not re-simulated: a change of wrench_on_device and share that fits both would go unnoticed"
)
"""Changes that pass where versions differ and nothing is simulated again."""
