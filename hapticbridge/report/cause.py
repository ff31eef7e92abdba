"""Likely cause of an active run, by rules on the records and the run's settings."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Literal, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.audit.events import AuditedRun
from hapticbridge.audit.motion import turn_between
from hapticbridge.audit.recorded_scene import bounds_for, compile_recorded
from hapticbridge.audit.replay import Agreement, Resimulator
from hapticbridge.confinement import Worker, in_bounds
from hapticbridge.demand.certificate import DampingCondition, run_conditions
from hapticbridge.demand.loop_setting import Lag, LoopSetting, delay_ticks, required_damping
from hapticbridge.demand.methods import Method
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.kernel.elastic import unstored_energy
from hapticbridge.kernel.record import TickFlag
from hapticbridge.recording import Recording
from hapticbridge.recording.reader import BLOCK
from hapticbridge.report.evidence import Evidence
from hapticbridge.scene.checks import PUMPING, Pump, may_move, pump_powers, unmetered_work
from hapticbridge.scene.contacts import Concern, check_contacts, geom_name, set_as_suggested
from hapticbridge.scene.handle import constraint_rows, mocap_of
from hapticbridge.scene.physics import (
    STEADY_WAY,
    TendonWatch,
    jump_behind,
    storing_flex,
    unstored_words,
)
from hapticbridge.scene.scene import iteration_limit
from hapticbridge.scene.start import constraint_name
from hapticbridge.theory.bounds import NEEDED_SHARE
from hapticbridge.units import format_count, format_energy, format_number

Kind = Literal[
    "method",
    "contact setting",
    "pump",
    "inputs",
    "delay",
    "rate",
    "damping",
    "quantisation",
    "unmetered work",
    "jumping tendon",
    "bottomless flex",
    "constraint",
    "solver",
    "unknown",
]

WINDOW = 0.2
"""Time in s before the moment that the rules inspect: about ten swings of an unstable coupling, and
too short for a hand to change its action."""

MOST = 0.5
"""Share above which a contribution counts as the main one, without unit."""

SAFE_METHOD = "use method 'lossless' or 'implicit'"
"""Remedy for a method with a hazard."""


@dataclass(frozen=True, slots=True)
class Cause:
    """Likely cause of an active run; not a proof.

    Attributes:
        kind: Name of the cause.
        evidence: Support for it, with numbers.
        remedy: Change that removes it.
    """

    kind: Kind
    evidence: str
    remedy: str


def window_before(evidence: Evidence, report: AuditReport) -> slice | None:
    """Returns the last ``WINDOW`` seconds before the fault; None if the run is not active."""
    if report.verdict != "active" or report.tick is None or report.tick >= len(evidence.ticks):
        return None
    begin = report.tick + 1 - round(WINDOW / evidence.parameters.period)
    return slice(max(0, begin), report.tick + 1)


# Causes of unpaid energy at the device

COUNTED = 2.0
"""Largest step in multiples of the device's resolution, without unit. A smaller step between two
samples comes from the encoder and not from the hand."""

FEWEST_REPEATS = 0.02
"""Share of samples beyond expectation that must repeat an older one to count as a cause, without
unit. One in fifty is jitter between two clocks."""


def cause_at_device(evidence: Evidence, window: slice) -> Cause:
    """Returns the likely cause of unpaid energy at the device."""
    method = evidence.method
    if not method.has_law:
        return _method_cause(method)
    conditions = run_conditions(evidence.info, evidence.worst, method)
    failing = [condition for condition in conditions if condition.is_damped is False]
    if cause := _delay_cause(evidence, failing):
        return cause
    if failing:
        return _overload_cause(evidence, failing)
    if cause := _timing_cause(evidence, window):
        return cause
    if counts := _quantisation_words(evidence, window):
        steps = [each.steps.remedy for each in conditions if each.steps is not None]
        usual = "take a finer encoder or more friction"
        return Cause("quantisation", counts, next(filter(None, steps), usual))
    return _method_cause(method) if method.hazard else _unknown_cause(evidence)


def _method_cause(method: Method, where: str = "") -> Cause:
    return Cause("method", f"{where}method '{method.name}': {method.hazard}", SAFE_METHOD)


def _failing_words(failing: list[DampingCondition]) -> str:
    return "; ".join(
        f"{c.axis}: the device's damping is {c.available:g} {c.unit}, the coupling needs "
        f"{format_number(c.needed)}"
        for c in failing
    )


def _remedies(failing: list[DampingCondition]) -> str:
    return "; and ".join(condition.remedy for condition in failing)


def _delay_cause(evidence: Evidence, failing: list[DampingCondition]) -> Cause | None:
    """Returns a delay as the cause if the device could bear the coupling without it."""
    worst, info = evidence.worst, evidence.info
    late, own = delay_ticks(info, worst.period) or 0, info.damping or 0.0
    prompt = worst.scale * worst.force_scale
    lag = replace(Lag.of(info, worst.period), delay=0.0)
    prompt *= required_damping(worst.coupling, worst.period, worst.law_evaluations, lag=lag)
    if not late or not failing or own < prompt:
        return None
    return Cause(
        "delay",
        f"{format_number(prompt, 3)} N s/m of damping would bear the coupling without delay, the "
        f"device has {format_number(own, 3)}; its samples are {late} ticks old; "
        f"{_failing_words(failing)}",
        f"shorten the delay, or {_remedies(failing)}",
    )


def _overload_cause(evidence: Evidence, failing: list[DampingCondition]) -> Cause:
    """Returns too stiff a spring for the rate, or too strong a damper, as the cause."""
    worst, own = evidence.worst, evidence.info.damping or 0.0
    loop = LoopSetting.of_run(evidence.info, worst, evidence.method)
    damper = loop.ratio("translation") * loop.least_requested.damping
    if failing[0].axis == "translation" and damper > NEEDED_SHARE * own:
        return Cause(
            "damping",
            f"{_failing_words(failing)}; its damper alone needs {format_number(damper)} at any "
            "rate",
            _remedies(failing),
        )
    return Cause(
        "rate", f"{_failing_words(failing)}: it is too stiff for its rate", _remedies(failing)
    )


def _unknown_cause(evidence: Evidence) -> Cause:
    if evidence.info.delay is None:
        return Cause(
            "unknown",
            "damping, deadlines and resolution do not explain it; the device's delay is not known",
            "measure the device with 'hapticbridge identify'",
        )
    return Cause(
        "unknown",
        "damping, delay, deadlines and resolution do not explain it",
        "lower the stiffness, and measure the device with 'hapticbridge identify'",
    )


def _timing_cause(evidence: Evidence, window: slice) -> Cause | None:
    """Returns missed deadlines or repeated samples as the cause; the device bears the coupling.

    Most of the energy must have come beside them.
    """
    flags = evidence.ticks["flags"][window]
    is_late, is_repeated = (
        (flags & int(flag)) != 0 for flag in (TickFlag.OVERRUN, TickFlag.STALE_SAMPLE)
    )
    gained = np.diff(evidence.excess, prepend=0.0)[window].clip(min=0.0)
    span = len(flags) * evidence.parameters.period
    late_share = _share_beside(is_late, gained)
    if late_share >= MOST:
        return Cause(
            "rate",
            f"{late_share:.0%} of the energy came beside ticks that were late by a period or more "
            f"({np.count_nonzero(is_late)} in the {format_number(span, 2)} s before), in each of "
            "which the wrench was held for longer",
            "lower the rate or the load of the machine ('hapticbridge doctor')",
        )
    if _share_beside(is_repeated, gained) < MOST:
        return None
    repeated = float(np.mean(is_repeated))
    # a device slower than the loop repeats each sample until its next one
    own = evidence.info.rate
    expected = max(0.0, 1.0 - own * evidence.parameters.period) if own else 0.0
    if repeated > expected + FEWEST_REPEATS:
        return Cause(
            "delay",
            f"{repeated:.0%} of the samples in the {format_number(span, 2)} s before repeated an "
            f"older one, {expected:.0%} are expected: the force followed an older position of the "
            "handle",
            "mend the link to the device, or lower the rate to what it delivers",
        )
    return None


def _share_beside(marked: NDArray[np.bool_], gained: NDArray[np.float64]) -> float:
    """Returns the share of an energy that came in marked ticks or in those next to them, (n,)."""
    beside = np.convolve(marked, np.ones(3), mode="same")[: len(marked)] > 0.0
    total = float(gained.sum())
    return float(gained[beside].sum()) / total if total > 0.0 else 0.0


def _quantisation_words(evidence: Evidence, window: slice) -> str:
    """Describes encoder steps as the cause; empty if they did not bring most of the energy.

    An unstable coupling passes through small steps too, but gains its energy after the swings have
    grown. So the energy from the window to the worst moment counts.
    """
    info, worst = evidence.info, evidence.worst
    if not info.resolution:
        return ""
    rub = (
        worst.scale
        * info.resolution
        * (worst.coupling.stiffness / 2 + worst.coupling.damping / worst.period)
    )
    if info.friction is not None and info.friction >= rub:
        return ""
    span = slice(window.start, max(window.stop, int(np.argmax(evidence.excess)) + 1))
    gained = np.diff(evidence.excess, prepend=0.0)[span].clip(min=0.0)
    position = evidence.ticks["device_position"]
    moved = np.abs(np.diff(position, axis=0, prepend=position[:1])).max(axis=1)
    steps = moved[span] / info.resolution
    total = float(gained.sum())
    share = float(gained[steps <= COUNTED].sum()) / total if total > 0 else 0.0
    if share < MOST or not math.isfinite(share):
        return ""
    has = "unknown" if info.friction is None else f"{info.friction:g} N"
    return (
        f"{share:.0%} of the energy came in ticks whose motion was {COUNTED:g} steps of the "
        f"device's resolution ({info.resolution:g} m) or less; to hold still between steps takes a "
        f"friction of K D/2 + B_law D/T = {format_number(rub, 3)} N, the device's is {has}"
    )


REPEATED = (Agreement.EXACT, Agreement.NEAR)
"""Agreements of a run whose motion can be simulated again."""


# Geoms that touched while energy was created

Pairs = dict[frozenset[int], float]
"""Share of the energy created while two geoms touched, by pair."""


def touched_pairs(
    evidence: Evidence, report: AuditReport, window: slice, gained: NDArray[np.float64]
) -> Pairs | None:
    """Returns the geoms that touched, those with most energy first; None if unknown.

    A record counts contacts without naming them, so the run is simulated again up to the window.
    ``gained`` is the energy created in each tick of the window, (n,) in J.
    """
    if evidence.model is None:
        return None
    if report.agreement not in REPEATED:
        return None
    total = float(gained.sum())
    found: defaultdict[frozenset[int], float] = defaultdict(float)
    try:
        for run, energy in zip(_runs_in(evidence.recording, window), gained.tolist(), strict=True):
            contact = run.data.contact
            touching = contact.geom[contact.efc_address >= 0].tolist()
            for pair in {frozenset(geoms) for geoms in touching}:
                found[pair] += energy / total if total > 0 else 0.0
    except RecordingError:
        return None
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _runs_in(recording: Recording, window: slice) -> Iterator[Resimulator]:
    """Simulates a run again; yields it after each tick of the window.

    Raises:
        RecordingError: It cannot be simulated.
    """
    run = _run_until(recording, window.start)
    for tick in range(window.start, window.stop):
        run.add(recording.ticks[tick : tick + 1])
        yield run


def _run_until(recording: Recording, end: int) -> Resimulator:
    """Returns a run that was simulated again up to a tick.

    Raises:
        RecordingError: It cannot be simulated.
    """
    run = Resimulator(recording, AuditedRun.of(recording).parameters)
    for begin in range(0, end, BLOCK):
        run.add(recording.ticks[begin : min(begin + BLOCK, end)])
    return run


def _is_behind(
    evidence: Evidence,
    report: AuditReport,
    window: slice,
    *,
    change: Callable[[mujoco.MjModel], None] = lambda _: None,
    events: list[dict[str, Any]] | None = None,
) -> bool:
    """Returns True if the same motion creates less than half of the energy without a suspect.

    Args:
        evidence: The run.
        report: Its audit; a run that was not simulated again there is not here.
        window: Ticks that count; until then the run stays as it was.
        change: Takes the suspect out of the scene.
        events: Events of a run without it; None for the recorded ones.
    """
    if report.agreement not in REPEATED:
        return False
    recording = evidence.recording
    if events is not None:
        recording = replace(recording, events=events)
    try:
        run = _run_until(recording, window.start)
        change(run.model)
        rows = run.add(recording.ticks[window])
    except RecordingError:
        return False
    if len(rows) < window.stop - window.start:  # it was stopped
        return False
    before = float(evidence.created[window.start - 1]) if window.start else 0.0
    left = float(rows["environment_energy"][-1]) - before
    return left < (1.0 - MOST) * _created_in(evidence, window)


def _created_in(evidence: Evidence, window: slice) -> float:
    """Returns the energy in J that the scene created in a window, less what it lost there."""
    before = float(evidence.created[window.start - 1]) if window.start else 0.0
    return float(evidence.created[window.stop - 1]) - before


# Causes of energy created in the environment

FAST_TURN = 0.02
"""Rotation of a body in rad per tick above which its gyroscopic torque is suspected. At 1 kHz, 50
rad/s created 0.05 J in a second under a coupling of translation alone (measured). A smaller value
suspects hands, which turn at 10 rad/s; a larger one misses such cases."""


def cause_in_environment(evidence: Evidence, report: AuditReport, window: slice) -> Cause:
    """Returns the likely cause of energy created in the environment."""
    gained = np.diff(evidence.created, prepend=0.0)[window].clip(min=0.0)
    touches = (evidence.ticks["contacts"] > 0)[window]
    share = float(gained[touches].sum() / gained.sum()) if gained.sum() > 0 else 0.0
    where = f"{share:.0%} of the energy created until then came in ticks with contact"
    pairs = touched_pairs(evidence, report, window, gained) if share >= MOST else None
    share_words = where
    if pairs:
        where += _pair_words(evidence, pairs)
    can_push = _can_push(evidence, pairs, share)
    cause = _inputs_cause(evidence, report, window, gained, where) if can_push else None
    cause = cause or _cause_of_scene(evidence, report, window, gained, where)
    cause = cause or _solver_cause(evidence, report, window, gained)
    cause = cause or _flex_cause(evidence, report, window, gained)
    cause = cause or _jump_cause(evidence, report, window, gained)
    if share >= MOST:
        cause = cause or _contact_cause(evidence, report, window, pairs, share_words)
        where += ", but contacts did little work"
    cause = cause or _constraint_cause(evidence, report, window)
    return cause or _cause_without_contact(evidence, report, window, where)


def _inputs_cause(
    evidence: Evidence,
    report: AuditReport,
    window: slice,
    gained: NDArray[np.float64],
    where: str,
) -> Cause | None:
    """Returns moved mocap bodies as the cause, if little is created where they stand still."""
    moves, work = _moves_in(evidence, window), _input_work(evidence, window)
    if not moves or work <= MOST * float(gained.sum()):
        return None
    if not _is_behind(evidence, report, window, events=_without(moves, evidence.events)):
        return None
    return Cause(
        "inputs",
        f"mocap bodies were moved {len(moves)} times in the {WINDOW:g} s before, and inputs gave "
        f"and took {format_energy(work)}; {where}; MuJoCo damps their contacts and welds against "
        "rest, so a fast move creates energy",
        "move them slower",
    )


ALONE = 3
"""Number of pairs of geoms that are tried as the cause one by one, before all of them. Each takes
another simulation of the run; those with most work come first."""


def _contact_cause(
    evidence: Evidence, report: AuditReport, window: slice, pairs: Pairs | None, where: str
) -> Cause | None:
    """Returns contacts as the cause: those that create little with the settings recommended.

    If none does, it is what contacts did, if their work is most of the energy. If the run cannot be
    simulated again, it is the first concern.
    """
    is_rigid = evidence.parameters.is_rigid  # such contacts do not have those settings
    if pairs is None:
        concerns = [] if is_rigid else _concerns(evidence, None)[:1]
        return _concern_cause(concerns, where) or Cause(
            "unknown",
            f"{where}; which of them did it shows where the run is simulated again",
            "audit it with the versions that recorded it",
        )
    works = _contact_works(evidence, window)
    hardest = sorted(pairs, key=lambda pair: -works.get(pair, 0.0))
    suspects = [pair for pair in hardest if not is_rigid and _concerns(evidence, [pair])]
    for tried in [*([pair] for pair in suspects[:ALONE]), suspects]:
        change = partial(set_as_suggested, pairs=tried)
        if tried and _is_behind(evidence, report, window, change=change):
            named = _pair_words(evidence, {tried[0]: pairs[tried[0]]} | pairs)
            return _concern_cause(_concerns(evidence, tried), where + named)
    where += _pair_words(evidence, pairs) if pairs else ""
    work = sum(works.values())
    if work <= MOST * _created_in(evidence, window):
        return None
    usual = "the contacts are set as recommended"
    if suspects:
        usual = "with the settings recommended they do so, too"
    did = f"{where}; contacts did {format_energy(work)} of work in the {WINDOW:g} s before"
    if evidence.method.hazard:
        return _method_cause(evidence.method, f"{did}; ")
    if is_rigid:
        return Cause("unknown", did, "lower the stiffness, or raise the rate")
    remedy = f"{_rigid_change(evidence.method)}, or lower the stiffness"
    return Cause("unknown", f"{did}; {usual}", remedy)


def _rigid_change(method: Method) -> str:
    """Returns the change of a run with the scene's contacts that makes them rigid."""
    return "leave out --contact scene" if method.can_be_rigid else SAFE_METHOD


