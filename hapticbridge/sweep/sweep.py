"""Applies a function to many points, on many workers, and can go on after a kill."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import math
import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from concurrent.futures import wait as wait_for
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import numpy as np

from hapticbridge.errors import StudyError
from hapticbridge.files import import_extra
from hapticbridge.signals import holding_interrupts
from hapticbridge.sweep.points import RESERVED, Point, Value, checked_points, plain
from hapticbridge.sweep.results import (
    Interrupted,
    Outcome,
    ResultFolder,
    Table,
    check_format,
    table_of,
)

_LONGEST_ERROR = 1000
"""Letters of an error that are kept."""

WORKER_DIED = "WorkerDied: the worker process ended while it computed this point, twice"


def run_task(function: Callable[[Any], Any], batched: bool, points: list[Point]) -> list[Outcome]:
    """Applies a function to points, in a worker.

    Where a batch fails as a whole, its points are computed one at a time, so that only those
    that fail alone are recorded as failed.

    Args:
        function: Takes one point, or a list of them where ``batched``.
        batched: See ``function``.
        points: The points of this task.

    Returns:
        What became of each point. Nothing that the function raises gets out, KeyboardInterrupt
        excepted.
    """
    if not batched:
        return [_alone(function, point) for point in points]
    try:
        answers = _batch(function, points)
    except (Exception, SystemExit) as error:
        if len(points) == 1:
            return [_failure(error)]
        return [done for point in points for done in run_task(function, True, [point])]
    return [_checked(answer, point) for answer, point in zip(answers, points, strict=True)]


def qualified_name(function: Callable[[Any], Any]) -> str:
    """Returns a name by which a function is known again, in another process and on another day.

    A ``functools.partial`` is named by its function and the ``repr`` of its arguments.

    Raises:
        StudyError: The function does not stand at the top level of a module, or cannot be sent to
            another process.
    """
    if isinstance(function, functools.partial):
        with np.printoptions(threshold=sys.maxsize, floatmode="unique"):
            settings = [repr(value) for value in function.args]
            settings += [f"{name}={value!r}" for name, value in sorted(function.keywords.items())]
        name = f"{qualified_name(function.func)}({', '.join(settings)})"
    else:
        inner = getattr(function, "__qualname__", type(function).__name__)
        module = getattr(function, "__module__", None) or "?"
        if "<" in inner or not hasattr(function, "__qualname__"):
            raise StudyError(
                f"{inner} of {module} cannot be swept: workers import the function, so it must be "
                "defined at the top level of a module (or be a functools.partial of such a one)"
            )
        if module == "__main__":
            module = Path(getattr(sys.modules[module], "__file__", None) or "__main__").stem
        name = f"{module}.{inner}"
    try:
        pickle.dumps(function)
    except Exception as error:
        raise StudyError(f"{name:.200} cannot be sent to a worker: {error}") from None
    return name


def _batch(function: Callable[[Any], Any], points: Sequence[Point]) -> list[object]:
    answers = list(function([dict(point) for point in points]))
    if len(answers) != len(points):
        raise ValueError(f"the function returned {len(answers)} results for {len(points)} points")
    return answers


def _alone(function: Callable[[Any], Any], point: Point) -> Outcome:
    try:
        answer = function(dict(point))
    except (Exception, SystemExit) as error:  # whatever it is, it is recorded
        return _failure(error)
    return _checked(answer, point)


def _checked(answer: object, point: Point) -> Outcome:
    try:
        return Outcome(_results(answer, point))
    except ValueError as error:
        return _failure(error)


def _results(answer: object, point: Point) -> dict[str, Value]:
    """Returns what a function gave back with plain values.

    Raises:
        ValueError: It is no mapping of names to numbers, flags or text, or a name is taken.
    """
    if not isinstance(answer, Mapping):
        raise ValueError(f"the function returned {answer!r:.60}, not a mapping of results")  # noqa: TRY004
    found: dict[str, Value] = {}
    for name, value in answer.items():
        if not isinstance(name, str) or not name or not name.isprintable():
            raise ValueError(f"result {name!r:.60} has no name; it must be printable text")
        if name in RESERVED or name in point:
            raise ValueError(f"result '{name}' has the name of another column")
        try:
            found[name] = plain(value)
        except ValueError as error:
            raise ValueError(f"result '{name}': {error}") from None
    return found


def _failure(error: BaseException) -> Outcome:
    """Returns what is recorded of a point that failed: the error's type and message."""
    try:
        text = f"{type(error).__name__}: {error}"
    except Exception:
        text = type(error).__name__
    # a lone surrogate has no bytes and could not be written down
    return Outcome({}, text[:_LONGEST_ERROR].encode(errors="backslashreplace").decode())


IN_FLIGHT = 64
"""Tasks in flight where the number of workers is not known: more workers than that would idle."""


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

    def __init__(self, executor: Executor, depth: int = IN_FLIGHT) -> None:
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


