"""Pictures and pages of a recorded run."""

from hapticbridge.report.curves import draw_recording as draw_recording
from hapticbridge.report.curves import plot_recording as plot_recording
from hapticbridge.report.page import write_report as write_report
