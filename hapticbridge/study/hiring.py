"""Which workers a sweep gets: an executor that it was given, a cluster, or its own processes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from typing import Any

from hapticbridge.study.cluster import ClusterWorkers
from hapticbridge.study.processes import ProcessWorkers
from hapticbridge.study.workers import Workers


@contextlib.contextmanager
def hired(
    function: Callable[[Any], Any],
    executor: Executor | None,
    scheduler: str | None,
    tasks: int,
    jobs: int | None = None,
) -> Iterator[Workers]:
    """Opens the workers of a sweep and closes those that it opened.

    Raises:
        StudyError: They cannot be had.
    """
    if executor is not None:
        workers = Workers(executor)
    elif scheduler is not None:
        workers = ClusterWorkers(scheduler)
    else:
        workers = ProcessWorkers(function, tasks, jobs)
    try:
        yield workers
    finally:
        workers.close()
