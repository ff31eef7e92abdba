"""Speed against accuracy: every way to simulate a scene on one picture."""

from hapticbridge.study.chart.catalogue import Extent as Extent
from hapticbridge.study.chart.catalogue import open_workload as open_workload
from hapticbridge.study.chart.chart import Chart as Chart
from hapticbridge.study.chart.chart import measure_chart as measure_chart
from hapticbridge.study.chart.engine_run import peer_settings as peer_settings
from hapticbridge.study.chart.files import ChartFiles as ChartFiles
from hapticbridge.study.chart.files import prepared_files as prepared_files
from hapticbridge.study.chart.files import write_chart as write_chart
from hapticbridge.study.chart.selection import chosen_methods as chosen_methods
from hapticbridge.study.chart.selection import chosen_periods as chosen_periods
from hapticbridge.study.chart.selection import settings_for as settings_for
