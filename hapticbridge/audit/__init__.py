"""Verdict on a recording, from the recording alone; never imports the bridge.

Read ``verdict`` first: the result, and the function decide(), which alone names the verdict. The
audit checks that the file is whole (``structure``), computes the energies again in plain NumPy
(``energy``), checks the wrench against the coupling law (``motion``, ``spring``) and the guard's
limits (``wrench_limits``), the time that the run kept (``timing``), that no part contradicts
another (``agreement``), and simulates the scene again (``replay``). ``events`` holds the external
actions of the run and the state that goes from block to block, ``batch`` audits folders. Heavy
imports are deferred to the first call.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hapticbridge.lazy import lazy_exports

if TYPE_CHECKING:
    from hapticbridge.audit.verdict import AuditReport as AuditReport
    from hapticbridge.audit.verdict import verdict_words as verdict_words
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)


def audit(
    path: str | Path,
    *,
    strict: bool = False,
    accepts_unverified: bool = False,
    in_process: bool = False,
) -> AuditReport:
    """Judges a recording from the file alone.

    The audit checks the structure (checksums, schema, contiguous ticks, finite numbers),
    the wrench against coupling law and guard, energies recomputed from poses and wrenches, and the
    device condition. The scene is compiled from the attached sources, and a re-simulation must
    agree bit for bit. A run that cannot be simulated again here, for another version or processor,
    is ``unverified`` instead of passive; ``AuditReport.unchecked`` names the changes that would
    pass. A device port that the device condition does not prove safe is judged by its energy. The
    verdict is ``active`` from the tick at which the device has received more than its damping
    dissipates and scene and coupling release.

    A long file is read four times, block by block: checksums and events, structure, second
    computation, re-simulation. One of up to two minutes at 1 kHz is read once. Beyond that memory
    grows only with the number of events.

    Args:
        path: The recording.
        strict: True accepts only (14) itself, not the slack that the device condition leaves.
        accepts_unverified: True counts ``unverified`` as a success in ``AuditReport.exit_code``.
        in_process: True compiles and simulates in this process, without the limits on memory and
            time that a child process has. It is for recordings of a known origin.

    Raises:
        RecordingError: The file is not a recording.
        ForeignSceneError: Its scene crashed MuJoCo, or takes too much memory or time.
    """
    from hapticbridge.audit.verdict import verdict_on  # noqa: PLC0415 - takes seconds

    return verdict_on(
        path,
        strict=strict,
        accepts_unverified=accepts_unverified,
        in_process=in_process,
    )
