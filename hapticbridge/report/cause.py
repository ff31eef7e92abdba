"""Why a run became active: the likeliest of a few known causes, by rule, with its evidence.

The rules look at the records before the moment and at what the run was set to. They are tried in an
order in which the more special one comes first; a cause is likely, not proven.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.certificate import needed_damping, run_conditions
from hapticbridge.device.lateness import delay_ticks, felt_period
from hapticbridge.report.evidence import Evidence
from hapticbridge.scene.contact_check import check_contacts
from hapticbridge.tick import TickFlag

WINDOW = 0.2
"""Seconds before the moment that are looked at: some ten swings of an unstable coupling, and less
than a hand needs to do something else."""

COUNTED = 2.0
"""Resolutions of the device; a step of at most so many between two samples is one of the encoder
and not of the hand."""

MOST = 0.5
"""Share from which on something is called what mostly happened, without unit."""

Kind = Literal["method", "contact setting", "inputs", "delay", "rate", "quantisation", "unknown"]


@dataclass(frozen=True, slots=True)
class Cause:
    """A likely cause.

    Attributes:
        kind: Its name.
        evidence: What speaks for it, with numbers, and what to do.
    """

    kind: Kind
    evidence: str


def likely_cause(evidence: Evidence, report: AuditReport) -> Cause | None:
    """Returns why a run became active; None if it did not.

    Args:
        evidence: Of the run.
        report: The audit's verdict on it.
    """
    if report.verdict != "active" or report.tick is None or report.tick >= len(evidence.ticks):
        return None
    window = slice(
        max(0, report.tick + 1 - round(WINDOW / evidence.parameters.period)), report.tick + 1
    )
    if report.port == "device":
        return _at_the_device(evidence, window)
    return _in_the_environment(evidence, window)


def _in_the_environment(evidence: Evidence, window: slice) -> Cause:
    gained = np.diff(evidence.created, prepend=0.0)[window].clip(min=0.0)
    touches = (evidence.ticks["contacts"] > 0)[window]
    share = float(gained[touches].sum() / gained.sum()) if gained.sum() > 0 else 0.0
    moved = _moved_bodies(evidence, window)
    where = f"{share:.0%} of the energy created before it came in ticks with contact"
    method = evidence.method
    if moved:
        return Cause(
            "inputs",
            f"mocap bodies were moved {moved} times in the {WINDOW:g} s before: MuJoCo damps their "
            "contacts and welds against rest, so a fast move creates energy; move them slower",
        )
    if share < MOST and method.hazard:
        return Cause(
            "method", f"{where}; method '{method.name}': {method.hazard}; 'implicit' does not"
        )
    if share < MOST:
        return Cause(
            "unknown", f"{where}, and method '{method.name}' is not known to create any without"
        )
    concerns = (
        [] if evidence.model is None else check_contacts(evidence.model, evidence.parameters.grip)
    )
    if concerns:
        return Cause("contact setting", f"{where}; {concerns[0]}")
    if method.hazard:
        return Cause(
            "method",
            f"{where}, whose setting is as recommended; method '{method.name}': {method.hazard}",
        )
    return Cause(
        "contact setting",
        f"{where}; a light tool on a stiff coupling is the hard case: lower the stiffness, raise "
        "the rate, or make the contacts softer",
    )


def _moved_bodies(evidence: Evidence, window: slice) -> int:
    return sum(
        event.get("event") == "input"
        and isinstance(event.get("tick"), int)
        and window.start <= event["tick"] < window.stop
        and "mocap_" in str(event.get("writes"))  # as text: a damaged event has any shape
        for event in evidence.events
    )


def _at_the_device(evidence: Evidence, window: slice) -> Cause:
    parameters, info, method = evidence.parameters, evidence.info, evidence.method
    if not method.has_law:
        return Cause("method", f"method '{method.name}': {method.hazard}")
    coupling, own = parameters.coupling, info.damping or 0.0
    period = felt_period(info, parameters.period)
    prompt = (
        parameters.scale
        * parameters.force_scale
        * needed_damping(coupling, period, parameters.laws)
    )
    failing = [c for c in run_conditions(info, parameters, method) if c.holds is False]
    told = "; ".join(condition.sentence() for condition in failing)
    late = delay_ticks(info, parameters.period) or 0
    if late and own >= prompt and failing:
        return Cause(
            "delay",
            f"{prompt:.3g} N s/m of damping would bear the coupling without delay, the device has "
            f"{own:.3g}; its samples are {late} ticks old: {told}",
        )
    flags = evidence.ticks["flags"][window]
    missed = int(np.count_nonzero(flags & int(TickFlag.OVERRUN)))
    if missed and not failing:
        return Cause(
            "rate",
            f"{missed} deadlines were missed in the {WINDOW:g} s before, so that a wrench was held "
            "for longer than the coupling was chosen for; lower the rate or the load",
        )
    counts = _counted(evidence, window)
    if counts is not None:
        return Cause("quantisation", counts)
    if failing:
        return Cause("rate", f"{told}{_rate_that_would_do(evidence, own)}")
    nothing = Cause("unknown", "damping, delay, deadlines and resolution do not explain it")
    return Cause("method", f"method '{method.name}': {method.hazard}") if method.hazard else nothing


def _rate_that_would_do(evidence: Evidence, own: float) -> str:
    """Says at which rate b >= K T/2 + B' would hold in translation, if it does not now."""
    parameters = evidence.parameters
    coupling, scale = parameters.coupling, parameters.scale * parameters.force_scale
    spare = own / scale - coupling.damping
    needed = 0.5 * coupling.stiffness * parameters.period
    if spare >= needed:
        return ""  # translation is not what fails
    if spare <= 0:
        return "; no rate helps, because the damper alone is beyond the device's"
    return f"; at {coupling.stiffness / (2 * spare):.0f} Hz translation would hold"


def _counted(evidence: Evidence, window: slice) -> str | None:
    """Says that the coupling answers single steps of the encoder, if that is what it did."""
    info, coupling = evidence.info, evidence.parameters.coupling
    if not info.resolution:
        return None
    steps = _largest_steps(evidence.ticks["device_position"][window]) / info.resolution
    moving = steps[steps > 0]
    needed = (
        evidence.parameters.scale
        * info.resolution
        * (coupling.stiffness / 2 + coupling.damping / evidence.parameters.period)
    )
    if not moving.size or np.median(moving) > COUNTED or (info.friction or 0.0) >= needed:
        return None
    return (
        f"half of the moves were of {np.median(moving):.2g} steps of the device's resolution "
        f"({info.resolution:g} m) or less, and a friction of K D/2 + B' D/T = {needed:.3g} N is "
        f"needed to hold still between them, the device has {info.friction or 0.0:g} N; lower the "
        "stiffness or the damping"
    )


def _largest_steps(position: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.abs(np.diff(position, axis=0)).max(axis=1, initial=0.0))
