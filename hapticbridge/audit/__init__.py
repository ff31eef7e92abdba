"""Verdict on a recording, from the recording alone; never imports the bridge.

Read ``verdict`` first; its function decide() alone calls a run passive, active or invalid. The
audit checks that the file is whole (``structure``), computes the energies again in plain NumPy
(``energy``), checks the wrench against the coupling law (``motion``) and the guard's limits
(``wrench_limits``), the time that the run kept (``timing``), and simulates the scene again
(``replay``). ``state`` is carried from block to block, ``events`` reads external actions during the
run, ``report`` holds the result, ``batch`` audits folders. ``ask`` is the public entry point.
"""

from typing import TYPE_CHECKING

from hapticbridge.audit.ask import audit as audit
from hapticbridge.lazy import lazy_exports

if TYPE_CHECKING:
    from hapticbridge.audit.report import AuditReport as AuditReport
    from hapticbridge.audit.report import verdict_words as verdict_words
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
