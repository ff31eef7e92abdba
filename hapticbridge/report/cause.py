"""Why a run became active: the likeliest of a few known causes, by rule, with its evidence.

The rules look at the records around the moment and at what the run was set to. They are tried in an
order in which the more special one comes first; a cause is likely, not proven.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hapticbridge.audit import AuditReport
from hapticbridge.report.evidence import Evidence

Kind = Literal[
    "method", "contact setting", "inputs", "delay", "rate", "damping", "quantisation", "unknown"
]

WINDOW = 0.2
"""Seconds before the moment that are looked at: some ten swings of an unstable coupling, and less
than a hand needs to do something else."""

MOST = 0.5
"""Share from which on something is called what mostly happened, without unit."""

SAFE_METHOD = "use method 'lossless' or 'implicit'"
"""What helps against a method with a hazard: the two that need no warning."""


@dataclass(frozen=True, slots=True)
class Cause:
    """A likely cause.

    Attributes:
        kind: Its name.
        evidence: What speaks for it, with numbers.
        remedy: What to change.
    """

    kind: Kind
    evidence: str
    remedy: str


def window_before(evidence: Evidence, report: AuditReport) -> slice | None:
    """Returns the ticks that lead to the moment, it among them; None where there was none.

    Args:
        evidence: Of the run.
        report: The audit's verdict on it.
    """
    if report.verdict != "active" or report.tick is None or report.tick >= len(evidence.ticks):
        return None
    begin = report.tick + 1 - round(WINDOW / evidence.parameters.period)
    return slice(max(0, begin), report.tick + 1)