def _concern_cause(concerns: Sequence[Concern], where: str) -> Cause | None:
    if not concerns:
        return None
    changes = "; ".join(dict.fromkeys(each.change for each in concerns))
    return Cause("contact setting", f"{where}; {concerns[0].words}", f"write {changes}")


def _contact_works(evidence: Evidence, window: slice) -> dict[frozenset[int], float]:
    """Returns the works in J of contacts in a window, by their geoms."""
    if evidence.model is None:
        return {}
    return _works(evidence.recording, evidence.model, window, _contact_powers)


def _cause_of_scene(
    evidence: Evidence,
    report: AuditReport,
    window: slice,
    gained: NDArray[np.float64],
    where: str,
) -> Cause | None:
    """Returns what the scene itself does beside any contact, if its work is most of the energy.

    This is a pump, or work without a port.
    """
    model, least = evidence.model, MOST * float(gained.sum())
    if model is None or report.agreement not in REPEATED:
        return None
    found = list[tuple[float, Cause]]()
    pump, work = _hardest_pump(evidence.recording, model, window)
    # a motor's work is no creation, until its motion is beyond all measure
    if pump is not None and (pump.kind == "joint" or report.trip is not None):
        found.append((work, _pump_cause(pump, work, where)))
    clauses = unmetered_work(model)
    powers = partial(_unmetered_powers, clauses)
    for name, did in _works(evidence.recording, model, window, powers).items():
        words = f"{clauses[name]}: {format_energy(did)} in the {WINDOW:g} s before; {where}"
        cause = Cause("unmetered work", words, f"remove {name}, or make it weaker")
        found.append((did, cause))
    found = [each for each in found if each[0] > least]
    return max(found, key=lambda each: each[0])[1] if found else None


