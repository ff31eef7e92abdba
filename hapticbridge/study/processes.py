"""Processes of a sweep's own: one a core, and none of them outlives the sweep."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from multiprocessing.connection import wait
from typing import Any

from hapticbridge.errors import StudyError
from hapticbridge.signals import holding_interrupts
from hapticbridge.study.workers import Workers, cores

_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
"""Set for the sweep's own processes unless the user did: there is one a core already. With more,
the idle threads of OpenBLAS spin for 0.1 s after every matrix exponential, which is one a
closed-loop run; the map ``contact`` took twice as long."""


class ProcessWorkers(Workers):
    """Processes of this sweep's own, started afresh (spawn).

    A forked process would inherit the locks of the threads that NumPy, MuJoCo and numba start.

    Raises:
        StudyError: The processes cannot start, or cannot import the function.
    """

    def __init__(self, function: Callable[[Any], Any], tasks: int, jobs: int | None = None) -> None:
        self._function = function
        self._count = max(1, min(jobs or cores(), tasks))
        # one task waits behind each that runs, so that no process is ever without work
        super().__init__(self._pool(), depth=2 * self._count)
        self._probe()

    def submit(self, task: Callable[..., Any], *arguments: object) -> Future[Any]:
        """See ``Workers.submit``; a pool starts its processes one by one, as tasks come."""
        # libraries read the environment as they load
        with holding_interrupts(), _environment(_ONE_THREAD):
            return super().submit(task, *arguments)

    def restart(self) -> None:
        """See ``Workers.restart``."""
        self.executor.shutdown(wait=True, cancel_futures=True)
        self.executor = self._pool()
        self._probe()

    def stop(self) -> None:
        """See ``Workers.stop``."""
        self.executor.shutdown(wait=True, cancel_futures=True)

    def close(self) -> None:
        """See ``Workers.close``."""
        self.stop()

    def _pool(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(self._count, context, initializer=_start_process)

    def _probe(self) -> None:
        """Makes sure that a process starts and knows the function, before any point is blamed."""
        try:
            self.submit(callable, self._function).result()
        except (BrokenExecutor, OSError):
            self.close()
            raise StudyError(
                "worker processes end as soon as they start: each imports the module of the "
                "swept function and the main program, so both must be importable files, and a "
                "program must call sweep below `if __name__ == '__main__':`"
            ) from None
        except BaseException:
            self.close()
            raise


@contextlib.contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Sets environment variables that are not set yet, for the processes that start meanwhile."""
    missing = {name: value for name, value in variables.items() if name not in os.environ}
    os.environ.update(missing)
    try:
        yield
    finally:
        for name in missing:
            os.environ.pop(name, None)


def _start_process() -> None:
    """Prepares a worker process: it goes with Ctrl-C, silently, and with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if hasattr(signal, "pthread_sigmask"):
        # held back while it started; one that came meanwhile ends it here
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def _leave_with_parent() -> None:
    """Ends this process when its parent is gone.

    After kill -9 of the parent nobody tells a pool's processes to end, and each holds the pipe
    open on which it waits.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
