"""Time that a run really kept, and what the device condition makes of it.

The device condition b >= N, N = K T/2 + B', is computed for ticks each T and a force that acts at
once. A run certifies its device only if it kept its time, which means two things.

1. The condition still holds with three measured averages: the time between new samples T/s, the
   sample jitter j, and the time t_w from sample to write, added to the delay t_d of the device.

       b >= N (1/s + j/T) + N(t_d + t_w) − N(t_d)

   N(t) is what a delay t needs (``theory.bounds.minimum_damping``), N = N(t_d). s is the
   smaller of two shares: deadlines that were kept, and samples that were new. In ticks without a
   new sample the tool moves, so that these ask for m (m − 1) (K T)²/(4 N) more, with one new sample
   in m ticks on average. j is the mean time by which a sample came later after its deadline than
   the one before; 0 if earlier.

2. Samples and forces gave the hand at most ``INSTANT`` in energy beyond the account of the
   condition, at the times that they had (``kernel.timing``, and again ``audit.timing``).

The second bounds what the times gave in this run, for any hand. A late sample pays for itself,
because the handle slips until the springs hold less by what it may have put in
(``kernel.law.charge_lateness``). The first part is therefore more than this run needs; it keeps a
run at a fifth of its rate from being called certified for the whole rate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from hapticbridge.demand.certificate import DampingCondition
from hapticbridge.kernel.hand_energy import INSTANT
from hapticbridge.kernel.parameters import ROUNDING, RunParameters
from hapticbridge.kernel.record import TickFlag
from hapticbridge.theory.bounds import minimum_damping
from hapticbridge.theory.transfer import MAX_DELAY, CouplingGrid
from hapticbridge.units import format_number, format_si

NOT_KEPT = "the run did not keep its time"
SCENE_BEHIND = "behind the device's delay the scene created energy"
TOO_FAR = "tool and handle moved or turned too far from each other within a tick"
"""Words that name the fault of a run; the last where all was in time and no delay
hides what the scene creates."""

_SHAKEN = "the hand jerked it, or shook it faster than 8 Hz"

SLOW_MOTION = 0.95
"""Share of its speed below which a slower scene is felt to be in slow motion, without unit."""

SILENT_PERIODS = 10.0
"""Periods of a slower scene without a result above which the time is named. A late result is usual;
after ten, a hand has met a tool that stands still."""


@dataclass(frozen=True, slots=True)
class RunTimes:
    """Times of a run, from the loop's counters or from a recording.

    Attributes:
        ticks: Number of ticks.
        due: Number of deadlines, with the skipped ones.
        mean_delay: Mean time in s from a sample to its force.
        mean_jitter: Mean time in s by which samples came later than the ones before, 0 for early
            ones; each after its own deadline.
        delay_energy: Largest energy in J that the times may have given to the hand.
        is_realtime: True if real time was requested from the system.
        fresh: Share of the samples due that were new, 0 to 1.
        new_samples: Number of ticks with a new sample.
        flags: Combined flags of the records, or of the watch alone.
        has_tripped: True if the guard stopped the run.
        scene_steps: Results that a scene slower than the loop has given.
        scene_silence: Longest time in s without a new one.
        silence: Longest time in s without a new sample of the device.
        silent_tick: Last tick of that time.
        unanswered: Axes of which the probe could not tell the direction, by name.
        has_created: True if the scene ever gave out more energy than it got.
    """

    ticks: int
    fresh: float
    due: int
    mean_delay: float
    mean_jitter: float
    delay_energy: float
    is_realtime: bool
    new_samples: int
    flags: int = 0
    has_tripped: bool = False
    scene_steps: int = 0
    scene_silence: float = 0.0
    silence: float = 0.0
    silent_tick: int = 0
    unanswered: str = ""
    has_created: bool = False


@dataclass(frozen=True, slots=True)
class Silence:
    """Silence of a device after which the force faded.

    Attributes:
        length: Time in s without a new sample.
        begin: Time in s of the run at which it began.
    """

    length: float
    begin: float

    @property
    def sentence(self) -> str:
        """Length, and time of the run."""
        return (
            f"the device gave no new sample for {format_si(self.length, 's')} (at "
            f"{self.begin:.1f} s), and the force faded"
        )


def silence_in(times: RunTimes, parameters: RunParameters) -> Silence | None:
    """Returns the longest silence of the device after which the force faded; None without one."""
    period, most = parameters.period, parameters.guarding.stale_ticks
    if not most or times.silence <= (most + 0.5) * period:
        return None
    return Silence(times.silence, max((times.silent_tick + 1) * period - times.silence, 0.0))


class Alarm(StrEnum):
    """Finding of the watch for a late or reversed force (``kernel.swing_watch``)."""

    RUNS_AWAY = "runs away"
    SWINGS = "swings"

    @staticmethod
    def of(flags: int) -> Alarm | None:
        """Returns the gravest finding among the flags of a run's records; None without one."""
        for flag, alarm in (
            (TickFlag.RUNS_AWAY, Alarm.RUNS_AWAY),
            (TickFlag.SWINGING, Alarm.SWINGS),
        ):
            if flags & int(flag):
                return alarm
        return None

    @property
    def words(self) -> str:
        """Name of the finding in a clause."""
        return f"its force came late, reversed or in steps, or {_SHAKEN}"

    @property
    def sentence(self) -> str:
        """Action of the watch on the force, and the remedy."""
        if self is Alarm.RUNS_AWAY:
            return (
                "the force was taken away because the device did not move as it was pushed: an "
                "axis is reversed or exchanged (check the axes and signs of the device), the force "
                f"comes very late, or {_SHAKEN}"
            )
        return (
            "the force was lowered because the device swung: it answered late, or in coarse "
            f"steps, an axis is reversed, or {_SHAKEN}; check the signs of its axes, lower "
            "--stiffness, and measure its delay and resolution ('hapticbridge identify')"
        )