def _pump_cause(pump: Pump, work: float, where: str) -> Cause:
    did = f"it did {format_energy(work)} of work in the {WINDOW:g} s before"
    return Cause("pump", f"{pump.words}; {did}; {where}", f"write {pump.change}")


def _hardest_pump(
    recording: Recording, model: mujoco.MjModel, window: slice, grips: Sequence[str] = ()
) -> tuple[Pump | None, float]:
    """Returns the pump that did most work in a window, and this work in J.

    Only those count that might move the tools of ``grips`` then; all of them if it is empty.
    """
    powers = pump_powers(model)

    def given(data: mujoco.MjData) -> dict[Pump, float]:
        met = data.contact.geom.tolist()
        return {
            pump: power if may_move(pump, data, grips, met) else 0.0  # it may be infinite
            for pump, power in powers(data).items()
        }

    works = _works(recording, model, window, given)
    pump = max(works, key=lambda each: works[each], default=None)
    return pump, 0.0 if pump is None else works[pump]


def _unmetered_powers(names: Iterable[str], data: mujoco.MjData) -> dict[str, float]:
    """Returns the powers in W of what no port meters, by the names of ``unmetered_work``."""
    told = data.qfrc_spring + data.qfrc_damper + data.qfrc_gravcomp
    told += data.qfrc_fluid + data.qfrc_adhesion
    forces = {
        "wind": data.qfrc_fluid,
        "adhesion": data.qfrc_adhesion,
        "plugin": data.qfrc_passive - told,
    }
    return {name: float(forces[name] @ data.qvel) for name in names}


