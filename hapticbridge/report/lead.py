"""First sentences of a page."""

from __future__ import annotations

from hapticbridge.audit import AuditReport
from hapticbridge.quantity import quantity

PLACES = {
    "environment": "environment: the simulated scene, as the tool meets it",
    "device": "device: the handle in the hand",
}
"""Descriptions of the ports for readers new to them."""


def lead_sentence(report: AuditReport, worst: float | None) -> str:
    """Returns the main result of a run in one sentence.

    ``worst`` is the largest energy beyond the bound in J; None if unknown.
    """
    if report.verdict == "invalid":
        return f"This recording proves nothing: {report.reason}"
    if report.verdict == "active" and worst is not None:
        return _excess_sentence(report, quantity(worst, "J"))
    return report.reason.partition("; ")[0]


def _excess_sentence(report: AuditReport, joules: str) -> str:
    if report.port == "device":
        return f"Not safe: the device was given up to {joules} that neither hand nor scene put in"
    limit = "the coupling's slack pays for" if report.environment == "active" else "it got"
    return f"Not safe: the scene gave out up to {joules} more than {limit}"


def notes(report: AuditReport) -> list[str]:
    """Returns notes on the verdict: reason of a stop, unchecked parts, and the device condition."""
    if report.verdict == "invalid":
        return []
    remarks = report.reason.partition("; ")[2]
    # a run that was passive only because its force was switched off must not look like any other
    return [*([f"{remarks[:1].upper()}{remarks[1:]}."] if remarks else []), *_device_notes(report)]


def is_warned(report: AuditReport) -> bool:
    """Returns True for a passive run that was stopped or is not certified for any hand."""
    return report.verdict == "passive" and (report.certified is False or "trip" in report.events)


def _device_notes(report: AuditReport) -> list[str]:
    if report.verdict != "passive":
        return []
    if report.certified:
        return ["The device bears this coupling, in any hand."]
    if report.certified is None:
        return ["It is not known if the device bears this coupling in any hand."]
    return [
        f"The device does not bear this coupling: {'; '.join(report.conditions)}. This run stayed "
        "passive; another one need not."
    ]
