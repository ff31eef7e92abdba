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
from hapticbridge.audit.replay import Agreement, AuditedHand, ReplayOutcome, comparison
from hapticbridge.audit.structure import (
    TOLERANCE,
    Fault,
    file_fault,
    first_row,
    structure_fault,
)
from hapticbridge.audit.timing import TimingTally
from hapticbridge.audit.wrench_limits import AuditedBlock, wrench_deviations
from hapticbridge.demand.certificate import (
    condition_sentences,
    damping_margin,
    is_run_certified,
    run_conditions,
)
from hapticbridge.demand.certification import Certification, certification_of, worst_certification
from hapticbridge.demand.loop_setting import fresh_share
from hapticbridge.demand.methods import Method, RunCoupling
from hapticbridge.demand.timekeeping import RunTimes, Timekeeping
from hapticbridge.demand.trip import BY_TRIP, Trip
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.files import finite_or_null
from hapticbridge.kernel.hand_energy import INSTANT, HandEnergy
from hapticbridge.kernel.record import CLOCK_FIELDS
from hapticbridge.recording import RecordingFile
from hapticbridge.recording.format import SHOWN_EVENT
from hapticbridge.recording.reader import open_hands
from hapticbridge.run.description import (
    MAX_WORDS,
    change_in,
    changed_words,
    meta_start,
    requested_of,
)
from hapticbridge.run.summary import Environment, posted_words, was_never_lossless
from hapticbridge.units import facts_html, format_energy

Verdict = Literal["passive", "unverified", "active", "empty", "invalid"]