_PATIENCE = 3.0
"""Seconds for a dask scheduler to answer; a local one takes 0.05 s. Shorter refuses a far one."""

_WORKERS_PATIENCE = 5.0
"""Seconds for a dask scheduler to have a worker: one that was just started takes 2 s."""


class ClusterWorkers(Workers):
    """The workers of a running dask.distributed cluster.

    Raises:
        StudyError: dask is not installed, no scheduler answers, or it has no workers.
    """

    def __init__(self, scheduler: str) -> None:
        distributed = import_extra("distributed", "a scheduler", "cluster", StudyError, "dask")
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
        super().__init__(executor, depth=max(IN_FLIGHT, 2 * count))

    def restart(self) -> None:
        """The scheduler has started fresh workers itself."""

    def is_death(self, error: BaseException) -> bool:
        """See ``Workers.is_death``."""
        return isinstance(error, self._death)

    def close(self) -> None:
        """See ``Workers.close``."""
        self._client.close()


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


Chunk = dict[str, Point]
"""The points of one task, by their keys."""

_CHUNKS_PER_CORE = 32
"""Tasks a core where nobody chooses: a kill then costs some 3 % of a sweep at most."""

_LARGEST_CHUNK = 256
"""Points; beyond that the share of sending and writing a part is below 10 µs a point anyway."""

_LIVES = 2
"""A point whose worker dies is tried once more: the system may have killed it for memory."""


