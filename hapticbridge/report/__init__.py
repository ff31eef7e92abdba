"""Pictures and pages of a recorded run.

Read ``page`` first: what stands on a page, all of it from ``evidence``. Words come from ``lead``,
the verdict in a sentence, and ``facts``; pictures from ``energies``, ``motion``, ``timing`` and
``moment``, which share ``panels``, and ``curves`` for a picture alone. ``likely`` finds the
``cause`` of an active run: ``at_device``, with a ``remedy`` in numbers, or ``in_environment``, with
what ``touched``.
"""

from hapticbridge.report.curves import DRAWABLE as DRAWABLE
from hapticbridge.report.curves import decimated as decimated
from hapticbridge.report.curves import draw_recording as draw_recording
from hapticbridge.report.curves import plot_recording as plot_recording
from hapticbridge.report.page import check_page_name as check_page_name
from hapticbridge.report.page import telling_time as telling_time
from hapticbridge.report.page import write_report as write_report
