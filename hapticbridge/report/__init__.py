"""Plots and HTML pages of a recorded run.

Read ``page`` first. It shows the facts of a run and its ``evidence``, drawn by ``plots``.
``cause`` names the likely cause of an active run and its remedy.
"""

from hapticbridge.report.page import check_page_name as check_page_name
from hapticbridge.report.page import telling_time as telling_time
from hapticbridge.report.page import write_report as write_report
from hapticbridge.report.plots import draw_recording as draw_recording
from hapticbridge.report.plots import plot_recording as plot_recording
