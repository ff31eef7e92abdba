"""What if: a recorded hand, felt again through a changed bridge.

It stands to the right of both the bridge, which it runs, and the audit, which judges all runs alike
and must never import the bridge.
"""

from hapticbridge.whatif.changes import changes_from as changes_from
from hapticbridge.whatif.outcome import WhatIf as WhatIf
from hapticbridge.whatif.outcome import WhatIfRun as WhatIfRun
from hapticbridge.whatif.page import write_what_if as write_what_if
from hapticbridge.whatif.picture import draw_what_if as draw_what_if
from hapticbridge.whatif.what_if import what_if as what_if
