"""The audit as it is called: its promise, without what it takes to keep it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hapticbridge.audit.report import AuditReport


def audit(path: str | Path, *, strict: bool = False) -> AuditReport:
    """Judges a recording from the file alone.

    Structure (checksums, schema, contiguous ticks, finite numbers, digest), the wrench against the
    coupling law, energies recomputed from poses and wrenches, the device condition, and, where the
    versions match, a re-simulation that must agree bit for bit. Unless the device condition proves
    the device's port, it is judged by what happened: the verdict is ``active`` from the tick on at
    which the device was given more than its damping burns and scene and coupling give up.

    The file is read block by block, three times: for its digest and events, for its structure, and
    for everything else. So memory does not grow with the recording's length, but for its events.

    Args:
        path: The recording.
        strict: Accept only (14) itself, not the slack that the device condition leaves.

    Raises:
        RecordingError: The file is not a recording at all.
    """
    from hapticbridge.audit.verdict import verdict_on  # noqa: PLC0415 - takes seconds

    return verdict_on(path, strict=strict)