MANY_KEPT = 0.95
"""Share of deadlines kept below which a run with real-time priority is told what helps; no unit.
A virtual machine is stopped by its host now and then, and nothing inside it helps."""


FEW = 0.99
"""Share of the samples due that were new below which a rate is proposed that the device keeps; no
unit. Two clocks that differ by a few parts in 10,000 repeat fewer."""


@dataclass(frozen=True, slots=True)
class Timekeeping:
    """Time that a run kept, and the device condition at this time.

    Attributes:
        rate: Ticks with a new sample per second that really happened.
        share: Share of the deadlines that were kept, 0 to 1.
        fresh: Share of the samples due that were new, 0 to 1.
        mean_delay: Mean time in s from a sample to its force.
        mean_jitter: Mean time in s by which samples came later than the ones before.
        delay_energy: Largest energy in J that delays may have given to the hand.
        conditions: Device conditions at these times.
        in_time: The same for ticks and forces in time.
        is_kept: True if all conditions hold and, where all damping is known, the energy is at most
            ``INSTANT``; None if no condition holds even for a run in time.
        is_realtime: True if real time was requested from the system.
        alarm: Finding of the watch for a late or reversed force; None without one.
        scene_rate: Results per second in Hz that a slower scene was to give; None for another.
        scene_speed: Share of them that it gave, 0 to 1.
        shown_rate: Poses per second in Hz that another program showed of its tool; None for another
            scene.
        scene_silence: Longest time in s without a new one.
        silence: Longest silence of the device for which the force faded; None without one.
        sample_rate: New samples per second of a device that gave fewer than were due; 0 for
            another.
        due_rate: New samples per second that were due: those that the device states, or that the
            loop reads if that is less.
        is_rate_stated: True if they are those that the device states.
        has_created: True if the scene ever gave out more energy than it got.
    """

    rate: float
    share: float
    fresh: float
    mean_delay: float
    mean_jitter: float
    delay_energy: float
    conditions: tuple[DampingCondition, ...]
    in_time: tuple[DampingCondition, ...]
    is_kept: bool | None
    is_realtime: bool
    alarm: Alarm | None
    scene_rate: float | None
    scene_speed: float
    shown_rate: float | None
    scene_silence: float
    silence: Silence | None
    sample_rate: float
    due_rate: float
    is_rate_stated: bool
    has_created: bool

    @classmethod
    def from_times(
        cls,
        times: RunTimes,
        parameters: RunParameters,
        conditions: Sequence[DampingCondition],
        stated_rate: float | None = None,
    ) -> Timekeeping:
        """Judges the times of a run by its device conditions; none for a run without a law."""
        rate, stated = 1.0 / parameters.period, stated_rate or math.inf
        is_slow = parameters.scene_ticks > 0 and parameters.credit == 0.0
        share = times.ticks / times.due if times.due > times.ticks else 1.0
        least = min(share, times.fresh)
        silence = silence_in(times, parameters)
        is_felt = parameters.has_law and (not conditions or any(c.is_felt for c in conditions))
        sample_rate = (
            _sample_rate(times, parameters.period, silence is not None) if is_felt else 0.0
        )
        remedy = _OWN_REMEDY if _is_own(conditions) else _remedy(times.is_realtime, sample_rate)
        late = tuple(_at_times(each, parameters, least, times, remedy) for each in conditions)
        verdicts = [each.holds for each in late if each.available is not None]
        is_known = all(each.available is not None for each in conditions if each.is_felt)
        is_paid = times.delay_energy <= INSTANT
        is_borne = bool(verdicts) and all(each.holds is not False for each in conditions)
        return cls(
            rate=least * rate if times.ticks else 0.0,
            share=share,
            fresh=times.fresh,
            mean_delay=times.mean_delay,
            mean_jitter=times.mean_jitter,
            delay_energy=times.delay_energy,
            conditions=late,
            in_time=tuple(conditions),
            is_kept=all(verdicts) and (is_paid or not is_known) if is_borne else None,
            is_realtime=times.is_realtime,
            alarm=Alarm.of(times.flags),
            scene_rate=1.0 / parameters.scene_period if is_slow else None,
            scene_speed=_scene_speed(times, parameters.scene_ticks) if is_slow else 1.0,
            shown_rate=times.scene_steps / (max(times.due, 1) * parameters.period)
            if parameters.credit > 0.0
            else None,
            scene_silence=times.scene_silence,
            silence=silence,
            sample_rate=sample_rate,
            due_rate=min(rate, stated),
            is_rate_stated=stated <= rate * (1.0 + ROUNDING),
            has_created=times.has_created,
        )

    @property
    def words(self) -> str:
        """Effective rate, share of the deadlines, and the mean lateness of samples and forces."""
        lost = "" if self.fresh >= self.share else f", {self._shortfall}"
        late = f", {self._late}" if self._late else ""
        if self.scene_rate is not None:
            speed = f"{format_number(100.0 * self.scene_speed, 3)} % of its speed"
            late += f", the scene at {format_number(self.scene_rate)} Hz and {speed}"
            if self.scene_silence * self.scene_rate > SILENT_PERIODS:
                late += f", once without a result for {format_si(self.scene_silence, 's')}"
        if self.shown_rate is not None:
            late += f", {format_number(self.shown_rate)} poses per second from the program"
            if self.scene_silence > 2.0 / max(self.shown_rate, 1e-9):
                late += f", once none for {format_si(self.scene_silence, 's')}"
        of_what = "new samples at " if lost else ""
        return (
            f"{of_what}{format_number(self.rate)} Hz, {self._percent} of the deadlines "
            f"kept{lost}{late}"
        )

    @property
    def _shortfall(self) -> str:
        """Samples that came and that were due, with the rate that suits the device."""
        counts = (
            f"{format_number(self.fresh * self.due_rate)} of the {format_number(self.due_rate)} "
            "new samples per second"
        )
        counts += " that the device states" if self.is_rate_stated else " that the loop reads"
        if not self.sample_rate or self.slowness:
            return counts
        rate = format_number(self.sample_rate)
        return f"{counts} (--rate {rate}, or rate={rate} in its data sheet, suits it)"

    @property
    def remark(self) -> str:
        """``words`` where the run was not simply in time; else empty."""
        is_exact = self._is_timely and not (self.scene_rate or self.shown_rate)
        return "" if is_exact else self.words

    @property
    def _is_timely(self) -> bool:
        return min(self.share, self.fresh) == 1.0 and not self._late

    @property
    def cause(self) -> str:
        """Clause on what refutes the certificate of a device that bears the coupling in time."""
        if self.silence or not self._is_timely:
            return NOT_KEPT
        return SCENE_BEHIND if self._has_created_behind else TOO_FAR

    @property
    def _has_created_behind(self) -> bool:
        """True if the scene created energy, and a delay lets no slack pay for it."""
        return self.has_created and any(each.delay for each in self.in_time)

    @property
    def _late(self) -> str:
        jitter, delay = format_si(self.mean_jitter, "s"), format_si(self.mean_delay, "s")
        texts = [f"sample times vary by {jitter}"] if self.mean_jitter > 0.0 else []
        texts += [f"forces follow {delay} after the sample"] if self.mean_delay > 0.0 else []
        return ", ".join(texts)

    @property
    def clause(self) -> str:
        """Clause on time after "device certified"; empty if no deadline was missed."""
        return f" while the run kept its time ({self._percent} of it)" if self.share < 1.0 else ""

    @property
    def _percent(self) -> str:
        return f"{min(100.0 * self.share, 99.9):.1f} %" if self.share < 1.0 else "100 %"

    @property
    def remedy(self) -> str:
        """Changes that help a run to keep its time."""
        if _is_own(self.in_time):
            return _OWN_REMEDY
        return _remedy(self.is_realtime, self.sample_rate)

    @property
    def slowness(self) -> str:
        """Clause on a device whose samples come more seldom than it can bear; or empty."""
        if not self.sample_rate or self.is_kept:
            return ""
        return (
            f"; the device gave new samples at {format_number(self.sample_rate)} Hz; in the ticks "
            "between them the handle slips toward the tool, so that the hand feels less force: "
            f"try {self.remedy}"
        )

    @property
    def hint(self) -> str:
        """Sentence that suggests a remedy after missed deadlines or late steps of the scene."""
        if self.scene_speed < SLOW_MOTION * self.share:  # a loop that is late slows the scene, too
            return "the scene runs in slow motion: a lower --scene-rate gives its steps more time"
        if self.share == 1.0 or self.is_kept is False:
            return ""
        if self.is_realtime or _is_own(self.in_time):
            return f"deadlines were missed: try {self.remedy}" if self.share < MANY_KEPT else ""
        return (
            "deadlines were missed, and after each the handle follows the hand in part "
            "('hapticbridge guide missed-deadlines'): --realtime requests the processor for "
            "the loop"
        )

    @property
    def fault(self) -> str:
        """Sentence on the time that was not kept, with the remedy; or empty."""
        if self.is_kept is not False:
            return ""
        given = f"{format_si(self.delay_energy, 'J')}, more than {format_si(INSTANT, 'J')}"
        if self.cause == SCENE_BEHIND:
            return (
                f"{SCENE_BEHIND}, and it may have given the hand {given}, which no slack pays "
                "there; 'hapticbridge check' looks for what creates it"
            )
        if self.cause == TOO_FAR:
            return (
                f"{TOO_FAR}, and the wrench of that tick may have given the hand {given}; check "
                "the device for jumps of its pose, or try less force of what pushes the tool"
            )
        at_times = (
            f"at {format_number(self.rate)} Hz{f' ({self._late})' if self._late else ''} it would "
            "need"
        )
        pairs = zip(self.conditions, self.in_time, strict=True)
        failed = [(late, usual) for late, usual in pairs if late.holds is False]
        if failed:
            late_one, usual = failed[0]
            reason = (
                f"{at_times} {format_number(late_one.needed, 3)} {usual.unit} of damping in "
                f"{usual.axis} ({format_number(usual.needed, 3)} with every tick in time), and has "
                f"{usual.available:.3g}"
            )
        else:
            givers = (
                "late samples and forces, or a tool that moved far from its handle within a tick,"
            )
            givers += " and the scene behind the delay," * self._has_created_behind
            reason = f"{givers} may have given the hand {given}"
        if self.silence and self.share >= MANY_KEPT and not self.sample_rate:
            return f"{NOT_KEPT}: {self.silence.sentence}; check its link and its power ({reason})"
        return f"{NOT_KEPT}: {reason}{self.slowness or f'; try {self.remedy}'}"


