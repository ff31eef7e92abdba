"""Speed against accuracy: every way to simulate a scene on one picture.

Read ``setting`` (how a point is simulated), ``workload`` (what) and ``chart`` (every point judged
by its ``score``, then all timed, ``timing``) first. Workloads are in ``catalogue``; most are
``staged`` on a ``scene_run``, and other engines do the same work in an ``engine_run``.
``recommendation`` says what to use; ``files`` writes it all, by ``drawing`` and ``page``.
``work`` is another question: how a tick's time grows with what is in a scene.
"""

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