Part = TypeVar("Part")


def _works(
    recording: Recording,
    model: mujoco.MjModel,
    window: slice,
    powers: Callable[[mujoco.MjData], dict[Part, float]],
) -> dict[Part, float]:
    """Returns the work in J of each part of the scene in a window, by its power in each tick.

    It is empty if there is no such part, or the run cannot be simulated again.
    """
    works = defaultdict[Part, float](float)
    if not powers(mujoco.MjData(model)):
        return {}
    try:
        period = AuditedRun.of(recording).parameters.period
        for run in _runs_in(recording, window):
            for part, power in powers(run.data).items():
                works[part] += period * power
    except RecordingError:
        return {}
    return works


def _jump_cause(
    evidence: Evidence, report: AuditReport, window: slice, gained: NDArray[np.float64]
) -> Cause | None:
    """Returns a tendon that jumps as the cause, if its jumps brought most of the energy.

    A jump of length stretches the tendon's spring, or breaks its limit or constraint, without any
    work. Where its moment arms jump, a step takes the force of one side for that of the other.
    """
    model = evidence.model
    if model is None or not model.ntendon:
        return None
    if report.agreement not in REPEATED:
        return None
    watch = TendonWatch(model)
    try:
        jumps = [watch.jumps(run.data) for run in _runs_in(evidence.recording, window)]
    except RecordingError:
        return None
    found = jump_behind(jumps, gained)
    if found is None:
        return None
    tendon, share, jump = found
    name = model.tendon(tendon).name or str(tendon)
    return Cause(
        "jumping tendon",
        f"{share:.0%} of the energy created until then came as the {jump.quantity} of "
        f"tendon '{name}' jumped, by up to {jump.size} in one tick: its way round a geom changed",
        f"write {STEADY_WAY}",
    )


