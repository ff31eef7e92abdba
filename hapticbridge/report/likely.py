"""Search for the likely cause."""

from __future__ import annotations

from hapticbridge.audit import AuditReport
from hapticbridge.report.at_device import cause_at_device
from hapticbridge.report.cause import Cause, window_before
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.in_environment import cause_in_environment


def likely_cause(evidence: Evidence, report: AuditReport) -> Cause | None:
    """Returns the likely cause of an active run; None for any other run."""
    window = window_before(evidence, report)
    if window is None:
        return None
    if report.port == "device":
        return cause_at_device(evidence, window)
    return cause_in_environment(evidence, report, window)
