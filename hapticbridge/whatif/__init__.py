"""What if: a recorded hand, felt again through a changed bridge.

It stands to the right of both the bridge, which it runs, and the audit, which judges all runs alike
and must never import the bridge. Read ``what_if`` first: it takes a run apart (``recorded``, with
its scene ``unpacked`` and its numbers ``exact``), makes ``changes``, and lets it ``repeat`` what
happened: ``again`` with the recorded motion, and with a model hand (``hands``) that has the
recorded hand's ``intent``. The ``outcome`` is told ``side_by_side``, as a ``picture`` or as a
``page``.
"""

from hapticbridge.whatif.changes import changes_from as changes_from
from hapticbridge.whatif.outcome import WhatIf as WhatIf
from hapticbridge.whatif.outcome import WhatIfRun as WhatIfRun
from hapticbridge.whatif.page import write_what_if as write_what_if
from hapticbridge.whatif.picture import draw_what_if as draw_what_if
from hapticbridge.whatif.what_if import what_if as what_if
