"""Speed against accuracy: every way to simulate a scene on one picture.

Read ``setting`` (the method of a point), ``workload`` (its task and score) and ``chart`` (points
judged, then timed; workloads by name) first. Most workloads run as a ``scene_run``, and other
engines do the same work as an ``engine_run``. ``output`` recommends, draws and writes.
"""
