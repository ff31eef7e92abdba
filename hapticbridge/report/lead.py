"""The first sentences of a page: was it safe, and if not, how much came from where."""

from __future__ import annotations

from hapticbridge.audit import AuditReport
from hapticbridge.quantity import quantity

PLACES = {
    "environment": "environment: the simulated scene, as the tool meets it",
    "device": "device: what the hand holds",
}
"""What a port is, for those who meet it first."""


def lead_sentence(report: AuditReport, worst: float | None) -> str:
    """Returns what to know first of a run.

    Args:
        report: The audit's verdict on it.
        worst: The largest energy beyond what is allowed, in J; None where that cannot be told.
    """
    if report.verdict == "invalid":
        return f"This recording proves nothing: {report.reason}"
    if report.verdict == "active" and worst is not None:
        return _too_much(report, quantity(worst, "J"))
    return report.reason.partition("; ")[0]


def _too_much(report: AuditReport, joules: str) -> str:
    if report.port == "device":
        return f"Not safe: the device was given up to {joules} that nobody put in"
    limit = "the coupling's slack pays for" if report.environment == "active" else "it got"
    return f"Not safe: the scene gave out up to {joules} more than {limit}"


def notes(report: AuditReport) -> list[str]:
    """Returns what goes with the verdict: what stopped the run, what was not checked, the device.

    Args:
        report: The audit's verdict on a run.
    """
    if report.verdict == "invalid":
        return []
    told = report.reason.partition("; ")[2]
    # a run that was passive only because its force was taken away should not look like any other
    return [*([f"{told[:1].upper()}{told[1:]}."] if told else []), *_of_the_device(report)]


def is_warned(report: AuditReport) -> bool:
    """Tells whether a passive run was stopped by the guard, or proves nothing for another hand."""
    return report.verdict == "passive" and (report.certified is False or "trip" in report.events)


def _of_the_device(report: AuditReport) -> list[str]:
    if report.verdict != "passive":
        return []
    if report.certified:
        return ["The device bears this coupling, in any hand."]
    if report.certified is None:
        return ["Whether the device bears this coupling in any hand is not known."]
    return [
        f"The device does not bear this coupling: {'; '.join(report.conditions)}. This run stayed "
        "passive; another one need not."
    ]
