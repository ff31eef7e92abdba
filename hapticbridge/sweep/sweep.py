"""A function applied to many points on any executor, resumed from a file of results."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import math
import multiprocessing
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from multiprocessing import connection
from multiprocessing.synchronize import Barrier
from typing import Any

from hapticbridge.errors import StudyError
from hapticbridge.files import import_extra
from hapticbridge.signals import holding_interrupts
from hapticbridge.sweep.points import Point, Value, checked_points, plain, point_key
from hapticbridge.sweep.results import Interrupted, Outcome, ResultFile, Table, table_of

WORKER_DIED = "WorkerDied: its process ended twice while it computed this point"

_CHUNKS_PER_CORE = 32
"""Tasks per core by default. A kill then costs at most 3 % of a sweep."""

_LARGEST_CHUNK = 256
"""Largest number of points per task. Above it, sending and writing cost less than 10 µs per
point."""

_IN_FLIGHT = 64
"""Tasks in flight on an executor of unknown size. Further workers would idle."""

_LONGEST_ERROR = 1000
"""Largest number of characters of an error that are kept."""

_PATIENCE = 3.0
"""Longest wait in s for the answer of a dask scheduler. A local one takes 0.05 s; a far one needs
more."""

_WORKERS_PATIENCE = 5.0
"""Longest wait in s for a worker of a dask scheduler. One that was just started takes 2 s."""

_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
"""Environment of the sweep's own processes, unless the user set it. There is one process per core;
with more threads, OpenBLAS spins 0.1 s after every matrix exponential and the map ``contact`` takes
twice as long."""

_Finished = Generator[tuple[list[Point], list[Outcome]], None, None]


def sweep(
    function: Callable[[Any], Any],
    points: Iterable[Mapping[str, object]],
    *,
    results: str | os.PathLike[str] | None = None,
    chunk: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    jobs: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Table:
    """Applies a function to every point and returns a table of the results.

    The table depends on the function and the points alone: not on the executor, the size of tasks
    or an interruption. A point whose function raises gets a row with the ``error``. If one of this
    sweep's processes dies, the points that it may have held are computed again, each in a process
    of its own; a point whose process dies again gets a row with an ``error``. Ctrl-C keeps the
    points that are done.

    Args:
        function: Takes a point (a dict of parameters) and returns a mapping of results: numbers
            (NaN and infinity too), flags or text. It is defined at the top level of a module, or is
            a ``functools.partial`` of such a function. Its random numbers must come from the point.
        points: Mappings of parameters to finite numbers, flags or text; all with the same names.
            See ``grid``.
        results: File that keeps the results. Points that it holds, failed ones too, are not
            computed again. One sweep at a time may use a file.
        chunk: Points per task, >= 1; by default 1/32 of a core's share, at most 256.
        executor: Any executor; it stays open. By default fresh processes, one per core.
        scheduler: Address of a dask.distributed scheduler (extra ``cluster``) instead.
        jobs: Largest number of processes, >= 1; 1 works in this process.
        progress: Called with the numbers of finished and of all points, first before any task.

    Raises:
        StudyError: The points, the function, the file or the workers cannot be used.
        Interrupted: Ctrl-C, with the rows of the finished points; KeyboardInterrupt without any.
    """
    name = _name_of(function)
    wanted = checked_points(points)
    if executor is not None and scheduler is not None:
        raise StudyError("executor and scheduler were both given; give one of them")
    for word, count in (("chunk", chunk), ("jobs", jobs)):
        if count is not None and (type(count) is not int or count < 1):
            raise StudyError(f"{word} is {count!r:.60}; it must be a whole number >= 1")
    kept = None if results is None else ResultFile(results, name)
    done = {} if kept is None else kept.read(wanted)
    report = progress or (lambda _done, _all: None)
    report(len(done), len(wanted))
    missing = [point for key, point in wanted.items() if key not in done]
    size = chunk or min(_LARGEST_CHUNK, math.ceil(len(missing) / (_CHUNKS_PER_CORE * cores())))
    chunks = deque(missing[start : start + size] for start in range(0, len(missing), size or 1))

    def rows() -> Table:
        ready = [key for key in wanted if key in done]
        return table_of([wanted[key] for key in ready], [done[key] for key in ready])

    try:
        with contextlib.closing(_computed(function, chunks, executor, scheduler, jobs)) as finished:
            for computed, outcomes in finished:
                if kept is not None:
                    kept.add(computed, outcomes)
                done.update(zip(map(point_key, computed), outcomes, strict=True))
                report(len(done), len(wanted))
    except KeyboardInterrupt:
        if done:
            raise Interrupted(rows()) from None
        raise
    return rows()


def cores() -> int:
    """Returns the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _computed(
    function: Callable[[Any], Any],
    chunks: deque[list[Point]],
    executor: Executor | None,
    scheduler: str | None,
    jobs: int | None,
) -> _Finished:
    """Yields chunks with their outcomes as they are finished; empties ``chunks``."""
    if executor is None and scheduler is None and jobs == 1:
        while chunks:
            chunk = chunks.popleft()
            yield chunk, _outcomes(function, chunk)
    elif executor is not None:
        _refuse_lost((yield from _submitted(executor, function, chunks, _IN_FLIGHT)))
    elif scheduler is not None:
        with _cluster(scheduler) as (workers, count):
            _refuse_lost((yield from _submitted(workers, function, chunks, 2 * count)))
    while chunks:
        count = min(jobs or cores(), len(chunks))
        with _processes(function, count) as pool:
            # one task waits behind each that runs, so that no process idles
            lost = yield from _submitted(pool, function, chunks, 2 * count)
        for point in lost:
            yield [point], [_alone(function, point)]