def _solver_cause(
    evidence: Evidence, report: AuditReport, window: slice, gained: NDArray[np.float64]
) -> Cause | None:
    """Returns the solver as the cause, if it creates little with more iterations."""
    model, total = evidence.model, float(gained.sum())
    if model is None or total <= 0.0:
        return None
    limit = iteration_limit(model, is_rigid=evidence.parameters.is_rigid)
    unfinished = evidence.ticks["solver_iterations"][window] >= limit
    share = float(gained[unfinished].sum()) / total
    change = partial(_iterate, limit=10 * limit)
    if share < MOST or not _is_behind(evidence, report, window, change=change):
        return None
    return Cause(
        "solver",
        f"{share:.0%} of the energy created until then came in ticks in which MuJoCo's solver "
        f"stopped at its limit of {format_count(limit, 'iteration')}: its forces are not those of "
        "the contacts and constraints",
        f'write <option iterations="{10 * limit}">',
    )


def _iterate(model: mujoco.MjModel, limit: int) -> None:
    model.opt.iterations = limit


def _flex_cause(
    evidence: Evidence, report: AuditReport, window: slice, gained: NDArray[np.float64]
) -> Cause | None:
    """Returns a flex as the cause, if most of the energy is what it gave without storing it."""
    model = evidence.model
    if model is None or not model.nflex:
        return None
    if report.agreement not in REPEATED:
        return None
    try:
        whole = slice(max(window.start - 1, 0), window.stop)
        sums = [
            unstored_energy(run.binding.state[0]) for run in _runs_in(evidence.recording, whole)
        ]
    except RecordingError:
        return None
    given = sums[-1] - (sums[0] if window.start else 0.0)
    if given <= MOST * float(gained.sum()):
        return None
    step = evidence.parameters.period / evidence.parameters.substeps
    return Cause("bottomless flex", unstored_words(model, given), storing_flex(model, step))


