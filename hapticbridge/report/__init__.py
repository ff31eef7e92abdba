"""Plots and HTML pages of a recorded run.

Read ``page`` first; it draws an ``evidence``. ``lead`` and ``facts`` write its words. ``energies``,
``motion``, ``timing`` and ``moment`` draw its plots with the help of ``panels``; ``curves`` draws a
plot of its own. ``likely`` finds the ``cause`` of an active run: ``at_device`` with a ``remedy`` in
numbers, or ``in_environment`` with the geoms that ``touched``.
"""

from hapticbridge.report.evidence import DRAWABLE as DRAWABLE
from hapticbridge.report.evidence import decimated as decimated
from hapticbridge.report.evidence import draw_recording as draw_recording
from hapticbridge.report.evidence import plot_recording as plot_recording
from hapticbridge.report.page import check_page_name as check_page_name
from hapticbridge.report.page import telling_time as telling_time
from hapticbridge.report.page import write_report as write_report