def _submitted(
    executor: Executor, function: Callable[[Any], Any], chunks: deque[list[Point]], depth: int
) -> Generator[tuple[list[Point], list[Outcome]], None, list[Point]]:
    """Computes chunks until none is left or the executor breaks.

    Returns:
        The points that were in flight when the executor broke.
    """
    running: dict[Future[list[Outcome]], list[Point]] = {}
    lost: list[Point] = []
    try:
        while running or (chunks and not lost):
            while chunks and not lost and len(running) < depth:
                try:
                    running[executor.submit(_outcomes, function, chunks[0])] = chunks[0]
                except BrokenExecutor:
                    lost = chunks[0]
                except RuntimeError as error:
                    raise StudyError(f"the executor takes no tasks: {error}") from None
                chunks.popleft()
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                chunk = running[future]
                problem = future.exception()
                if isinstance(problem, BrokenExecutor):
                    lost = [*lost, *chunk]
                elif problem is not None:
                    yield chunk, [_failure(problem)] * len(chunk)
                else:
                    yield chunk, future.result()
                del running[future]
    except KeyboardInterrupt:
        # Ctrl-C ends the processes of a pool too. If a future is cancelled while its pool breaks,
        # Python 3.11 never completes the others, and waiting for them would not end.
        can_cancel = not isinstance(executor, ProcessPoolExecutor)
        for future in running if can_cancel else ():
            future.cancel()
        with holding_interrupts():
            for future in wait(running).done:
                if not future.cancelled() and future.exception() is None:
                    yield running[future], future.result()
        raise
    return lost


def _refuse_lost(points: list[Point]) -> None:
    if points:
        raise StudyError(
            f"a worker of the executor died while it computed one of {points!r:.300}; sweep again "
            "with a fresh executor, and with a file of results to keep what is done"
        )


def _alone(function: Callable[[Any], Any], point: Point) -> Outcome:
    """Computes a point in a process of its own."""
    with _processes(function, 1) as pool:
        try:
            return pool.submit(_outcomes, function, [point]).result()[0]
        except BrokenExecutor:
            return Outcome({}, WORKER_DIED)


def _outcomes(function: Callable[[Any], Any], points: list[Point]) -> list[Outcome]:
    """Applies a function to points, in a worker. Only KeyboardInterrupt leaves it."""
    outcomes = []
    for point in points:
        try:
            outcomes.append(Outcome(_results(function(dict(point)), point)))
        except (Exception, SystemExit) as error:
            outcomes.append(_failure(error))
    return outcomes


def _results(answer: object, point: Point) -> dict[str, Value]:
    """Returns the results of a point with plain values.

    Raises:
        TypeError: The results are no mapping with names.
        ValueError: A value is no number, flag or text, or a name is taken.
    """
    if not isinstance(answer, Mapping) or not all(isinstance(name, str) for name in answer):
        raise TypeError(f"the function returned {answer!r:.60}, not a mapping of named results")
    found = {}
    for name, value in answer.items():
        if name == "error" or name in point:
            raise ValueError(f"result '{name}' has the name of another column")
        try:
            found[name] = plain(value)
        except ValueError as error:
            raise ValueError(f"result '{name}': {error}") from None
    return found


def _failure(error: BaseException) -> Outcome:
    """Returns the outcome of a failed point: type and message of its error."""
    text = f"{type(error).__name__}: {error}"
    # a lone surrogate has no bytes and could not be written
    return Outcome({}, text[:_LONGEST_ERROR].encode(errors="backslashreplace").decode())