def _constraint_cause(evidence: Evidence, report: AuditReport, window: slice) -> Cause | None:
    """Returns a soft equality or limit as the cause, if its work is most of the energy.

    MuJoCo's own constraint is a spring, whose energy no meter knows.
    """
    model, parameters = evidence.model, evidence.parameters
    if model is None or parameters.is_rigid:
        return None
    if report.agreement not in REPEATED:
        return None
    works = _works(evidence.recording, model, window, _constraint_powers)
    name = max(works, key=lambda each: works[each], default="")
    if not name or works[name] <= MOST * _created_in(evidence, window):
        return None
    return Cause(
        "constraint",
        f"{name} did {format_energy(works[name])} of work in the {WINDOW:g} s before: with the "
        "scene's own contacts it is a spring, whose energy no meter knows",
        f"{_rigid_change(evidence.method)}: rigid contacts hold it without a spring",
    )


def _constraint_powers(data: mujoco.MjData) -> dict[str, float]:
    """Returns the powers in W of equalities, dry friction and limits, by their names.

    They are f·(J q̇), with the forces f and rows J of a step and the mean q̇ of its speeds.
    """
    powers, found = _row_powers(data), {"": 0.0}
    for row in np.flatnonzero(~_is_contact(data)).tolist():
        name = constraint_name(data.model, data, row)
        found[name] = found.get(name, 0.0) + float(powers[row])
    return found


def _contact_powers(data: mujoco.MjData) -> dict[frozenset[int], float]:
    """Returns the powers in W of contacts by their geoms, as ``_constraint_powers``."""
    powers, found = _row_powers(data), {frozenset[int](): 0.0}
    for row in np.flatnonzero(_is_contact(data)).tolist():
        pair = frozenset(data.contact.geom[data.efc_id[row]].tolist())
        found[pair] = found.get(pair, 0.0) + float(powers[row])
    return found


def _row_powers(data: mujoco.MjData) -> NDArray[np.float64]:
    speeds = data.qvel - 0.5 * data.model.opt.timestep * data.qacc
    return np.asarray(data.efc_force * (constraint_rows(data) @ speeds))


def _is_contact(data: mujoco.MjData) -> NDArray[np.bool_]:
    first = mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS.value
    return np.asarray(data.efc_type >= first)