@dataclass(frozen=True, slots=True)
class AuditReport:
    """Result of an audit.

    Attributes:
        path: The recording.
        verdict: ``passive``, ``active`` or ``invalid``; ``unverified`` if the records alone are
            passive, but the run was not simulated again; ``empty`` if there is no record to judge.
        environment: ``strict`` (Σ E_k <= 0 held), ``within slack`` or ``active``; None if invalid
            or empty.
        sentence: The verdict in a sentence.
        remarks: Further clauses on an undamaged recording: silence, device, energy, end, checks.
        tick: First tick at fault, or None.
        port: Port at fault, ``environment`` or ``device``, or the field.
        joules: Energy at fault in J: created beyond the bound, or the mismatch.
        slack_share: Largest share of the slack that was used; 0 if strict.
        agreement: Outcome of the re-simulation; None if the audit did not get there.
        obstacle: Reason why the run was not simulated again; empty if it was.
        is_cut: True if the file lacks the end of its run, or did before a repair; the verdict is on
            the rest.
        lacks_end: True if the file lacks the end of its run, which a repair mends.
        cut: Reasons for that, as a sentence; else empty.
        ticks: Number of records.
        duration: Time of the run's clock at the last record in s, with missed deadlines. If the
            recorded times are impossible, the number of records times the period.
        conditions: Device condition per kind of axis, as sentences.
        coupling: Requested, law and effective coupling at the start; None if invalid.
        coupling_sentences: Sentences on them, and on changes by commands. They hold away from
            contact, or everywhere if the tool was never released.
        couplings: First of these sentences, of each hand.
        unchecked: Parts that only the re-simulation confirms; empty if there are none. Without a
            re-simulation it names the changes that would pass: those of ``wrench_on_device`` and
            ``share`` that fit each other.
        certification: Verdict on the device, of several hands on the worst; None if invalid or
            empty.
        trip: Stop by the guard; None without one.
        damping_margin: Smallest share of the device's damping that the coupling leaves at the time
            that the run kept, 1 − needed / b over the kinds of axis. It is negative if more is
            needed than available; None if b is unknown or the motion prescribed.
        energies: Energies at the end, in J.
        start_potential: Potential energy before the first tick in J; its zero is arbitrary.
        credit: Energy in J that another program's scene may give to the hand; 0 for another scene.
        hand_energies: Energy that each hand got and what paid for it; empty if invalid.
        events: Number of events of each kind.
        findings: Faults of the scene of which the run warned, as sentences.
        accepts_unverified: True if ``unverified`` counts as a success in ``exit_code``.
        hands: Name of each hand's grip, if several hold the scene; else empty. The environment is
            judged over all of them, and each device by itself. Conditions and couplings name their
            hand, ``energies`` are sums over all hands.
    """

    path: Path
    verdict: Verdict
    environment: Environment | None
    sentence: str
    remarks: tuple[str, ...] = ()
    tick: int | None = None
    port: str = ""
    joules: float = 0.0
    slack_share: float = 0.0
    agreement: Agreement | None = None
    obstacle: str = ""
    is_cut: bool = False
    lacks_end: bool = False
    cut: str = ""
    ticks: int = 0
    duration: float = 0.0
    conditions: tuple[str, ...] = ()
    coupling: RunCoupling | None = None
    coupling_sentences: tuple[str, ...] = ()
    couplings: tuple[str, ...] = ()
    unchecked: str = ""
    certification: Certification | None = None
    trip: Trip | None = None
    damping_margin: float | None = None
    energies: dict[str, float] = field(default_factory=dict)
    start_potential: float = 0.0
    credit: float = 0.0
    hand_energies: tuple[HandEnergy, ...] = ()
    events: dict[str, int] = field(default_factory=dict)
    findings: tuple[str, ...] = ()
    accepts_unverified: bool = False
    hands: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """The verdict in a few words; see ``verdict_words``."""
        return verdict_words(self.verdict, self.state, self.port)

    @property
    def state(self) -> str:
        """Environment in words; of a scene that another program stepped nothing is known."""
        return "toward the hand" if self.credit else self.environment or ""

    def _repr_html_(self) -> str:
        """Returns verdict, reason and conditions as HTML, for a notebook."""
        rows = [
            ("why", self.reason),
            ("simulated again", self.resimulation),
            ("ran", f"{self.duration:.3f} s, {self.ticks} ticks"),
        ]
        notes = (*self.coupling_sentences, *self.conditions)
        return facts_html(f"{self.path.name}: {self.words}", rows, notes)

    def to_json(self) -> str:
        """Returns the report as one JSON object; a number that is not finite becomes null."""
        values = asdict(self) | {"path": str(self.path), "margin": self.margin}
        for name in ("reason", "resimulation", "certified", "max_net_energy"):
            values[name] = getattr(self, name)
        values["environment"] = self.state or None
        certification = values.pop("certification") and self.certification
        values |= certification.to_dict() if certification else {}
        if not self.hands:
            del values["hands"]
        return json.dumps(finite_or_null(values), indent=2, allow_nan=False)

    @property
    def max_net_energy(self) -> float:
        """Largest net energy to a hand in J."""
        return max((each.net for each in self.hand_energies), default=0.0)

    @property
    def hand_energy(self) -> HandEnergy:
        """Energy of the hand that decides on the certificate."""
        return HandEnergy() if self.certification is None else self.certification.energy

    @property
    def scales(self) -> str:
        """Clause of hands at which energy counts otherwise than in the scene (``HandEnergy``)."""
        return next(filter(None, (each.scales for each in self.hand_energies)), "")

    @property
    def reason(self) -> str:
        """The verdict in a sentence, with all remarks."""
        return "; ".join((self.sentence, *self.remarks))

    @property
    def resimulation(self) -> str:
        """Outcome of the re-simulation in words; empty if the audit did not get there."""
        return f"{self.agreement or ''}{': ' if self.obstacle else ''}{self.obstacle}"

    @property
    def certified(self) -> bool | None:
        """True if the device bears the coupling as the run was; None if that is unknown."""
        return None if self.certification is None else self.certification.verdict

    @property
    def answer(self) -> str:
        """Verdict on the device in a table; an invalid file has none."""
        return "not judged" if self.certification is None else self.certification.answer

    @property
    def timekeeping(self) -> Timekeeping | None:
        """Time that the run kept; None if invalid."""
        return None if self.certification is None else self.certification.kept

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
        for an invalid or empty one.
        """
        if self.verdict in ("invalid", "empty"):
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


NOTHING_TO_JUDGE = "the recording holds no tick, so there is nothing to judge"
"""Sentence on an undamaged recording of a run that ended before its first tick."""


# End of a run


_USUAL_ENDS = ("duration", "signal", "caller", "program", BY_TRIP, None, "")


def unusual_end(trip: Trip | None, events: Sequence[Mapping[str, Any]]) -> str:
    """Returns a clause that names what ended the run; empty for an ordinary end."""
    clauses = []
    if trip is not None:
        clauses.append(f"the guard tripped at tick {trip.tick}: {trip.words[:MAX_WORDS]}")
    for event in events:
        name, by = event.get("event"), event.get("error") or event.get("reason")
        if name == "bridge_died":
            clauses.append(f"the bridge died after tick {event.get('tick')}")
        elif name == "recorder_died":
            clauses.append("the recorder died during the run")
        elif name == "suspended":
            clauses.append(f"the machine was asleep for {event.get('seconds', 0):.3g} s")
        elif name == "stop" and event.get("signal"):
            clauses.append(f"stopped by {event['signal']} at tick {event.get('tick')}")
        elif name == "stop" and trip is None and by not in _USUAL_ENDS:
            clauses.append(f"stopped by {str(by)[:MAX_WORDS]}")
    return "; ".join(clauses)


# Energies over the whole recording

_RECORDED = ("kinetic", "potential", "actuator_work", "external_work")


@dataclass(slots=True)
class PassivityTally:
    """Energies of a recording against their bounds, collected block by block.

    Attributes:
        ratio: q of ``HandEnergy``.
        is_watched: True if the device port is judged by any excess of its energy. A device that
            meets its condition behind a coupling law is judged by unpaid energy alone.
        energies: Energies after the newest tick, in J.
        slack_share: Largest share of the slack that was used.
        hand_energy: Energy that the hand got and what paid for it.
        unstrict: First tick beyond (14) itself, with the energy created.
        active: First tick beyond the slack, with the energy beyond it.
        excess: First tick in which the device received excess energy, and that energy.
    """

    ratio: float
    is_watched: bool
    energies: dict[str, float] = field(default_factory=dict)
    slack_share: float = 0.0
    hand_energy: HandEnergy = field(default_factory=HandEnergy)
    unstrict: tuple[int, float] | None = None
    active: tuple[int, float] | None = None
    excess: tuple[int, float] | None = None

    def add(self, ticks: NDArray[np.void], balance: EnergyBalance) -> None:
        """Adds at least one record with its balance."""
        # what pulses took was given out, too
        created, start = balance.environment_energy + balance.pulses.taken, int(ticks["tick"][0])
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
            hidden=balance.hidden_energy,
            unpaid=max(self.hand_energy.unpaid, float(np.max(balance.unpaid_energy))),
            springs=balance.springs,
            scene=balance.released,
            motors=_peak(self.hand_energy.motors, ticks["actuator_work"]),
            inputs=_peak(self.hand_energy.inputs, balance.input_work),
            gross=max(self.hand_energy.gross, float(np.max(balance.gross_energy))),
            ratio=self.ratio,
        )
        self.energies = {name: float(last[name]) for name in _RECORDED} | {
            "coupling_work": float(balance.coupling_work[-1]),
            "environment_energy": float(balance.environment_energy[-1]),
            "device_energy": float(balance.device_energy[-1]),
            "slack": float(balance.slack[-1]),
        }


def _peak(before: float, works: NDArray[np.float64]) -> float:
    """Returns the work of largest size, the earlier one among equals."""
    joined = np.append(before, works)
    return float(joined[np.argmax(np.abs(joined))])


def _first(
    is_beyond: NDArray[np.bool_], joules: NDArray[np.float64], start: int
) -> tuple[int, float] | None:
    row = first_row(is_beyond)
    return None if row is None else (start + row, float(joules[row]))


# Decision


def decide_on_hands(
    report: AuditReport,
    fault: Fault | None,
    energies: Sequence[PassivityTally],
    *,
    gap: str,
    strict: bool,
) -> AuditReport:
    """Decides over the tallies of all hands, as ``decide`` does; the worst verdict counts."""
    ranks = ("invalid", "active", "empty", "unverified", "passive")
    tallies = energies if fault is None else ()
    verdicts = [decide(report, fault, each, gap=gap, strict=strict) for each in tallies or (None,)]
    return min(verdicts, key=lambda each: (ranks.index(each.verdict), each.tick or 0))


def decide(
    report: AuditReport,
    fault: Fault | None,
    energies: PassivityTally | None,
    *,
    gap: str,
    strict: bool,
) -> AuditReport:
    """Decides between ``passive``, ``unverified``, ``active``, ``empty`` and ``invalid``.

    Args:
        report: Report without a verdict.
        fault: Fault that makes the recording invalid, or None.
        energies: Energies of a recording without a fault; None if it holds no tick.
        gap: Clause with the reason why the run was not simulated again; empty if it was.
        strict: True accepts only (14) itself, not the slack that the device condition leaves.
    """
    if fault is not None:
        return replace(
            report,
            sentence=fault.reason,
            tick=fault.tick,
            port=fault.port,
            joules=fault.joules,
        )
    if energies is None:
        return replace(report, verdict="empty", sentence=NOTHING_TO_JUDGE)
    unstrict, active, excess = energies.unstrict, energies.active, energies.excess
    state: Environment = "strict" if unstrict is None else "within slack"
    report = replace(report, environment=state, slack_share=energies.slack_share)
    if excess is not None and not (active is not None and active[0] <= excess[0]):
        tick, joules = excess
        sentence = (
            f"until tick {tick} the hand got {format_energy(joules)} beyond what it put in, what "
            "the device's damping burned, and what scene and coupling released"
        )
        return replace(
            report, verdict="active", sentence=sentence, tick=tick, port="device", joules=joules
        )
    beyond = active or (unstrict if strict else None)
    if beyond is not None:
        tick, joules = beyond
        limit = "its slack" if active else "zero, the strict limit,"
        return replace(
            report,
            verdict="active",
            environment="active" if active else state,
            sentence=f"from tick {tick} the environment exceeds {limit} by {format_energy(joules)}",
            tick=tick,
            port="environment",
            joules=joules,
        )
    if unstrict is None and report.credit:
        sentence = posted_words(report.credit)
    elif unstrict is None:
        # rounding may leave it above zero
        lost = max(-energies.energies["environment_energy"], 0.0)
        spent = f"{format_energy(lost)} dissipated" if lost else "nothing was dissipated"
        sentence = f"the environment never gave out more than it got ({spent})"
    else:
        sentence = (
            "energy was created at times, within the slack that the coupling leaves "
            f"({energies.slack_share:.0%} of it used)"
        )
    verdict: Verdict = "unverified" if gap else "passive"
    return replace(report, verdict=verdict, sentence=f"{gap} {sentence}" if gap else sentence)


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
    report = AuditReport(
        path=recording.path,
        verdict="invalid",
        environment=None,
        sentence="",
        is_cut=bool(recording.cut_sentence),
        lacks_end=recording.is_cut,
        cut=recording.cut_sentence,
        ticks=recording.count,
        events=_event_counts(recording),
        findings=tuple(
            str(event.get("sentence", ""))[:MAX_WORDS]
            for event in recording.events
            if event.get("event") == "finding"
        ),
        accepts_unverified=accepts_unverified,
    )
    energies: list[PassivityTally] = []
    fault: Fault | None = None
    try:
        report = replace(report, trip=Trip.among(recording.events))
        hands = [AuditedHand(each, AuditedRun.of(each)) for each in recordings]
        devices = [JudgedDevice.before_run(hand) for hand in hands]
        report = replace(report, **_joined(devices))
        parameters = hands[0].run.parameters
        report = replace(report, duration=recording.count * parameters.period)
        report = replace(report, credit=parameters.credit)
        report = replace(report, unchecked=_unchecked(hands[0].run))
        fault = file_fault(recording) or first_contradiction(metadata_statements(recordings))
        fault = fault or _hands_fault(hands)
        if fault is None and not recording.count and not recording.cut_sentence:
            untimed = TimingTally(parameters)
            fault = first_contradiction(event_statements(recording, untimed))
        elif fault is None and recording.count:
            judged = zip(hands, devices, strict=True)
            energies = [
                PassivityTally(
                    1.0 if hand.run.info.is_prescribed else hand.run.parameters.energy_ratio,
                    is_watched=not device.is_borne,
                )
                for hand, device in judged
            ]
            with comparison(hands, is_trusted=in_process) as replayed:
                report, fault = _compared_in_ticks(report, hands, devices, energies)
                if fault is None:
                    outcome = replayed()
                    report = replace(report, agreement=outcome.agreement, obstacle=outcome.obstacle)
                    fault = _replay_fault(outcome, recording.events)
    except RecordingError as error:  # what is damaged may lack metadata
        if recording.count or recording.problems or not recording.is_cut:
            fault = file_fault(recording) if recording.problems else Fault(str(error))
    gap = f"the run was {report.resimulation}; in its records alone" if report.obstacle else ""
    if report.trip and report.trip.is_unsound:
        gap = "MuJoCo could not simulate the scene to the end; until then"
    report = decide_on_hands(report, fault, energies, gap=gap, strict=strict)
    if report.verdict == "invalid":
        return replace(report, certification=None)
    if report.verdict == "empty":
        end = unusual_end(report.trip, recording.events)
        if not end and any(event.get("event") == "stop" for event in recording.events):
            end = "the run was stopped before its first tick"
        return replace(report, remarks=(end,) if end else ())
    if report.obstacle:
        report = replace(report, unchecked=report.unchecked or _UNCHECKED_WITHOUT_REPLAY)
    return replace(report, remarks=tuple(filter(None, _remarks(report, recording.events))))


def _hand_words(report: AuditReport) -> str:
    """Returns clauses on hands that got more than ``INSTANT``, or may have behind steps."""
    parts = []
    for grip, energy in zip(report.hands or ("",), report.hand_energies, strict=True):
        at = f" at {grip!r}" if grip else ""
        at += ", before the tick that tripped," if report.trip else ""
        if energy.net > INSTANT:
            parts.append(f"net to the hand{at} {energy.sentence}")
        elif energy.release and not report.credit:
            giver = "the scene's storage or another hand" if report.hands else "the scene's storage"
            parts.append(f"{giver}{at} {energy.release}")
        if energy.blur:
            parts.append(f"encoder steps{at} {energy.blur}")
    return "; ".join(parts)


@dataclass(slots=True, kw_only=True)
class JudgedDevice:
    """Findings of an audit on the device of a hand.

    Attributes:
        grip: Name of the hand's grip.
        is_borne: True if the device meets its conditions with every tick in time.
        conditions: Its conditions, as sentences.
        damping_margin: Smallest share of its damping that is left; None if unknown.
        coupling: Requested, law and effective coupling.
        coupling_sentences: Sentences on them, and on changes by commands.
        certification: Verdict on the device after the run; None before its ticks were read.
    """

    grip: str
    is_borne: bool
    conditions: tuple[str, ...]
    damping_margin: float | None
    coupling: RunCoupling
    coupling_sentences: tuple[str, ...]
    certification: Certification | None = None

    @classmethod
    def before_run(cls, hand: AuditedHand) -> JudgedDevice:
        """Judges the device by the metadata and events.

        Raises:
            RecordingError: Their numbers are beyond the range of the theory.
        """
        run, recording = hand.run, hand.recording
        info, method = run.info, run.method
        try:
            coupling = RunCoupling.of_run(
                method,
                requested_of(recording.meta),
                run.parameters,
                was_never_lossless=was_never_lossless(recording.count, recording.flags),
            )
            conditions = run_conditions(info, run.worst, method)
            return cls(
                grip=recording.meta.get("grip", ""),
                is_borne=is_run_certified(conditions, method) is True,
                conditions=condition_sentences(info, run.worst, method),
                damping_margin=damping_margin(conditions),
                coupling=coupling,
                coupling_sentences=coupling.sentences(info)
                + run.events.changes_of_coupling(method),
            )
        except HapticBridgeError as error:  # numbers outside the theory's range
            raise RecordingError(f"the metadata are out of range: {error}") from None

    def judge(self, hand: AuditedHand, timing: TimingTally, energies: PassivityTally) -> None:
        """Judges the device by the run: the time that it kept, and what the hand got."""
        run, recording = hand.run, hand.recording
        times = RunTimes(
            ticks=timing.ticks,
            fresh=fresh_share(run.info, run.parameters.period, timing.fresh, timing.due),
            new_samples=timing.fresh,
            due=timing.due,
            mean_delay=timing.delays / max(timing.ticks, 1) + run.events.added_delay,
            mean_jitter=timing.jitter / max(timing.ticks, 1),
            delay_energy=timing.max_uncovered,
            is_realtime=any(event.get("event") == "real_time" for event in recording.events),
            flags=recording.flags,
            has_tripped=any(event.get("event") == "trip" for event in recording.events),
            scene_steps=timing.scene_steps,
            scene_silence=run.parameters.period * timing.longest_silence,
            silence=timing.silence,
            silent_tick=timing.silent_tick,
            unanswered=run.events.unanswered,
            has_created=energies.unstrict is not None,
        )
        energy, account = energies.hand_energy, run.own_loop
        certification = certification_of(run.info, run.worst, run.method, times, energy, account)
        self.certification = certification
        if certification.kept.conditions:
            self.damping_margin = damping_margin(certification.kept.conditions)


def _joined(devices: Sequence[JudgedDevice]) -> dict[str, Any]:
    """Returns fields of ``AuditReport`` on all hands' devices.

    Sentences of several name their hand. The smallest margin and the worst verdict count.
    """
    has_several, first = len(devices) > 1, devices[0]
    margins = [each.damping_margin for each in devices if each.damping_margin is not None]
    certifications = [each.certification for each in devices if each.certification is not None]

    def named(grip: str, sentences: Sequence[str]) -> list[str]:
        return [f"{grip}: {each}" if has_several else each for each in sentences]

    return {
        "hands": tuple(each.grip for each in devices) if has_several else (),
        "coupling": first.coupling,
        "conditions": tuple(s for each in devices for s in named(each.grip, each.conditions)),
        "coupling_sentences": tuple(
            s for each in devices for s in named(each.grip, each.coupling_sentences)
        ),
        "couplings": tuple(
            s for each in devices for s in named(each.grip, each.coupling_sentences[:1])
        ),
        "damping_margin": min(margins, default=None),
        "certification": worst_certification(certifications) if certifications else None,
    }


_OF_A_HAND = ("coupling_work", "device_energy")


def _energies_of_hands(tallies: Sequence[PassivityTally]) -> dict[str, float]:
    """Returns the energies at the end in J; what each hand has of its own is added up."""
    energies = dict(tallies[0].energies)
    for name in _OF_A_HAND:
        energies[name] = sum(tally.energies[name] for tally in tallies)
    return energies


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


def _compared_in_ticks(
    report: AuditReport,
    hands: Sequence[AuditedHand],
    devices: Sequence[JudgedDevice],
    energies: Sequence[PassivityTally],
) -> tuple[AuditReport, Fault | None]:
    """Computes all ticks a second time, and compares what the file states with them.

    ``energies`` collect each hand's balance. Returns the report with energies and verdicts on the
    devices, and the first fault.
    """
    faults = [structure_fault(hand.recording.blocks(), hand.run.events) for hand in hands]
    fault = next(filter(None, faults), None)
    if fault is not None:
        return report, fault
    timings = [TimingTally(hand.run.parameters) for hand in hands]
    fault, duration = _check_records(hands, energies, timings)
    for hand, device, timing, tally in zip(hands, devices, timings, energies, strict=True):
        device.judge(hand, timing, tally)
        if device.certification and (own_loop := device.certification.own_loop):
            tally.excess = tally.excess or own_loop.first_excess
        fault = fault or first_contradiction(event_statements(hand.recording, timing))
    report = replace(
        report,
        duration=duration,
        energies=_energies_of_hands(energies),
        start_potential=meta_start(hands[0].recording.meta, "start_potential")[0],
        hand_energies=tuple(each.hand_energy for each in energies),
        **_joined(devices),
    )
    return report, fault


def _remarks(report: AuditReport, events: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Returns what a reason adds on a recording without a fault, in clauses; some are empty."""
    certification = report.certification
    silence = certification and certification.kept.silence
    own_loop = certification and certification.own_loop
    return (
        silence.sentence if silence else "",
        f"the device's loop: {own_loop.words}" if own_loop else "",
        certification.reason if certification else "",
        report.scales,
        _hand_words(report),
        unusual_end(report.trip, events),
        report.unchecked,
    )


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
            timings[hand].add(block, balance)
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