def sweep(
    function: Callable[[Any], Any],
    points: Iterable[Mapping[str, object]],
    *,
    batched: bool = False,
    folder: str | os.PathLike[str] | None = None,
    format: str = "csv",  # noqa: A002 - the word that a caller expects
    chunk: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    jobs: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Table:
    """Applies a function to every point and returns a table of what it returned.

    The table depends on the function and the points alone: not on the executor, the size of
    tasks, the order in which they end, or on how often the sweep was killed and begun again.

    With a folder, what is done is kept there, a part a task, each written whole or not at all. A
    sweep with the same folder and function takes the points it finds from there and computes the
    others. The function is known by its name, hapticbridge's version and sources, and
    MuJoCo's version; after a change of other code take another folder.
    Failed points are kept too, and not tried again. One sweep at a time
    may use a folder.

    What goes wrong: a point whose function raises gets a row with the ``error``. So does a point
    that ends its worker process twice; the others of its task are computed again. Ctrl-C keeps
    what is done, cancels what waits, and raises ``Interrupted`` with those rows, or, without any,
    KeyboardInterrupt. In a terminal it ends this sweep's own processes with it; where it reaches
    this process alone, tasks that were handed to them, two a core at most, are waited for and kept.

    Args:
        function: Takes a point (a dict of parameters) and returns a mapping of results: numbers
            (NaN and infinity too), flags or text. It stands at the top level of a module, or is a
            ``functools.partial`` of such a one. Its own random numbers must come from the point.
        points: Mappings of parameters to finite numbers, flags or text; all with the same names,
            none twice. See ``grid``.
        batched: The function takes a list of points and returns a list of as many results, so
            that threads inside one task can share them. Where it raises, its points are given
            to it one by one.
        folder: Where parts are kept; made if missing.
        format: Of the parts: "csv", or "parquet" (needs the extra ``tables``).
        chunk: Points a task, >= 1; by default 1/32 of a core's share, 256 at most.
        executor: Any executor; it stays open. By default a pool of fresh processes, as many as
            the cores that this process may use.
        scheduler: Address of a running dask.distributed cluster (needs the extra ``cluster``),
            instead of an executor.
        jobs: Processes at most where neither is given, >= 1; by default as many as there are cores.
        progress: Called with the points done and all points, at the start and after every task.

    Returns:
        A table with a row a point, in their order.

    Raises:
        StudyError: The points, the function, the format, the folder or the workers cannot be
            used, or the folder holds another sweep.
    """
    name = qualified_name(function)
    wanted = checked_points(points)
    check_format(format)
    if executor is not None and scheduler is not None:
        raise StudyError("executor and scheduler were both given; give one of them")
    for word, count in (("chunk", chunk), ("jobs", jobs)):
        if count is not None and (
            isinstance(count, bool) or not isinstance(count, int) or count < 1
        ):
            raise StudyError(f"{word} is {count!r:.60}; it must be a whole number >= 1")
    parameters = tuple(next(iter(wanted.values())))
    done: dict[str, Outcome] = {}
    kept = None
    if folder is not None:
        kept = ResultFolder(folder, name, format)
        done = kept.read(wanted)
        kept.describe(parameters, (), len(wanted))
    report = progress or _silent
    report(len(done), len(wanted))

    def keep(chunk: Chunk, outcomes: list[Outcome]) -> None:
        if kept is not None:
            kept.add(chunk, outcomes)
        done.update(zip(chunk, outcomes, strict=True))
        report(len(done), len(wanted))

    def rows() -> Table:
        keys = [key for key in wanted if key in done]
        return table_of([wanted[key] for key in keys], [done[key] for key in keys])

    missing = {key: point for key, point in wanted.items() if key not in done}
    if missing:
        chunks = deque(_cut(missing, chunk or _usual_chunk(len(missing))))
        try:
            with hired(function, executor, scheduler, len(chunks), jobs) as workers:
                _Shift(workers, function, batched, keep).work(chunks)
        except KeyboardInterrupt:
            if done:
                raise Interrupted(rows()) from None
            raise
    table = rows()
    if kept is not None:
        kept.describe(parameters, table.results, len(wanted))
    return table


class _Shift:
    """The tasks in flight, and what is known of those whose workers died."""

    def __init__(
        self,
        workers: Workers,
        function: Callable[[Any], Any],
        batched: bool,
        keep: Callable[[Chunk, list[Outcome]], None],
    ) -> None:
        self._workers = workers
        self._function = function
        self._batched = batched
        self._keep = keep
        self._running: dict[Future[list[Outcome]], Chunk] = {}
        # chunks that were in flight when a worker died; they run alone, to find the culprit
        self._suspects: deque[Chunk] = deque()
        self._deaths: Counter[str] = Counter()

    def work(self, chunks: deque[Chunk]) -> None:
        """Computes all chunks, or keeps what is done and raises."""
        try:
            while chunks or self._suspects or self._running:
                if not self._submit(chunks):
                    self._collect(wait_for(self._running, return_when=FIRST_COMPLETED).done)
        except BaseException:
            self._wind_up()
            raise

    def _submit(self, chunks: deque[Chunk]) -> bool:
        """Hands out one chunk; tells whether there is nothing to wait for yet."""
        source, depth = (self._suspects, 1) if self._suspects else (chunks, self._workers.depth)
        if not source or len(self._running) >= depth:
            return False
        points = list(source[0].values())
        try:
            future = self._workers.submit(run_task, self._function, self._batched, points)
        except BrokenExecutor:
            if self._running:
                return False
            self._workers.restart()
            return True
        self._running[future] = source.popleft()
        if future.done():  # an executor that works while it submits: keep it now
            self._collect({future})
        return True

    def _collect(self, finished: set[Future[list[Outcome]]]) -> None:
        """Keeps what is done; sorts out the tasks whose worker died."""
        dead = [chunk for future in finished if (chunk := self._settle(future))]
        if not dead:
            return
        if any(isinstance(future.exception(), BrokenExecutor) for future in finished):
            # a pool that lost one process gives all of its tasks up
            finished = wait_for(self._running).done
            dead += [chunk for future in finished if (chunk := self._settle(future))]
            self._workers.restart()
        if len(dead) > 1:
            self._suspects.extend(dead)
        elif len(dead[0]) > 1:
            self._suspects.extendleft(reversed(list(_cut(dead[0], 1))))
        else:
            (key,) = dead[0]
            self._deaths[key] += 1
            if self._deaths[key] < _LIVES:
                self._suspects.appendleft(dead[0])
            else:
                self._keep(dead[0], [Outcome({}, WORKER_DIED)])

    def _settle(self, future: Future[list[Outcome]]) -> Chunk | None:
        """Keeps a finished task's outcomes, or returns its points if its worker died."""
        chunk = self._running[future]
        try:
            outcomes = future.result()
        except (Exception, CancelledError) as error:
            del self._running[future]
            if self._workers.is_death(error):
                return chunk
            raise StudyError(
                f"the workers could not run a task ({type(error).__name__}: {error!s:.300})"
            ) from error
        self._keep(chunk, outcomes)
        del self._running[future]  # not before: Ctrl-C may come at any moment
        return None

    def _wind_up(self) -> None:
        """Cancels what waits and keeps what is done; nothing here hides the first error."""
        with holding_interrupts():  # a second Ctrl-C would lose what the first one keeps
            for future in self._running:
                future.cancel()
            self._workers.stop()
            for future, chunk in self._running.items():
                if future.done() and not future.cancelled() and future.exception() is None:
                    with contextlib.suppress(Exception):
                        self._keep(chunk, future.result())


def _cut(points: Chunk, size: int) -> Iterator[Chunk]:
    """Yields points in chunks, in their order."""
    keys = list(points)
    for start in range(0, len(keys), size):
        yield {key: points[key] for key in keys[start : start + size]}


def _usual_chunk(count: int) -> int:
    return min(_LARGEST_CHUNK, math.ceil(count / (_CHUNKS_PER_CORE * cores())))


def _silent(_done: int, _total: int) -> None:
    """Says nothing: the library draws no progress."""