def _scene_speed(times: RunTimes, ticks: int) -> float:
    """Returns the share of a slower scene's results that arrived; the newest is not due yet."""
    due = (times.due - 1) // ticks if ticks else 0
    return min(times.scene_steps / due, 1.0) if due > 0 else 1.0


def _sample_rate(times: RunTimes, period: float, was_silent: bool) -> float:
    """Returns the new samples per second in Hz of a device that gave too few; 0 for another.

    A silence for which the force faded does not count. Where many deadlines were missed, the loop
    was slow.
    """
    heard = times.due * period - (times.silence if was_silent else 0.0)
    is_late = times.ticks < MANY_KEPT * times.due
    if is_late or times.fresh * times.due * period >= FEW * heard:
        return 0.0
    return times.new_samples / heard


def _is_own(conditions: Sequence[DampingCondition]) -> bool:
    """Returns True if a loop of the device's own kept the time."""
    return any(each.loop_period is not None for each in conditions)


_OWN_REMEDY = "a lower --stiffness, or less work for the board in each of its periods"


def _remedy(is_realtime: bool, sample_rate: float) -> str:
    if sample_rate:
        return f"--rate {format_number(sample_rate)} with the stiffness left to the run"
    request = "" if is_realtime else "--realtime, "
    return (
        f"{request}a lower --stiffness, a lower --rate with the stiffness left to the run, or what "
        "'hapticbridge doctor' advises"
    )