def _replay_fault(outcome: ReplayOutcome, events: Sequence[Mapping[str, Any]]) -> Fault | None:
    if not outcome.disagrees:
        return None
    if outcome.warning:
        reason = f"simulated again, tick {outcome.tick} is refused: {outcome.warning}"
        return Fault(reason, outcome.tick, outcome.field)
    changed = change_in(events)
    cause = changed_words(changed)
    return Fault(
        f"simulated again, tick {outcome.tick} differs in {outcome.field} by "
        f"{outcome.difference:.3g}: {'' if changed else 'the recording was changed, or '}{cause}",
        outcome.tick,
        outcome.field,
    )


def _event_counts(recording: RecordingFile) -> dict[str, int]:
    counts: dict[str, int] = {}
    for event in recording.events:
        name, count = str(event.get("event", "unnamed")), event.get("count")
        if name == "reset" and event.get("by") == "program":
            name = "placed"
        shown = count if name == SHOWN_EVENT and type(count) is int else 1
        counts[name] = counts.get(name, 0) + shown
    return counts


def _unchecked(run: AuditedRun) -> str:
    """Returns the part that no second computation covers; empty if there is none."""
    method: Method = run.method
    if not method.has_coupling:
        return "the wrench comes from contacts: checked by re-simulation alone"
    if not method.has_law:
        return "no coupling law gives the wrench: checked by re-simulation alone"
    if run.parameters.is_apart:
        return (
            "the force on the hand, and work and periods of the device's loop, are as the device "
            "reported them: its board alone knows them"
        )
    if run.parameters.law_evaluations > 1:
        return "the wrench is a mean over substeps: it and its work checked by re-simulation alone"
    return ""


_UNCHECKED_WITHOUT_REPLAY = (
    "not re-simulated: a change of wrench_on_device and share that fits both would go unnoticed"
)
"""Changes that pass where versions differ and nothing is simulated again."""
