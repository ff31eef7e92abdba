"""Pictures and pages of a recorded run."""

from hapticbridge.report.curves import DRAWABLE as DRAWABLE
from hapticbridge.report.curves import decimated as decimated
from hapticbridge.report.curves import draw_recording as draw_recording
from hapticbridge.report.curves import plot_recording as plot_recording
from hapticbridge.report.html import check_page_name as check_page_name
from hapticbridge.report.page import telling_time as telling_time
from hapticbridge.report.page import write_report as write_report
