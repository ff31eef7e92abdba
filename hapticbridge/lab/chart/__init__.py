"""Speed against accuracy: every way to simulate a scene on one picture.

Read ``setting`` (the method of a point), ``workload`` (its task and score) and ``chart`` (points
judged, then timed) first. Workloads are in ``catalogue``; most run as a ``scene_run``, and other
engines do the same work as an ``engine_run``. ``output`` recommends, draws and writes. ``work`` is
another question: growth of a tick's time with the content of a scene.
"""

from hapticbridge.lab.chart.catalogue import Extent as Extent
from hapticbridge.lab.chart.catalogue import open_workload as open_workload
from hapticbridge.lab.chart.chart import Chart as Chart
from hapticbridge.lab.chart.chart import measure_chart as measure_chart
from hapticbridge.lab.chart.engine_run import peer_settings as peer_settings
from hapticbridge.lab.chart.output import ChartFiles as ChartFiles
from hapticbridge.lab.chart.output import prepared_files as prepared_files
from hapticbridge.lab.chart.output import write_chart as write_chart
from hapticbridge.lab.chart.setting import chosen_methods as chosen_methods
from hapticbridge.lab.chart.setting import chosen_periods as chosen_periods
from hapticbridge.lab.chart.setting import settings_for as settings_for
