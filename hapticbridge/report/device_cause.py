"""Likely cause of unpaid energy at the device, by rules on the records and the run's settings."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hapticbridge.demand.certificate import DampingCondition, run_conditions
from hapticbridge.demand.loop_setting import Lag, LoopSetting, delay_ticks, required_damping
from hapticbridge.kernel.record import TickFlag
from hapticbridge.report.cause import MOST, Cause, method_cause
from hapticbridge.report.evidence import Evidence
from hapticbridge.theory.bounds import NEEDED_SHARE
from hapticbridge.units import format_number

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
        return method_cause(method)
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
    return method_cause(method) if method.hazard else _unknown_cause(evidence)


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
