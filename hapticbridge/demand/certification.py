"""Verdict on a device after a run: its facts, and the words of all that print it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Any

from hapticbridge.demand.certificate import (
    DampingCondition,
    StepCondition,
    is_run_certified,
    run_conditions,
)
from hapticbridge.demand.methods import Method
from hapticbridge.demand.own_loop import OwnLoopAccount
from hapticbridge.demand.timekeeping import RunTimes, Timekeeping, silence_in
from hapticbridge.device import DeviceInfo
from hapticbridge.kernel.hand_energy import HandEnergy
from hapticbridge.kernel.parameters import UNGUARDED, RunParameters


class Standing(StrEnum):
    """Verdict on a device, and what decides it.

    Attributes:
        CERTIFIED: It bears the coupling, and the run kept its time.
        DAMPING: It has less damping than the coupling needs.
        FRICTION: It has less friction than its encoder's steps need.
        TIME: The run did not keep its time.
        ALARM: The watch for a late or reversed force acted (``timekeeping.Alarm``).
        ENERGY: The hand got energy for which nothing paid.
        TRIPPED: The guard stopped the run.
        DAMPING_UNKNOWN: Its damping is unknown.
        DELAY_UNKNOWN: Its delay is unknown.
        UNPROVED: Nothing proves that it bears the coupling: no law, or axes without a motor.
        NO_HAND: Its motion is prescribed, so there is nothing to certify.
        NO_TICK: The run ended before its first tick.
    """

    CERTIFIED = "certified"
    DAMPING = "damping"
    FRICTION = "friction"
    TIME = "time"
    ALARM = "alarm"
    ENERGY = "energy"
    TRIPPED = "tripped"
    DAMPING_UNKNOWN = "damping unknown"
    DELAY_UNKNOWN = "delay unknown"
    UNPROVED = "unproved"
    NO_HAND = "no hand"
    NO_TICK = "no tick"

    @property
    def verdict(self) -> bool | None:
        """True if certified, False if not, None if not judged."""
        if self is Standing.CERTIFIED:
            return True
        return False if self in (*_BY_CONDITION, *_BY_RUN) else None


_BY_CONDITION = (Standing.DAMPING, Standing.FRICTION)
_BY_RUN = (Standing.TIME, Standing.ALARM, Standing.ENERGY, Standing.TRIPPED)

UNKNOWN_DAMPING = (
    "its damping is unknown; 'hapticbridge identify' measures it, or its class states it in "
    "DeviceInfo(damping=..., delay=...)"
)
"""Reason why a device is not judged, with the next step."""

_NO_HAND = "feels no force, as its motion is prescribed: there is nothing to certify"

_OPEN = {
    Standing.DAMPING_UNKNOWN: UNKNOWN_DAMPING,
    Standing.DELAY_UNKNOWN: "its delay is unknown ('hapticbridge identify' measures it)",
    Standing.UNPROVED: "nothing proves that it bears the coupling",
    Standing.NO_TICK: "the run held no tick",
}


@dataclass(frozen=True, slots=True)
class Certification:
    """Verdict on the device of a hand.

    Attributes:
        standing: The verdict, and what decides it.
        conditions: Device conditions with every tick in time.
        kept: Time that the run kept.
        energy: Energy that the hand got and what paid for it.
        is_borne: True if the device meets its conditions with every tick in time.
        law_evaluations: Evaluations of the law per tick.
        unanswered: Axes of which the probe could not tell the direction, by name.
        own_loop: Account of a loop of the device's own; None without one.
        has_guarantee: True if the rendering method lets no scene create energy.
    """

    standing: Standing
    conditions: tuple[DampingCondition, ...]
    kept: Timekeeping
    energy: HandEnergy
    is_borne: bool
    law_evaluations: int = 1
    unanswered: str = ""
    own_loop: OwnLoopAccount | None = None
    has_guarantee: bool = True

    def to_dict(self) -> dict[str, Any]:
        """Returns standing, time and energy by name, for JSON."""
        return {
            "standing": self.standing.value,
            "timekeeping": asdict(self.kept),
            "hand_energy": asdict(self.energy),
        }

    @property
    def verdict(self) -> bool | None:
        """True if certified, False if not, None if not judged."""
        return self.standing.verdict

    @property
    def is_by_time(self) -> bool:
        """True if late ticks or forces refute a certificate for every tick in time."""
        return self.standing in (Standing.TIME, Standing.ALARM)

    @property
    def answer(self) -> str:
        """Verdict in a table; ``if timely``: no measurement confirms the delay."""
        if self.standing is Standing.NO_HAND:
            return "nothing to certify"
        if self.verdict:
            return "if timely" if self._if else "yes"
        return "not judged" if self.verdict is None else "no"

    @property
    def words(self) -> str:
        """Verdict in a clause; ``reason`` has the cause in full."""
        if self.standing is Standing.NO_HAND:
            return f"the device {_NO_HAND}"
        if self.verdict:
            open_steps = next(self._open_steps, None)
            limits = "" if open_steps is None else f"; its encoder's steps are {open_steps.word}"
            limits += f", but {self.energy.limit}" if self.energy.limit else ""
            limits += self._untold
            lead = "device certified" if self.has_guarantee else "device bears the coupling"
            return f"{lead}{self.kept.clause}: b >= {self._bound}{self._if}{limits}"
        if self.verdict is None:
            return f"device not judged: {_OPEN[self.standing]}{self.kept.slowness}"
        return f"device not certified: {self._cause}"

    @property
    def _open_steps(self) -> Iterator[StepCondition]:
        """Conditions on encoder steps of which step or friction is unknown."""
        steps = (each.steps for each in self.conditions if each.steps is not None)
        return (each for each in steps if each.holds is None)

    @property
    def provisos(self) -> str:
        """Clause on what a certificate takes for granted; empty if all was measured or stated."""
        is_open = next(self._open_steps, None) is not None
        return self._if + (", if its friction holds the encoder's steps" if is_open else "")

    @property
    def _cause(self) -> str:
        """Clause on what refutes the certificate."""
        if self.standing is Standing.TIME:
            return self.kept.cause
        if self.kept.alarm is not None and self.standing is Standing.ALARM:
            return self.kept.alarm.words
        if self.standing is Standing.ENERGY:
            return (self.own_loop and self.own_loop.fault) or self.energy.fault
        if self.standing is Standing.TRIPPED:
            return "the guard stopped the run"
        failed = (each for each in self.conditions if each.holds is False)
        return next(failed).lack(self._bound)

    @property
    def reason(self) -> str:
        """Sentence on what refutes the certificate, with the remedy; empty for a trip."""
        if self.is_by_time:
            alarm = self.kept.alarm
            return "; ".join(filter(None, (self.kept.fault, alarm.sentence if alarm else "")))
        is_told = self.verdict is not False or self.standing is Standing.TRIPPED
        return "" if is_told else self._cause

    @property
    def _bound(self) -> str:
        if any(each.loop_period for each in self.conditions):
            return "K(T + 3t)/2 + B_law in its own loop"
        samples = max((each.ticks_per_sample for each in self.conditions), default=1)
        if samples > 1:
            return f"what one sample in {samples} ticks needs"
        if any(each.delay for each in self.conditions):
            return "what its delay needs"
        count = self.law_evaluations
        return "KT/2 + B_law" if count == 1 else f"what {count} substeps need"

    @property
    def _if(self) -> str:
        """Clause on a delay that no measurement confirms."""
        timed = [each for each in self.conditions if each.unconfirmed_delay is not None]
        return min(timed, key=lambda each: each.unconfirmed_delay or 0.0).clause if timed else ""

    @property
    def _untold(self) -> str:
        """Clause on axes of which the probe could not tell the direction."""
        if not self.unanswered:
            return ""
        return f"; the probe could not tell if the motors of {self.unanswered} push the right way"

    @property
    def fact(self) -> str:
        """Verdict as a value in a table of facts."""
        if self.verdict is None:
            return "not judged"
        if self.verdict:
            return f"bears the coupling{self.kept.clause}{self._if}"
        return "does not bear it" if self.standing in _BY_CONDITION else self._cause

    @property
    def note(self) -> str:
        """Sentence for a reader of a passive run's page."""
        if self.verdict:
            clause = f",{self.kept.clause}" if self.kept.clause else ""
            clause += self._if
            limit = f"; but {self.energy.limit}" if self.energy.limit else ""
            return f"The device bears this coupling, in any hand{clause}{limit}{self._untold}."
        if self.standing is Standing.NO_HAND:
            return f"The device {_NO_HAND}."
        if self.verdict is None:
            slowness = self.kept.slowness
            return f"It is not known if the device bears this coupling in any hand{slowness}."
        if self.standing in _BY_RUN:
            head = "The device is not certified."
        else:
            failed = "; ".join(e.sentence() for e in self.conditions if e.holds is False)
            head = f"The device does not bear this coupling: {failed}."
        return f"{head} This run stayed passive; another one need not."


