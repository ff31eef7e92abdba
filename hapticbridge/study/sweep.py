"""Applies a function to many points, on many workers, and can go on after a kill."""

from __future__ import annotations

import contextlib
import math
import os
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future
from concurrent.futures import wait as wait_for
from typing import Any

from hapticbridge.errors import StudyError
from hapticbridge.signals import holding_interrupts
from hapticbridge.study.hiring import hired
from hapticbridge.study.points import Point, checked_points
from hapticbridge.study.results import ResultFolder
from hapticbridge.study.table import Interrupted, Outcome, Table, check_format, table_of
from hapticbridge.study.task import WORKER_DIED, qualified_name, run_task
from hapticbridge.study.workers import Workers, cores

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
