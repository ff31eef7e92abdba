"""Repetition of a recorded run through a changed bridge.

The package runs the bridge and the audit. The audit judges all runs alike, so it never imports the
bridge. Read ``what_if`` first. It takes a run apart (``recorded``), applies changed ``settings``
and runs it again with the recorded motion or with a model of the recorded hand
(``replayed_hand``). ``page`` presents the outcome.
"""

from hapticbridge.whatif.page import draw_what_if as draw_what_if
from hapticbridge.whatif.page import write_what_if as write_what_if
from hapticbridge.whatif.settings import changes_from as changes_from
from hapticbridge.whatif.what_if import WhatIf as WhatIf
from hapticbridge.whatif.what_if import WhatIfRun as WhatIfRun
from hapticbridge.whatif.what_if import what_if as what_if
from hapticbridge.whatif.what_if import what_ifs as what_ifs
