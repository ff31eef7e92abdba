"""Measurement, findings and verdict."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from hapticbridge.clock import period_of
from hapticbridge.device.silence import SHORTEST_WATCHDOG
from hapticbridge.doctor import cyclictest
from hapticbridge.doctor.machine import Finding, System, findings
from hapticbridge.doctor.wakeups import Wakeups, bare_turn, clock_turn
from hapticbridge.errors import HapticBridgeError
from hapticbridge.realtime import (
    Lateness,
    current_priority,
    memory_at_rest,
    real_time,
    stolen_time,
)

LATE_SHARE = 0.25
"""Allowed lateness of a tick as a share of the period, without unit. The default coupling uses 80 %
of the bound, so the hold may last T/0.8 = 1.25 T before the condition b >= KT/2 + B' fails."""

FEW_MISSED = 1e-4
"""Share of missed deadlines up to which the verdict is fair: one in 10 s at 1 kHz."""

SHORTEST, LONGEST = 1.0, 3600.0
"""Range of the duration in s. Percentiles of a shorter run mean nothing; an hour is the longest
wait."""

TURN = 1.0
"""Length of one turn in s. The loops take turns, so that a disturbance affects all of them."""

BASELINE = "cyclictest"


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Result of a diagnosis.

    Attributes:
        rate: Rate in Hz.
        lateness: Lateness by loop: ``bridge``, ``bare sleep`` and, if it ran, ``cyclictest``.
        findings: Findings about the system.
        verdict: ``fit``, ``fair`` or ``unfit``.
        sentence: The verdict with reason and advice.
    """

    rate: float
    lateness: dict[str, Lateness]
    findings: tuple[Finding, ...]
    verdict: str
    sentence: str


def diagnose(
    rate: float = 1000.0,
    duration: float = 20.0,
    system: System | None = None,
    tell: Callable[[float, float], None] = lambda _done, _whole: None,
) -> Diagnosis:
    """Measures this machine.

    The duration in s, 1 to 3600, is shared by the loops. ``tell`` is called with the time done and
    the whole time, in s.

    Raises:
        HapticBridgeError: Rate or duration is out of range.
    """
    if not (math.isfinite(duration) and SHORTEST <= duration <= LONGEST):
        raise HapticBridgeError(
            f"duration is {duration!r} s; it must be {SHORTEST:g} to {LONGEST:g}"
        )
    period_ns = round(period_of(rate) * 1e9)
    bridge, bare, baseline = Wakeups("bridge"), Wakeups("bare sleep"), Wakeups(BASELINE)
    machine = system or System()
    before = stolen_time(machine.proc)
    with memory_at_rest() as at_rest:
        with real_time():
            priority = current_priority()
        is_locked = all(grant.is_granted for grant in at_rest)
        refused = cyclictest.refusal(priority, locks_memory=is_locked)
        loops = [bridge, bare] + ([] if refused else [baseline])
        rounds = max(1, round(duration / (TURN * len(loops))))
        ticks = max(1, round(duration / (rounds * len(loops)) * 1e9 / period_ns))
        for turn in range(rounds):
            bare.add(*bare_turn(period_ns, ticks))
            with real_time() as granted:
                bridge.add(*clock_turn(period_ns, ticks))
            if not refused:
                late = cyclictest.run(period_ns, ticks, priority, locks_memory=is_locked)
                if isinstance(late, str):
                    refused = late  # no further attempt
                else:
                    baseline.add(late, cyclictest.lateness(period_ns, late).missed)
            tell(duration * (turn + 1) / rounds, duration)
    lateness = {loop.name: loop.lateness() for loop in loops if loop.late_ns}
    stolen = (stolen_time(machine.proc) or 0.0) - (before or 0.0)
    found = findings(machine, at_rest + granted, stolen, duration)
    found += (_baseline_finding("" if BASELINE in lateness else refused),)
    verdict, sentence = judged(lateness, found, rate)
    return Diagnosis(rate, lateness, found, verdict, sentence)


def _baseline_finding(refused: str) -> Finding:
    if not refused:
        return Finding("baseline", None, "cyclictest, a C program, ran in turns with the loop")
    return Finding(
        "baseline",
        None,
        f"no comparison with cyclictest, a C program: {refused}",
        "" if cyclictest.is_there() else cyclictest.INSTALL,
    )


def judged(
    lateness: dict[str, Lateness], found: tuple[Finding, ...], rate: float
) -> tuple[str, str]:
    """Returns the verdict and its sentence.

    ``lateness`` holds at least ``bridge`` and ``bare sleep``.
    """
    bridge, period = lateness["bridge"], 1.0 / rate
    allowed = LATE_SHARE * period
    missed = bridge.missed / (bridge.ticks + bridge.missed)
    # earlier findings matter more; one remedy often serves two findings
    remedies = dict.fromkeys(f.remedy for f in found if f.is_good is False and f.remedy)
    advice = "; ".join(list(remedies)[:2])
    held = f"{rate:g} Hz"
    numbers = f"99.9 % of ticks within {bridge.p999 * 1e6:.0f} µs, {bridge.missed} missed"
    if bridge.p999 <= allowed and bridge.missed == 0:
        rest = f"; better still: {advice}" if advice else "; no change is needed"
        return "fit", f"fit for {held}: {numbers}{rest}"
    if bridge.p99 <= allowed and missed <= FEW_MISSED:
        verdict, words = "fair", f"fair for {held}"
    else:
        verdict, words = "unfit", f"unfit for {held}"
    return verdict, f"{words}: {numbers}; {_cause(lateness, allowed, advice)}{_stall_words(bridge)}"


def _stall_words(bridge: Lateness) -> str:
    """Describes the effect of a long stall on the hand; empty if all were short."""
    if bridge.worst <= SHORTEST_WATCHDOG:
        return ""
    return (
        f"; it stalled for {1e3 * bridge.worst:.0f} ms: meanwhile a device keeps applying its "
        "last force, unless it has a watchdog (see 'hapticbridge devices')"
    )


def _cause(lateness: dict[str, Lateness], allowed: float, advice: str) -> str:
    baseline = lateness.get(BASELINE)
    if baseline is not None and baseline.worst > allowed:
        stalls = (
            f"the machine itself stalls (a C program also woke up to {baseline.worst * 1e6:.0f} µs "
            "late)"
        )
        return f"{stalls}: {advice or 'use another machine, or a lower rate'}"
    if advice:
        return advice
    if lateness["bare sleep"].worst > allowed:
        return "a bare sleep loop was late too: use another machine, or a lower rate"
    return "the other loops were on time: report this as a fault of hapticbridge"
