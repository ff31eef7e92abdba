"""Public entry point of the audit; heavy imports are deferred to the first call."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hapticbridge.audit.report import AuditReport


def audit(path: str | Path, *, strict: bool = False) -> AuditReport:
    """Judges a recording from the file alone.

    The audit checks the structure (checksums, schema, contiguous ticks, finite numbers, digest),
    the wrench against coupling law and guard, energies recomputed from poses and wrenches, and the
    device condition. If the versions match, a re-simulation must agree bit for bit. Without a
    re-simulation, ``AuditReport.unchecked`` names the changes that would pass. A device port that
    the device condition does not prove safe is judged by its energy. The verdict is ``active`` from
    the tick at which the device has received more than its damping dissipates and scene and
    coupling release.

    The file is read four times, block by block: digest and events, structure, second computation,
    re-simulation. Memory grows only with the number of events.

    Args:
        path: The recording.
        strict: True accepts only (14) itself, not the slack that the device condition leaves.

    Raises:
        RecordingError: The file is not a recording.
    """
    from hapticbridge.audit.verdict import verdict_on  # noqa: PLC0415 - takes seconds

    return verdict_on(path, strict=strict)
