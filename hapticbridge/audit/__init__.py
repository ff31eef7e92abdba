"""Verdict on a recording, from the recording alone; never imports the bridge.

``ask`` is the entry point; read ``verdict`` first. It makes three checks: the file is whole
(``structure``); its numbers agree with a second computation in plain NumPy (``balance``, compared
in ``physics``, judged in ``judgement``); the scene repeats them (``replay``, ``rerun``,
``attached_scene``). The second computation goes block by block (``reached``). ``law`` is the
coupling's; ``watched``, ``controlled``, ``limited`` and ``guarded`` are the guard's;
``device_port`` is the device's energy balance. ``interventions`` and ``ending`` read the events;
``report`` is the result.
"""

from typing import TYPE_CHECKING

from hapticbridge.audit.ask import audit as audit
from hapticbridge.lazy import lazy_exports

if TYPE_CHECKING:
    from hapticbridge.audit.report import AuditReport as AuditReport
    from hapticbridge.audit.report import verdict_words as verdict_words
else:
    __getattr__, __dir__, __all__ = lazy_exports(
        __name__,
        {
            "AuditReport": "hapticbridge.audit.report",
            "verdict_words": "hapticbridge.audit.report",
        },
        present=("audit",),
    )
