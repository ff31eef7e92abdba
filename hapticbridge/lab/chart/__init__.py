"""Speed against accuracy: every way to simulate a scene on one picture.

Read ``setting`` (the method of a point), ``score`` (its error) and ``chart`` (points judged, then
timed; workloads by name) first. Workloads run as a ``scene_run``, and other engines do the same
work as an ``engine_run``. ``output`` recommends, draws and writes.
"""