def _cause_without_contact(
    evidence: Evidence, report: AuditReport, window: slice, where: str
) -> Cause:
    method, turned = evidence.method, _largest_turn(evidence, window)
    if method.hazard:
        return _method_cause(method, f"{where}; ")
    body = _faster_body(evidence, report, window, max(2.0 * turned, FAST_TURN))
    what, turned = body or ("the tool", turned)
    if turned > FAST_TURN:
        return Cause(
            "rate",
            f"{where}; {what} turned by up to {format_number(turned, 2)} rad a tick "
            f"({format_number(turned / evidence.parameters.period, 3)} rad/s), and MuJoCo "
            "takes forces of such a motion from the start of a step, which may create it",
            f"raise the rate, or turn {what} slower",
        )
    return Cause(
        "unknown",
        f"{where}; method '{method.name}' is not known to create energy without contact",
        "look for a joint or motor that pumps with 'hapticbridge check SCENE', or try a higher "
        "rate with 'hapticbridge audit FILE --what-if rate=…'",
    )


def _largest_turn(evidence: Evidence, window: slice) -> float:
    """Returns the tool's largest rotation in one tick, in rad."""
    quaternion = evidence.ticks["tool_quaternion"][max(window.start - 1, 0) : window.stop + 1]
    return float(
        np.linalg.norm(turn_between(quaternion[:-1], quaternion[1:]), axis=1).max(initial=0.0)
    )


def _faster_body(
    evidence: Evidence, report: AuditReport, window: slice, turned: float
) -> tuple[str, float] | None:
    """Returns the body that turned most in a tick, and by how many rad, if more than ``turned``."""
    model = evidence.model
    if model is None or report.agreement not in REPEATED:
        return None
    try:
        speeds = [
            np.linalg.norm(r.data.cvel[:, :3], axis=1) for r in _runs_in(evidence.recording, window)
        ]
    except RecordingError:
        return None
    largest = np.nan_to_num(np.max(speeds, axis=0)) * evidence.parameters.period
    body = int(np.argmax(largest))
    if largest[body] <= turned:
        return None
    return f"body '{model.body(body).name or body}'", float(largest[body])


def _pair_words(evidence: Evidence, pairs: Pairs) -> str:
    pair, share = next(iter(pairs.items()))
    if evidence.model is None:
        return ""
    touching = " touched ".join(geom_name(evidence.model, geom) for geom in sorted(pair))
    others = format_count(len(pairs) - 1, "other pair")
    more = f" ({others} touched, too)" if len(pairs) > 1 else ""
    return f", {share:.0%} while {touching}{more}"


def _concerns(evidence: Evidence, pairs: Collection[frozenset[int]] | None) -> list[Concern]:
    """Returns concerns about the contacts that touched; about all contacts if unknown."""
    if evidence.model is None:
        return []
    return check_contacts(evidence.model, evidence.parameters.grip, only=pairs)


def _can_push(evidence: Evidence, pairs: Pairs | None, share: float) -> bool:
    """Returns True if a mocap body was tied to or touched anything while energy was created."""
    model = evidence.model
    if model is None or any(mocap_of(model, i) for i in np.flatnonzero(model.eq_active0).tolist()):
        return True
    if share < MOST or pairs is None:
        return share >= MOST
    is_driven = model.body_mocapid[model.body_rootid[model.geom_bodyid]] >= 0
    return any(is_driven[geom] for pair in pairs for geom in pair)


def _moves_in(evidence: Evidence, window: slice) -> list[dict[str, Any]]:
    """Returns the inputs of a window that moved mocap bodies."""
    return [
        event
        for event in evidence.events
        if event.get("event") == "input"
        and isinstance(event.get("tick"), int)
        and window.start <= event["tick"] < window.stop
        and "mocap_" in str(event.get("writes"))  # a damaged event may have any shape
    ]