def _at_times(
    condition: DampingCondition,
    parameters: RunParameters,
    share: float,
    times: RunTimes,
    remedy: str,
) -> DampingCondition:
    """Returns a device condition at a run's share of deadlines kept and mean times."""
    if not condition.is_felt:
        return condition
    coupling = parameters.effective or parameters.coupling
    ratio, k, b = parameters.scale * parameters.force_scale, coupling.stiffness, coupling.damping
    if condition.axis == "rotation":
        ratio = parameters.force_scale / parameters.scale
        k, b = coupling.rotational_stiffness, coupling.rotational_damping
    ticks, period = condition.ticks_per_sample, parameters.period
    needed = condition.needed * (1.0 / share + times.mean_jitter / period)
    if k > 0.0:
        kappa = 0.5 * k / (1.0 + 2.0 * b / (k * period))  # κ/T
        # samples that did not come: the tool moved in the ticks between them
        count = max(times.ticks / times.new_samples, ticks) if times.new_samples else math.inf
        needed += ratio * kappa * period * count * (count - ticks)
        law = CouplingGrid(k, b)

        def at(delay: float) -> float:
            late = delay / period
            if late > MAX_DELAY * ticks:  # beyond what the theory takes
                return math.inf
            return float(minimum_damping(law, period, delay=late, ticks_per_sample=ticks))

        delay = condition.delay or 0.0
        needed += ratio * (at(delay + times.mean_delay) - at(delay))
    at_times = replace(condition, needed=needed)
    if at_times.holds is False and condition.holds is not False:
        return replace(at_times, remedy=remedy)
    return at_times
