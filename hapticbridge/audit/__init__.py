"""The verdict on a recording, from the recording alone. Never imports the bridge.

``ask`` is what is called; read ``verdict`` first. It asks three things: is the file whole
(``structure``), do its numbers agree with their second computation in plain NumPy (``balance``,
held against them in ``physics`` and judged in ``judgement``), and does the scene do the same again
(``replay``, ``rerun``, ``attached_scene``). The second computation goes block by block
(``reached``): ``law`` is the coupling's, ``watched``, ``controlled``, ``limited`` and ``guarded``
are the guard's, ``device_port`` what the device was given. ``interventions`` and ``ending`` read
the events; ``report`` is what comes out.
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