def _without(moves: list[dict[str, Any]], events: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the events of a run whose mocap bodies stay in place instead of some moves."""
    return [
        event | {"writes": [w for w in event["writes"] if not str(w[0]).startswith("mocap_")]}
        if any(event is move for move in moves)
        else event
        for event in events
    ]


def _input_work(evidence: Evidence, window: slice) -> float:
    """Returns the energy in J that the scene's inputs gave and took in a window, both as one sum.

    The energy that a moved body creates is an error of this work.
    """
    work = evidence.ticks["external_work"]
    return float(np.abs(np.diff(work, prepend=0.0))[window].sum())


# Search for the likely cause

MUCH_MORE = 10.0
"""Growth of the excess in a window, relative to that before the fault, from which on the window is
searched for a larger cause; no unit."""

MEASURED: tuple[Kind, ...] = (
    *("contact setting", "pump", "inputs", "unmetered work"),
    *("jumping tendon", "bottomless flex", "constraint", "solver"),
)
"""Causes that are named by what they did, and that a fling by another one cannot pretend."""


def _cause_of_most(evidence: Evidence, report: AuditReport, window: slice) -> Cause:
    """Returns the cause of the fault, or of a window that brought much more, if it is another."""
    first = cause_in_environment(evidence, report, window)
    energy, allowed = evidence.judged(report)
    excess = np.concatenate([np.zeros(1), energy - allowed])
    begins = np.maximum(np.arange(len(excess)) - round(WINDOW / evidence.parameters.period), 0)
    growths = excess - excess[begins]
    end = int(np.argmax(growths))
    if end <= window.stop or growths[end] < MUCH_MORE * growths[window.stop]:
        return first
    larger = cause_in_environment(evidence, report, slice(int(begins[end]), end))
    if larger.kind not in MEASURED or (larger.kind, larger.remedy) == (first.kind, first.remedy):
        return first
    when = f"most came in the {WINDOW:g} s before {evidence.time[end - 1]:.3f} s"
    return replace(larger, evidence=f"{when}: {larger.evidence}")


@dataclass(frozen=True, slots=True)
class Excess:
    """Energy of an active run beyond its bound.

    Attributes:
        time: Time in s from which on it is above zero.
        worst: Its largest value in J.
        worst_tick: Tick of the largest value.
        worst_time: Time in s of that tick.
        cause: Likely cause of it.
    """

    time: float
    worst: float
    worst_tick: int
    worst_time: float
    cause: Cause


def excess_of(
    evidence: Evidence, report: AuditReport, *, in_process: bool = False
) -> Excess | None:
    """Returns the excess of an active run; None for any other run, and for one of several hands.

    ``in_process`` is as for ``likely_cause``.
    """
    if evidence.recording.has_several_hands:
        return None
    cause = likely_cause(evidence, report, in_process=in_process)
    if cause is None or report.tick is None:
        return None
    energy, allowed = evidence.judged(report)
    worst = int(np.argmax(energy - allowed))
    return Excess(
        time=float(evidence.time[report.tick]),
        worst=float((energy - allowed)[worst]),
        worst_tick=int(evidence.ticks["tick"][worst]),
        worst_time=float(evidence.time[worst]),
        cause=cause,
    )


def likely_cause(
    evidence: Evidence, report: AuditReport, *, in_process: bool = False
) -> Cause | None:
    """Returns the likely cause of an active run; None for any other run.

    The scene is compiled and simulated in a child process (``confinement``), unless ``in_process``.
    """
    window = window_before(evidence, report)
    if window is None:
        return None
    if report.port == "device":
        return cause_at_device(evidence, window)
    try:
        return _cause_in_scene(
            evidence.recording,
            lambda model: _cause_of_most(replace(evidence, model=model), report, window),
            in_process,
        )
    except HapticBridgeError:
        return cause_in_environment(evidence, report, window)


def pump_behind_trip(
    recording: Recording, report: AuditReport, *, in_process: bool = False
) -> Cause | None:
    """Returns a part of the scene that pumped before a trip as its likely cause; None without one.

    An active run has a cause of its own (``likely_cause``). A run of several hands has none, nor a
    trip for a fault of the device. ``in_process`` is as for ``likely_cause``.
    """
    trip = None if report.verdict == "active" else report.trip
    if trip is None or not trip.may_be_pumped or recording.hands > 1:
        return None
    if report.agreement not in REPEATED:
        return None
    parameters, end = AuditedRun.of(recording).parameters, recording.count
    window = slice(max(0, end - round(WINDOW / parameters.period)), end)
    grips = () if trip.is_unsound else (parameters.grip,)

    def found(model: mujoco.MjModel) -> Cause | None:
        pump, work = _hardest_pump(recording, model, window, grips)
        if pump is None or work <= PUMPING * WINDOW:
            return None
        return _pump_cause(pump, work, trip.words)

    try:
        return _cause_in_scene(recording, found, in_process)
    except HapticBridgeError:
        return None


def _cause_in_scene(
    recording: Recording, found: Callable[[mujoco.MjModel], Cause | None], in_process: bool
) -> Cause | None:
    """Returns the cause that a function finds in the recorded scene, in a child process.

    Raises:
        HapticBridgeError: The scene cannot be compiled, or not within its limits.
    """
    parameters = AuditedRun.of(recording).parameters

    def work(worker: Worker) -> object:
        model = compile_recorded(recording).model
        worker.allow_run()
        cause = found(model)
        return cause and asdict(cause)

    what = f"the scene of '{recording.path}'"
    told = in_bounds(work, what, trusted=in_process, **bounds_for(recording, parameters))
    return Cause(**told) if told else None
