"""Sweeps: a function applied to many points on any executor, resumed from a file of results.

The file is JSON Lines. Its first line names the function, the versions of hapticbridge and MuJoCo
and a digest of the package's sources. Each other line holds one ``point`` with its ``results`` and
``error``. A line that was cut by a crash is skipped, and its point is computed again.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import hashlib
import itertools
import json
import math
import multiprocessing
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from multiprocessing import connection
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import StudyError, choices
from hapticbridge.files import import_extra, writing
from hapticbridge.signals import holding_interrupts

# Points: checked mappings of parameters, their keys, and grids of them

Value = float | int | bool | str
"""Type of a parameter or a result: a number, a flag or text."""

Point = dict[str, Value]
"""Parameters of one evaluation by name."""


def plain(value: object) -> Value:
    """Converts a value to Python's own float, int, bool or str.

    Every NaN becomes the same NaN, so that equal tables are equal in their bits.

    Raises:
        ValueError: The value has another type, is an integer beyond 64 bits, or is text that
            has no UTF-8 form.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise ValueError(f"the integer {value:.3e} does not fit into 64 bits")
    if isinstance(value, float):
        return math.nan if math.isnan(value) else float(value)
    if isinstance(value, str):
        value.encode()
    if isinstance(value, bool | int | str):
        return value
    raise ValueError(f"{value!r:.60} is neither a number nor a flag nor text")


def point_key(point: Mapping[str, Value]) -> str:
    """Returns the key of a point: its names in order with their values, as JSON.

    Floats enter with all their digits, so 0.1 + 0.2 and 0.3 are two points. 1, 1.0 and True are
    three points, because a function may distinguish them.
    """
    return json.dumps(point, sort_keys=True)


def grid(**axes: object) -> list[Point]:
    """Combines the values of several axes; the last axis varies fastest.

    Args:
        axes: For each parameter its values, or one value for all points.

    Raises:
        StudyError: There is no axis, an axis is empty or not one-dimensional, or a value is not a
            finite number, a flag or text.
    """
    if not axes:
        raise StudyError("a grid needs at least one axis")
    values = []
    for name, axis in axes.items():
        is_single = isinstance(axis, str | bytes) or not isinstance(axis, Iterable)
        row = [axis] if is_single else list(axis)  # type: ignore[call-overload]
        if not row:
            raise StudyError(f"axis '{name}' is empty; it must hold at least one value")
        values.append([_parameter(value, f"axis '{name}'") for value in row])
    return [dict(zip(axes, combined, strict=True)) for combined in itertools.product(*values)]


def checked_points(points: Iterable[Mapping[str, object]]) -> dict[str, Point]:
    """Returns points by their keys, in order, with plain values.

    Raises:
        StudyError: There is no point, a point is no mapping, repeats another one or has other
            parameters than the first, or a value is out of range. The message names the point.
    """
    by_key: dict[str, Point] = {}
    names: list[str] = []
    for number, raw in enumerate(points):
        if not isinstance(raw, Mapping) or not raw:
            raise StudyError(f"point {number} is {raw!r:.60}; it must be a mapping of parameters")
        point = {
            name: _parameter(value, f"point {number}: parameter '{name}'")
            for name, value in raw.items()
        }
        names = names or sorted(point)
        if sorted(point) != names:
            raise StudyError(
                f"point {number} has the parameters {', '.join(point)}; the first point has "
                f"{', '.join(names)}"
            )
        if "error" in point:
            raise StudyError("no parameter may be named 'error': the sweep adds that column")
        if point_key(point) in by_key:
            raise StudyError(f"point {number} is there twice: {point!r:.200}")
        by_key[point_key(point)] = point
    if not by_key:
        raise StudyError("there are no points; a sweep needs at least one")
    return by_key


def _parameter(value: object, place: str) -> Value:
    try:
        plain_value = plain(value)
    except ValueError as error:
        raise StudyError(f"{place}: {error}") from None
    if isinstance(plain_value, float) and not math.isfinite(plain_value):
        raise StudyError(f"{place} is {plain_value}; it must be finite")
    return plain_value


