"""Where a sweep's tasks run: own processes, a dask cluster, or any executor.

The three differ in how many tasks to keep in flight and in what happens when a worker dies.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from multiprocessing.connection import wait
from typing import Any

from hapticbridge.errors import StudyError
from hapticbridge.signals import holding_interrupts

_IN_FLIGHT = 64
"""Tasks in flight where the number of workers is not known: more workers than that would idle."""

_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
"""Set for the sweep's own processes unless the user did: there is one a core already. With more,
the idle threads of OpenBLAS spin for 0.1 s after every matrix exponential, which is one a
closed-loop run; the map ``contact`` took twice as long."""

_PATIENCE = 3.0
"""Seconds for a dask scheduler to answer; a local one takes 0.05 s. Shorter refuses a far one."""

_WORKERS_PATIENCE = 5.0
"""Seconds for a dask scheduler to have a worker: one that was just started takes 2 s."""


def cores() -> int:
    """Returns how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class InThisProcess(Executor):
    """Works while it submits: for few tasks, where a process would take longer to start."""

    def submit(self, task: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Does the task; what it raises is the future's."""
        future: Future[Any] = Future()
        try:
            future.set_result(task(*arguments, **named))
        except Exception as error:
            future.set_exception(error)
        return future


class Workers:
    """An executor that somebody else owns.

    Attributes:
        depth: How many tasks to keep in flight.
    """

    def __init__(self, executor: Executor, depth: int = _IN_FLIGHT) -> None:
        self.executor = executor
        self.depth = depth

    def submit(self, task: Callable[..., Any], *arguments: object) -> Future[Any]:
        """Hands one task over.

        Raises:
            BrokenExecutor: A worker died; ``restart`` is next.
            StudyError: The executor takes no more tasks.
        """
        try:
            return self.executor.submit(task, *arguments)
        except BrokenExecutor:
            raise
        except RuntimeError as error:
            raise StudyError(f"the executor takes no tasks: {error}") from None

    def restart(self) -> None:
        """Puts fresh workers in the place of dead ones.

        Raises:
            StudyError: That cannot be done.
        """
        raise StudyError(
            "a worker of the executor died and it takes no more tasks; sweep again with a fresh "
            "one, and a folder to keep what is done"
        )

    def is_death(self, error: BaseException) -> bool:
        """Tells whether a task's error means that its worker died, not that the task is wrong."""
        return isinstance(error, BrokenExecutor)

    def stop(self) -> None:
        """Waits for tasks that cannot be cancelled, where these workers are the sweep's own."""

    def close(self) -> None:
        """Gives back what was opened."""


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


class ClusterWorkers(Workers):
    """The workers of a running dask.distributed cluster.

    Raises:
        StudyError: dask is not installed, no scheduler answers, or it has no workers.
    """

    def __init__(self, scheduler: str) -> None:
        try:
            distributed: Any = importlib.import_module("distributed")
        except ImportError:
            raise StudyError(
                "a scheduler needs dask, which is not installed: "
                "pip install 'hapticbridge[cluster]'"
            ) from None
        try:
            # asked beforehand, because a client that was refused takes 10 s to be given up, and
            # ends in a traceback; in a thread of its own, because this one may run a loop already
            with ThreadPoolExecutor(1) as thread:
                thread.submit(asyncio.run, _identity(distributed, scheduler)).result()
            self._client = distributed.Client(scheduler, timeout=_PATIENCE, set_as_default=False)
        except Exception as error:  # something else may listen there and answer anything
            why = str(error) or f"nothing came within {_PATIENCE:g} s"
            raise StudyError(
                f"no dask scheduler answers at {scheduler!r:.100} ({why:.200}); its address looks "
                "like tcp://host:8786"
            ) from None
        try:
            self._client.wait_for_workers(1, timeout=_WORKERS_PATIENCE)
        except OSError:
            self._client.close()
            raise StudyError(
                f"the dask scheduler at {scheduler} has no workers; start some with: "
                f"dask worker {scheduler}"
            ) from None
        self._death = distributed.scheduler.KilledWorker
        count = sum(self._client.ncores().values())
        # a task may have side effects that the caller counts on: never answered from a cache
        executor = self._client.get_executor(pure=False)
        super().__init__(executor, depth=max(_IN_FLIGHT, 2 * count))

    def restart(self) -> None:
        """The scheduler has started fresh workers itself."""

    def is_death(self, error: BaseException) -> bool:
        """See ``Workers.is_death``."""
        return isinstance(error, self._death)

    def close(self) -> None:
        """See ``Workers.close``."""
        self._client.close()


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


async def _identity(distributed: Any, scheduler: str) -> None:
    """Asks a dask scheduler who it is.

    Raises:
        Exception: It does not answer in time, or not as a scheduler.
    """
    arguments = distributed.Security().get_connection_args("client")
    async with distributed.rpc(scheduler, connection_args=arguments) as asked:
        answer = await asyncio.wait_for(asked.identity(), _PATIENCE)
    if answer["type"] != "Scheduler":
        raise ValueError(f"a {answer['type']} answers there")


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