def certification_of(
    info: DeviceInfo,
    parameters: RunParameters,
    method: Method,
    times: RunTimes,
    energy: HandEnergy,
    own_loop: OwnLoopAccount | None = None,
) -> Certification:
    """Judges the device of a hand by its conditions and by what the run was.

    A run that was not as the conditions assume certifies no device that meets them. ``own_loop`` is
    what a loop of the device's own has reported, whose time then counts.
    """
    conditions = run_conditions(info, parameters, method)
    judged = conditions if method.has_law else ()
    if own_loop is None:
        kept = Timekeeping.from_times(times, parameters, judged, info.rate)
    else:
        own = replace(parameters, period=parameters.loop_period, guarding=UNGUARDED)
        kept = Timekeeping.from_times(own_loop.times(times, parameters.period), own, judged)
        kept = replace(kept, silence=silence_in(times, parameters))
    verdict = is_run_certified(conditions, method)
    if info.is_prescribed:
        standing = Standing.NO_HAND
    elif not times.ticks:
        standing = Standing.NO_TICK
    elif kept.is_kept is False:
        standing = Standing.TIME
    elif kept.alarm:
        standing = Standing.ALARM
    elif verdict is False:
        is_weak = any(each.is_damped is False for each in conditions)
        standing = Standing.DAMPING if is_weak else Standing.FRICTION
    elif verdict is None:
        standing = _open(conditions, method)
    elif energy.fault or (own_loop and own_loop.fault):
        standing = Standing.ENERGY
    else:
        standing = Standing.TRIPPED if times.has_tripped else Standing.CERTIFIED
    return Certification(
        standing,
        conditions,
        kept,
        energy,
        verdict is True,
        parameters.law_evaluations,
        times.unanswered,
        own_loop,
        method.has_guarantee,
    )


def worst_certification(certifications: Sequence[Certification]) -> Certification:
    """Returns that of the hand that decides: not certified, then not judged, then with a limit."""
    ranks = {True: 0, None: 1, False: 2}
    return max(
        certifications,
        key=lambda each: (
            ranks[each.verdict],
            each.energy.unpaid if each.energy.fault else 0.0,
            bool(each.energy.limit),
            bool(each.kept.slowness),
            each.energy.net,
        ),
    )


def _open(conditions: Sequence[DampingCondition], method: Method) -> Standing:
    """Returns what is missing for a verdict on a device."""
    felt = [each for each in conditions if each.is_felt]
    if method.has_coupling and (not conditions or any(e.available is None for e in felt)):
        return Standing.DAMPING_UNKNOWN
    if any(each.delay is None for each in felt):
        return Standing.DELAY_UNKNOWN
    return Standing.UNPROVED