# Results: the table of all points, and the file that keeps them between runs

FORMATS = ("csv", "parquet")


class Outcome(NamedTuple):
    """Results of one point.

    Attributes:
        results: Values that the function returned; empty if it failed.
        error: Type and message of the failure; empty if there was none.
    """

    results: Mapping[str, Value]
    error: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns of equal length, one row per point, in the order of the points.

    A column holds int64, float64, bool, or Python's text (dtype object). Where a point failed,
    its numbers and flags are NaN and its text is empty, so an integer or flag column with a
    failed point is float64. ``table.select(~table.failed)`` leaves such rows out.

    Attributes:
        columns: The parameters, the results in order of first appearance, and ``error``.
    """

    columns: Mapping[str, NDArray[Any]]

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Returns a column.

        Raises:
            StudyError: There is no such column.
        """
        try:
            return self.columns[name]
        except KeyError:
            raise StudyError(
                f"the table has no column {name!r:.60}; it has {choices(self.columns)}"
            ) from None

    def numbers(self, name: str) -> NDArray[np.float64]:
        """Returns a column of numbers; NaN throughout where no point returned such a result."""
        return np.asarray(self.columns.get(name, np.full(len(self), np.nan)), dtype=np.float64)

    def texts(self, name: str) -> NDArray[np.object_]:
        """Returns a column of text; empty texts where no point returned such a result."""
        return np.asarray(self.columns.get(name, np.full(len(self), "")), dtype=object)

    def __len__(self) -> int:
        return len(self.columns["error"])

    @property
    def failed(self) -> NDArray[np.bool_]:
        """Mask of the points whose function failed; shape (rows,)."""
        return np.asarray(self.columns["error"] != "", dtype=bool)

    def select(self, rows: NDArray[Any]) -> Table:
        """Returns a table of the rows selected by a mask or by their numbers; types stay."""
        return Table({name: column[rows] for name, column in self.columns.items()})

    def write(self, path: str | os.PathLike[str], units: Mapping[str, str] | None = None) -> None:
        """Writes the table to one file, CSV or Parquet by the name's end.

        Numbers in CSV have as many digits as bring back the same double.

        Args:
            path: The file.
            units: Unit of a column by its name; Parquet keeps it as metadata ``unit``.

        Raises:
            StudyError: The ending is unknown, pyarrow is missing, or the file cannot be written.
        """
        path = Path(path)
        check_format(form := path.suffix.removeprefix("."))
        columns = {name: column.tolist() for name, column in self.columns.items()}
        with writing(path, StudyError):
            if form == "csv":
                with path.open("w", newline="", encoding="utf-8") as file:
                    # quoted text: a lone carriage return in it would end the row otherwise
                    writer = csv.writer(file, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\n")
                    writer.writerow(columns)
                    writer.writerows(zip(*columns.values(), strict=True))
            else:
                _write_parquet(columns, path, units or {})


class Interrupted(KeyboardInterrupt):
    """Interruption of a sweep by Ctrl-C.

    Attributes:
        table: One row for each point that was computed, at least one, in the order of the
            points.
    """

    def __init__(self, table: Table) -> None:
        super().__init__()
        self.table = table


def table_of(points: Sequence[Point], outcomes: Sequence[Outcome]) -> Table:
    """Returns the table of points and their outcomes, in order."""
    results = dict.fromkeys(name for done in outcomes for name in done.results)
    columns = {name: _column([point[name] for point in points]) for name in points[0]}
    columns |= {name: _column([done.results.get(name) for done in outcomes]) for name in results}
    columns["error"] = np.array([done.error for done in outcomes], dtype=object)
    return Table(columns)


def check_format(name: str) -> None:
    """Refuses a format that does not exist or cannot be written here.

    Raises:
        StudyError: The format is unknown, or pyarrow is not installed.
    """
    if name not in FORMATS:
        raise StudyError(f"format {name!r:.60} is unknown; the formats are {choices(FORMATS)}")
    if name == "parquet":
        import_extra("pyarrow", "Parquet", "tables", StudyError)


def _write_parquet(
    columns: Mapping[str, list[Value]], path: Path, units: Mapping[str, str]
) -> None:
    arrow = import_extra("pyarrow", "Parquet", "tables", StudyError)
    parquet = import_extra("pyarrow.parquet", "Parquet", "tables", StudyError)
    arrays = [arrow.array(values, from_pandas=False) for values in columns.values()]
    fields = [
        arrow.field(name, array.type, metadata={"unit": units[name]} if name in units else None)
        for name, array in zip(columns, arrays, strict=True)
    ]
    parquet.write_table(arrow.table(arrays, schema=arrow.schema(fields)), path)


def _column(values: Sequence[Value | None]) -> NDArray[Any]:
    """Returns a column of one type: text if any value is, else the widest of the numbers."""
    types = {type(value) for value in values}
    if str in types:
        return np.array(["" if value is None else str(value) for value in values], dtype=object)
    if float in types or type(None) in types:
        return np.array([math.nan if v is None else float(v) for v in values], dtype=np.float64)
    return np.array(values, dtype=np.int64 if int in types else np.bool_)


class ResultFile:
    """The results of one sweep on disk.

    Raises:
        StudyError: The file cannot be read or written, or holds another sweep.
    """

    def __init__(self, path: str | os.PathLike[str], function: str) -> None:
        self.path = Path(path)
        identity = {
            "function": function,
            "hapticbridge": version("hapticbridge"),
            "mujoco": version("mujoco"),
            "sources": _sources(),
        }
        with writing(self.path, StudyError):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a+b") as file:
                file.seek(0)
                first, *self._lines = file.read().split(b"\n")
                if not first:
                    file.write(json.dumps(identity).encode() + b"\n")
                elif self._lines and self._lines[-1]:
                    file.write(b"\n")  # ends a line that a crash has cut
        found = _parsed(first) if first else identity
        if found != identity:
            raise StudyError(
                f"{self.path}: holds a sweep of {found.get('function')!s:.200} by hapticbridge "
                f"{found.get('hapticbridge')!s:.40}, not of {function:.200} by "
                f"{identity['hapticbridge']}, or by other sources or another MuJoCo than now; "
                "give another folder, or delete this file to start anew"
            )

    def read(self, wanted: Collection[str]) -> dict[str, Outcome]:
        """Returns the outcomes of some points, by the points' keys."""
        found = {}
        for line in filter(None, map(_parsed, self._lines)):
            if (key := point_key(line["point"])) in wanted:
                found[key] = Outcome(line["results"], line["error"])
        return found

    def add(self, points: Sequence[Point], outcomes: Sequence[Outcome]) -> None:
        """Appends points and their outcomes.

        Raises:
            StudyError: The file cannot be written.
        """
        lines = [
            json.dumps({"point": point, "results": dict(done.results), "error": done.error}) + "\n"
            for point, done in zip(points, outcomes, strict=True)
        ]
        with writing(self.path, StudyError), self.path.open("a", encoding="ascii") as file:
            file.writelines(lines)
            file.flush()
            os.fsync(file.fileno())


def _parsed(line: bytes) -> dict[str, Any]:
    """Returns the JSON object on a line, or an empty one if the line holds none."""
    try:
        parsed = json.loads(line)
    except ValueError:
        return {}
    return parsed if isinstance(parsed, dict) else {}


@cache
def _sources() -> str:
    """Returns a digest of the package's sources and shipped scenes: they decide the results."""
    digest = hashlib.blake2b(digest_size=16)
    root = Path(__file__).parents[1]
    # in a checkout the scenes lie beside the package, in a wheel within it
    paths = [path for name in ("hapticbridge", "models") for path in (root / name).rglob("*")]
    for path in sorted(paths):
        if path.suffix in {".py", ".xml"}:
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


# Evaluation of the points

WORKER_DIED = "WorkerDied: its process ended twice while it computed this point"

_CHUNKS_PER_CORE = 32
"""Tasks per core by default. A kill then costs at most 3 % of a sweep."""

_MAX_CHUNK = 256
"""Largest number of points per task. Above it, sending and writing cost less than 10 µs per
point."""

_IN_FLIGHT = 64
"""Tasks in flight on an executor of unknown size. Further workers would idle."""

_MAX_ERROR = 1000
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

Workers = int | Executor | str | None
"""Workers of a sweep: a number of processes, an executor, or the address of a scheduler."""

_Finished = Generator[tuple[list[Point], list[Outcome]], None, None]


def sweep(
    function: Callable[[Any], Any],
    points: Iterable[Mapping[str, object]],
    *,
    results: str | os.PathLike[str] | None = None,
    chunk: int | None = None,
    workers: Workers = None,
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
        workers: Largest number of fresh processes, >= 1, by default one per core; 1 works in this
            process. Or any executor, which stays open, or the address of a dask.distributed
            scheduler (extra ``cluster``). The own processes have OPENBLAS_NUM_THREADS=1; without
            it, short loops with a simulated device take twice as long.
        progress: Called with the numbers of finished and of all points, first before any task.

    Raises:
        StudyError: The points, the function, the file or the workers cannot be used.
        Interrupted: Ctrl-C, with the rows of the finished points; KeyboardInterrupt without any.
    """
    name = _name_of(function)
    wanted = checked_points(points)
    number = None if isinstance(workers, Executor | str) else workers
    for word, count in (("chunk", chunk), ("workers", number)):
        if count is not None and (type(count) is not int or count < 1):
            raise StudyError(f"{word} is {count!r:.60}; it must be a whole number >= 1")
    kept = None if results is None else ResultFile(results, name)
    done = {} if kept is None else kept.read(wanted)
    report = progress or (lambda _done, _all: None)
    report(len(done), len(wanted))
    missing = [point for key, point in wanted.items() if key not in done]
    size = chunk or min(_MAX_CHUNK, math.ceil(len(missing) / (_CHUNKS_PER_CORE * cores())))
    chunks = deque(missing[start : start + size] for start in range(0, len(missing), size or 1))

    def rows() -> Table:
        ready = [key for key in wanted if key in done]
        return table_of([wanted[key] for key in ready], [done[key] for key in ready])

    try:
        with contextlib.closing(_computed(function, chunks, workers)) as finished:
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
    workers: Workers,
) -> _Finished:
    """Yields chunks with their outcomes as they are finished; empties ``chunks``."""
    if workers == 1:
        while chunks:
            chunk = chunks.popleft()
            yield chunk, _outcomes(function, chunk)
    elif isinstance(workers, Executor):
        _refuse_lost((yield from _submitted(workers, function, chunks, _IN_FLIGHT)))
    elif isinstance(workers, str):
        with _cluster(workers) as (cluster, count):
            _refuse_lost((yield from _submitted(cluster, function, chunks, 2 * count)))
    while chunks:
        # none are left where an executor took them
        count = min(workers if isinstance(workers, int) else cores(), len(chunks))
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
    return Outcome({}, text[:_MAX_ERROR].encode(errors="backslashreplace").decode())


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

    try:
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


@contextlib.contextmanager
def _processes(function: Callable[[Any], Any], count: int) -> Iterator[Executor]:
    """Opens a pool of processes, each with one thread for linear algebra.

    They end with this process. They are started afresh (spawn): a forked process would inherit the
    locks of the threads that NumPy, MuJoCo and numba start. All start before the first point, and
    hold Ctrl-C back while they import. Python 3.11 may wait without end for one that starts while
    another dies.

    Raises:
        StudyError: The processes cannot start, or cannot import the function.
    """
    context = multiprocessing.get_context("spawn")
    missing = {name: value for name, value in _ONE_THREAD.items() if name not in os.environ}
    pool = ProcessPoolExecutor(count, context, _start_process, (context.Barrier(count),))
    try:
        try:
            with holding_interrupts():
                os.environ.update(missing)
                try:
                    probes = [pool.submit(callable, function) for _ in range(count)]
                finally:
                    for name in missing:
                        del os.environ[name]
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
