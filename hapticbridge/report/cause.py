"""Likely cause of an active run, by rules on the records and the run's settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hapticbridge.audit import AuditReport
from hapticbridge.report.evidence import Evidence

Kind = Literal[
    "method", "contact setting", "inputs", "delay", "rate", "damping", "quantisation", "unknown"
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