def _name_of(function: Callable[[Any], Any]) -> str:
    """Returns a name that identifies a function, with the arguments of a ``functools.partial``.

    Raises:
        StudyError: The function is not defined at the top level of a module, or cannot be sent to
            another process.
    """
    if isinstance(function, functools.partial):
        arguments = [*map(repr, function.args)]
        arguments += [f"{name}={value!r}" for name, value in sorted(function.keywords.items())]
        name = f"{_name_of(function.func)}({', '.join(arguments)})"
    else:
        name = f"{function.__module__}.{getattr(function, '__qualname__', '<object>')}"
        if "<" in name:
            raise StudyError(
                f"{name} cannot be swept: workers import the function, so it must be defined at "
                "the top level of a module (or be a functools.partial of such a one)"
            )
    try:
        pickle.dumps(function)
    except Exception as error:
        raise StudyError(f"{name:.200} cannot be sent to a worker: {error}") from None
    return name


@contextlib.contextmanager
def _cluster(scheduler: str) -> Iterator[tuple[Executor, int]]:
    """Connects to a dask.distributed cluster; yields its executor and its number of cores.

    Raises:
        StudyError: dask is not installed, no scheduler answers, or it has no workers.
    """
    distributed = import_extra("distributed", "a scheduler", "cluster", StudyError, "dask")

    async def reach() -> None:
        comm = await distributed.comm.connect(scheduler, timeout=_PATIENCE)
        await comm.close()

    try:
        # A refused client takes 10 s to give up and prints a traceback, so it is opened only after
        # a port answers. A thread is used because this one may already run an event loop.
        with ThreadPoolExecutor(1) as thread:
            thread.submit(asyncio.run, asyncio.wait_for(reach(), _PATIENCE)).result()
        client = distributed.Client(scheduler, timeout=_PATIENCE, set_as_default=False)
    except Exception as error:
        why = str(error) or f"nothing came within {_PATIENCE:g} s"
        raise StudyError(
            f"no dask scheduler answers at {scheduler!r:.100} ({why:.200}); its address looks "
            "like tcp://host:8786"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_WORKERS_PATIENCE)
        except OSError:
            raise StudyError(
                f"the dask scheduler at {scheduler} has no workers; start some with: "
                f"dask worker {scheduler}"
            ) from None
        # a task may have side effects that the caller depends on: never use a cached result
        yield client.get_executor(pure=False), sum(client.ncores().values())


class _Processes(ProcessPoolExecutor):
    """Pool of processes with one thread for linear algebra each; they end with this process.

    They are started afresh (spawn): a forked process would inherit the locks of the threads that
    NumPy, MuJoCo and numba start.
    """

    def __init__(self, count: int) -> None:
        context = multiprocessing.get_context("spawn")
        super().__init__(count, context, _start_process, (context.Barrier(count),))

    def submit(self, task: Callable[..., Any], /, *args: Any, **named: Any) -> Future[Any]:
        """Hands a task over; a process that starts for it holds Ctrl-C back while it imports."""
        missing = {name: value for name, value in _ONE_THREAD.items() if name not in os.environ}
        with holding_interrupts():
            os.environ.update(missing)
            try:
                return super().submit(task, *args, **named)
            finally:
                for name in missing:
                    del os.environ[name]


@contextlib.contextmanager
def _processes(function: Callable[[Any], Any], count: int) -> Iterator[Executor]:
    """Opens the sweep's own pool of processes.

    Raises:
        StudyError: The processes cannot start, or cannot import the function.
    """
    pool = _Processes(count)
    try:
        try:
            # All processes start before the first point. Python 3.11 may wait without end for one
            # that starts while another dies.
            with holding_interrupts():
                probes = [pool.submit(callable, function) for _ in range(count)]
            for probe in probes:
                probe.result()
        except BrokenExecutor:
            raise StudyError(
                "worker processes end as soon as they start: each imports the module of the swept "
                "function and the main program, so both must be importable files, and a program "
                "must call sweep below `if __name__ == '__main__':`"
            ) from None
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _start_process(barrier: Barrier) -> None:
    """Prepares a worker process, which ends silently on Ctrl-C and with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    barrier.wait()  # until all processes of the pool have started


def _leave_with_parent() -> None:
    """Ends this process after its parent has ended; a pool's processes would wait for ever."""
    if parent := multiprocessing.parent_process():
        connection.wait([parent.sentinel])
        os._exit(1)
