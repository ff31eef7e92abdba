"""Causes of unpaid energy at the device."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hapticbridge.certificate import Condition, needed_damping, run_conditions
from hapticbridge.device.lateness import delay_ticks, felt_period
from hapticbridge.report.cause import MOST, SAFE_METHOD, Cause
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.remedy import what_would_do
from hapticbridge.tick import TickFlag

COUNTED = 2.0
"""Largest step in multiples of the device's resolution, without unit. A smaller step between two
samples comes from the encoder and not from the hand."""

FEWEST_REPEATS = 0.02
"""Share of samples beyond expectation that must repeat an older one to count as a cause, without
unit. One in fifty is jitter between two clocks."""


def cause_at_device(evidence: Evidence, window: slice) -> Cause:
    """Returns the likely cause of unpaid energy at the device."""
    method = evidence.method
    hazard = Cause("method", f"method '{method.name}': {method.hazard}", SAFE_METHOD)
    if not method.has_law:
        return hazard
    conditions = run_conditions(evidence.info, evidence.worst, method)
    failing = [condition for condition in conditions if condition.holds is False]
    if found := _delay_cause(evidence, failing):
        return found
    if not failing and (found := _timing_cause(evidence, window)):
        return found
    if counts := _quantisation_words(evidence, window):
        others = f", or {what_would_do(evidence)}" if failing else ""
        return Cause("quantisation", counts, f"take a finer encoder or more friction{others}")
    if failing:
        return _overload_cause(evidence, failing)
    return hazard if method.hazard else _unknown_cause(evidence)


def _failing_words(failing: list[Condition]) -> str:
    return "; ".join(
        f"{c.axis}: the device's damping is {c.available:g} {_UNITS[c.axis]}, the coupling needs "
        f"{c.needed:.4g}"
        for c in failing
    )


_UNITS = {"translation": "N s/m", "rotation": "N m s/rad"}


def _delay_cause(evidence: Evidence, failing: list[Condition]) -> Cause | None:
    """Returns a delay as the cause if the device could bear the coupling without it."""
    worst, info = evidence.worst, evidence.info
    late, own = delay_ticks(info, worst.period) or 0, info.damping or 0.0
    prompt = worst.scale * worst.force_scale
    prompt *= needed_damping(worst.coupling, felt_period(info, worst.period), worst.laws)
    if not late or not failing or own < prompt:
        return None
    return Cause(
        "delay",
        f"{prompt:.3g} N s/m of damping would bear the coupling without delay, the device has "
        f"{own:.3g}; its samples are {late} ticks old; {_failing_words(failing)}",
        f"shorten the delay, or {what_would_do(evidence, is_late=True)}",
    )


def _overload_cause(evidence: Evidence, failing: list[Condition]) -> Cause:
    """Returns too stiff a spring for the rate, or too strong a damper, as the cause."""
    worst, own = evidence.worst, evidence.info.damping or 0.0
    damper = worst.scale * worst.force_scale * evidence.asked.damping
    if failing[0].axis == "translation" and damper >= own:
        return Cause(
            "damping",
            f"{_failing_words(failing)}; its damper alone needs {damper:.4g} at any rate",
            what_would_do(evidence),
        )
    return Cause(
        "rate", f"{_failing_words(failing)}: it is too stiff for its rate", what_would_do(evidence)
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
    """Returns missed deadlines or repeated samples as the cause; the device bears the coupling."""
    flags = evidence.ticks["flags"][window]
    missed = int(np.count_nonzero(flags & int(TickFlag.OVERRUN)))
    span = len(flags) * evidence.parameters.period
    if missed:
        return Cause(
            "rate",
            f"ticks late by a period or more in the {span:.2g} s before: {missed}, so that the "
            "wrench was held longer than the coupling allows",
            "lower the rate or the load of the machine ('hapticbridge doctor')",
        )
    repeated = float(np.mean((flags & int(TickFlag.STALE_SAMPLE)) != 0))
    # a device slower than the loop repeats each sample until its next one
    own = evidence.info.rate
    expected = max(0.0, 1.0 - own * evidence.parameters.period) if own else 0.0
    if repeated > expected + FEWEST_REPEATS:
        return Cause(
            "delay",
            f"{repeated:.0%} of the samples in the {span:.2g} s before repeated an older one, "
            f"{expected:.0%} are expected: the force followed an older position of the handle",
            "mend the link to the device, or lower the rate to what it delivers",
        )
    return None


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
    span = slice(window.start, max(window.stop, int(np.argmax(evidence.kicked)) + 1))
    gained = np.diff(evidence.kicked, prepend=0.0)[span].clip(min=0.0)
    steps = _largest_steps(evidence.ticks["device_position"], span) / info.resolution
    total = float(gained.sum())
    share = float(gained[steps <= COUNTED].sum()) / total if total > 0 else 0.0
    if share < MOST or not math.isfinite(share):
        return ""
    has = "unknown" if info.friction is None else f"{info.friction:g} N"
    return (
        f"{share:.0%} of the energy came in ticks whose motion was {COUNTED:g} steps of the "
        f"device's resolution ({info.resolution:g} m) or less; to hold still between steps takes a "
        f"friction of K D/2 + B' D/T = {rub:.3g} N, the device's is {has}"
    )


def _largest_steps(position: NDArray[np.float64], span: slice) -> NDArray[np.float64]:
    """Returns the largest step of any axis into each tick, in m; 0 for the first tick."""
    before = position[max(span.start - 1, 0) : span.stop]
    steps = np.abs(np.diff(before, axis=0)).max(axis=1, initial=0.0)
    missing = span.stop - span.start - len(steps)
    return np.concatenate([np.zeros(missing), steps])
