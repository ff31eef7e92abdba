"""Studies: theory and runs, swept, drawn and written down.

Read ``sweep`` first: it applies a function to ``points``, in tasks (``task``) on any ``workers``
(``hiring``: own ``processes``, a ``cluster``), and gives a ``table``; ``results`` keeps what is
done. ``closed_loop``, with ``jitter``, is the run that most sweeps make. On these stand ``maps``
(where methods fail), ``chart`` (speed against accuracy, beside other ``engines``), ``paper`` (Brown
& Colgate, equation by equation), ``theory`` (its pictures) and ``audits`` (many recordings).
Charts and the paper's walk prove their ``folder`` before they compute.
"""

from hapticbridge.study.points import grid as grid
from hapticbridge.study.sweep import sweep as sweep
from hapticbridge.study.table import Interrupted as Interrupted
from hapticbridge.study.table import Table as Table
