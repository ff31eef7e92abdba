"""A sweep gives the same table on any workers, and after any interruption."""

from __future__ import annotations

import concurrent.futures
import csv
import functools
import json
import math
import os
import subprocess
import sys
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sweep_functions as functions
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hapticbridge.errors import StudyError
from hapticbridge.study.points import Point, grid, plain, point_key
from hapticbridge.study.results import ResultFolder
from hapticbridge.study.sweep import Chunk, _Shift, sweep
from hapticbridge.study.table import Outcome, Table
from hapticbridge.study.task import WORKER_DIED
from hapticbridge.study.workers import Workers, cores

POINTS = grid(stiffness=[1000, 3000.0, 1e4 / 3], damping=np.linspace(0.1, 0.3, 3), tool="peg")


class Inline(Executor):
    """Works while it submits."""

    def submit(self, task: Callable[..., Any], /, *args: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(task(*args, **named))
        except Exception as error:
            future.set_exception(error)
        return future


class Dead(BaseException):
    """What ends a worker."""


class Fragile(Workers):
    """A pool that breaks, with all that is in flight, when a task raises Dead."""

    def __init__(self) -> None:
        super().__init__(Inline(), depth=4)
        self.restarts = 0
        self.broken = False
        self.flying: list[tuple[Future[Any], Callable[..., Any], tuple[object, ...]]] = []

    def submit(self, task: Callable[..., Any], *arguments: object) -> Future[Any]:
        if self.broken:
            raise BrokenExecutor
        future: Future[Any] = Future()
        self.flying.append((future, task, arguments))
        last: list[Point] = arguments[2]  # type: ignore[assignment]
        if len(self.flying) < self.depth and self.restarts == 0 and last[-1]["n"] != 11:
            return future
        for flying, work, given_ones in self.flying:
            try:
                flying.set_result(work(*given_ones))
            except Dead:
                self.broken = True
                break
        for flying, _, _ in self.flying:
            if not flying.done():
                flying.set_exception(BrokenExecutor())
        self.flying.clear()
        return future

    def restart(self) -> None:
        self.restarts += 1
        self.broken = False


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SWEEP_SCRATCH", str(tmp_path))
    return tmp_path


def computed(scratch: Path) -> Counter[int]:
    return Counter(map(int, (scratch / "computed").read_text().split()))


def serial(function: Callable[[Any], Any] = functions.bound, points: Any = POINTS) -> Table:
    return sweep(function, points, executor=Inline())


def parts(folder: Path) -> list[Path]:
    return sorted(folder.glob("part-*"))


DEATHS: Counter[object] = Counter()


def deadly(point: Point) -> dict[str, float]:
    # 8 ends its worker in company and once alone, as a process that was short of memory would
    if point["n"] in (3, 4) or (point["n"] == 8 and DEATHS[8] < 2):
        DEATHS[point["n"]] += 1
        raise Dead
    return {"x": float(point["n"])}


def test_the_table_holds_what_a_plain_loop_gives() -> None:
    table = serial()
    assert list(table.columns) == [
        *("stiffness", "damping", "tool"),
        *("needed", "passive", "ticks", "verdict", "limit", "error"),
    ]
    for row, point in enumerate(POINTS):
        assert all(table[name][row] == value for name, value in point.items())
        if table.failed[row]:
            continue
        expected = functions.bound(point)  # type: ignore[arg-type]
        assert table["needed"][row] == expected["needed"]
        assert table["verdict"][row] == expected["verdict"]
        np.testing.assert_equal(table["limit"][row], expected["limit"])


def test_own_processes_get_one_blas_thread_each_unless_the_user_says_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    alone = sweep(functions.blas_threads, grid(n=[0]))
    assert alone["asked"][0] == "1"
    assert "OPENBLAS_NUM_THREADS" not in os.environ
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    told = sweep(functions.blas_threads, grid(n=[0]))
    assert told["asked"][0] == "2"
    assert os.environ["OPENBLAS_NUM_THREADS"] == "2"
    if alone["threads"][0] and cores() > 1:
        assert alone["threads"][0] < told["threads"][0]


def test_a_result_that_no_point_gave_is_missing_or_empty() -> None:
    table = serial()
    assert np.isnan(table.numbers("mass")).all()
    assert list(table.texts("verdict")) == list(table["verdict"])
    assert list(table.texts("colour")) == [""] * len(table)
    with pytest.raises(StudyError, match="no column 'colour'"):
        table["colour"]


def test_every_executor_gives_the_same_bits(tmp_path: Path) -> None:
    expected = serial()
    with ThreadPoolExecutor(3) as threads:
        assert sweep(functions.bound, POINTS, executor=threads, chunk=1).equals(expected)
        batched = sweep(functions.bound_of_all, POINTS, batched=True, executor=threads, chunk=4)
        assert batched.equals(expected)
    assert sweep(functions.bound, POINTS).equals(expected)  # processes
    for form in ("csv", "parquet"):
        for _ in range(2):  # computed, then read
            kept = sweep(
                functions.bound,
                POINTS,
                folder=tmp_path / form,
                format=form,
                chunk=2,
                executor=Inline(),
            )
            assert kept.equals(expected)


def test_a_dask_cluster_of_two_workers_gives_the_same_bits() -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, processes=True, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        table = sweep(functions.bound, POINTS, scheduler=cluster.scheduler_address, chunk=1)
        assert table.equals(serial())


def test_the_order_of_rows_is_that_of_points_whatever_ends_first() -> None:
    with ThreadPoolExecutor(2) as threads:
        table = sweep(functions.last_ends_first, grid(n=range(8)), executor=threads, chunk=1)
    assert table["square"].tolist() == [n * n for n in range(8)]
    assert table["square"].dtype == np.int64


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize(("marker", "code"), [("kill", -9), ("interrupt", 77)])
def test_a_sweep_that_was_killed_goes_on_and_computes_nothing_twice(
    scratch: Path, marker: str, code: int
) -> None:
    (scratch / marker).touch()
    program = [sys.executable, functions.__file__]
    # the pipe ends only when the last worker is gone, so this also sees that no orphan stays
    killed = subprocess.run(
        program, capture_output=True, timeout=60, start_new_session=True, check=False
    )
    assert killed.returncode == code, killed.stderr
    folder = scratch / "parts"
    kept = len(parts(folder))
    assert 0 < kept < len(functions.COUNTED)
    name = json.loads((folder / "sweep.json").read_text())["function"]
    assert name == "sweep_functions.counted"
    resumed = sweep(functions.counted, functions.COUNTED, folder=folder, executor=Inline(), chunk=1)
    often = computed(scratch)
    # what was in flight is computed again, at most two tasks a worker; what was kept is not
    assert sum(often.values()) - len(functions.COUNTED) <= len(functions.COUNTED) - kept
    assert sum(count > 1 for count in often.values()) <= 2 * (os.cpu_count() or 1)
    assert resumed.equals(serial(functions.counted, functions.COUNTED))


def test_a_worker_that_is_killed_once_costs_nothing(scratch: Path) -> None:
    (scratch / "die").touch()
    table = sweep(functions.counted, functions.COUNTED, chunk=4)
    assert not (scratch / "die").exists()
    assert not table.failed.any()
    assert table.equals(serial(functions.counted, functions.COUNTED))


def test_points_that_end_their_worker_are_found_and_recorded() -> None:
    points = grid(n=range(12))
    keyed = {point_key(point): point for point in points}
    chunks: deque[Chunk] = deque(
        {key: keyed[key] for key in list(keyed)[start : start + 3]} for start in range(0, 12, 3)
    )
    done: dict[str, Outcome] = {}
    DEATHS.clear()
    workers = Fragile()
    shift = _Shift(
        workers, deadly, False, lambda chunk, out: done.update(zip(chunk, out, strict=True))
    )
    shift.work(chunks)
    assert DEATHS[8] == 2
    assert workers.restarts == DEATHS.total()
    for key, point in keyed.items():
        dead = point["n"] in (3, 4)
        assert done[key] == Outcome({} if dead else {"x": point["n"]}, WORKER_DIED if dead else "")


def test_an_executor_of_somebody_else_that_breaks_is_one_sentence() -> None:
    class Broken(Inline):
        def submit(self, task: Callable[..., Any], /, *args: Any, **named: Any) -> Future[Any]:
            raise BrokenExecutor

    with pytest.raises(StudyError, match="fresh"):
        sweep(functions.bound, POINTS, executor=Broken())
    with ThreadPoolExecutor(1) as threads:
        pass
    with pytest.raises(StudyError, match="takes no tasks"):
        sweep(functions.bound, POINTS, executor=threads)


def test_ctrl_c_keeps_what_is_done(scratch: Path) -> None:
    (scratch / "ctrl-c").touch()
    folder = scratch / "parts"
    again = functools.partial(
        sweep, functions.counted, functions.COUNTED, folder=folder, executor=Inline(), chunk=2
    )
    with pytest.raises(KeyboardInterrupt):
        again()
    assert len(parts(folder)) == 3
    assert again().equals(serial(functions.counted, functions.COUNTED))
    assert computed(scratch)[5] == 2  # once in the folder, once in the serial run


def test_a_failed_point_records_why_and_stops_nothing(tmp_path: Path) -> None:
    table = serial()
    (row,) = np.flatnonzero(table.failed)
    assert (table["stiffness"][row], table["damping"][row]) == (3000.0, 0.2)
    assert table["error"][row] == 'ValueError: no\r\n"bound", at 1.7\\udc80'
    assert math.isnan(table["needed"][row])
    assert math.isnan(table["passive"][row])
    assert table["verdict"][row] == ""
    rest = table.select(~table.failed)
    assert len(rest) == len(POINTS) - 1
    assert set(rest["passive"]) <= {0.0, 1.0}
    table.write(tmp_path / "table.csv")
    with (tmp_path / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(line["needed"]) for line in rows if not line["error"]] == rest["needed"].tolist()


def test_results_that_no_table_can_hold_are_failures_of_their_point(tmp_path: Path) -> None:
    for _ in range(2):
        table = sweep(functions.oddities, grid(n=range(8)), folder=tmp_path, executor=Inline())
        assert table.failed.tolist() == [False, *[True] * 6, False]
        assert table.results == ("x", "extra", "late")
        np.testing.assert_equal(table["x"], [1.5, *[math.nan] * 6, 2.0])
        assert table["late"].tolist() == [""] * 7 + ["text"]
    assert "not a mapping" in table["error"][1]
    assert "name of another column" in table["error"][3]
    short = sweep(functions.one_too_few, grid(n=range(3)), batched=True, executor=Inline())
    assert all("returned 0 results for 1 points" in text for text in short["error"])


def test_parts_that_were_cut_changed_or_come_from_elsewhere_are_computed_again(
    scratch: Path,
) -> None:
    folder, other = scratch / "mine", scratch / "other"
    again = functools.partial(sweep, executor=Inline(), chunk=1)
    expected = again(functions.counted, functions.COUNTED, folder=folder)
    cut, changed, gone, *_ = parts(folder)
    cut.write_bytes(cut.read_bytes()[:-9])
    changed.write_bytes(changed.read_bytes().replace(b"0.1,", b"0.2,"))
    lost = [int(path.read_text().splitlines()[1].split(",")[1]) for path in (changed, gone)]
    again(functools.partial(functions.plus, more=1), functions.COUNTED, folder=other)
    gone.unlink()
    for path in parts(other):
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / ("part-" + "0" * 32 + ".csv")).write_text("point,kinds,error\n")
    before = computed(scratch)
    assert again(functions.counted, functions.COUNTED, folder=folder).equals(expected)
    fresh = computed(scratch) - before
    assert sum(fresh.values()) == 3
    assert set(lost) <= set(fresh)


def test_other_points_reuse_those_that_are_known(scratch: Path) -> None:
    reports: list[tuple[int, int]] = []
    more = grid(n=range(6, 15), gain=[0.1])
    sweep(functions.counted, functions.COUNTED, folder=scratch / "parts", executor=Inline())
    table = sweep(
        functions.counted,
        more,
        folder=scratch / "parts",
        executor=Inline(),
        progress=lambda done, total: reports.append((done, total)),
    )
    assert set(computed(scratch).values()) == {1}
    assert table["n"].tolist() == list(range(6, 15))
    assert reports[0] == (6, 9)
    assert reports[-1] == (9, 9)


def test_a_folder_of_another_function_or_version_is_refused(tmp_path: Path) -> None:
    sweep(functions.bound, POINTS, folder=tmp_path, executor=Inline())
    with pytest.raises(StudyError, match=r"holds a sweep of sweep_functions\.bound .* start anew"):
        sweep(functions.bound_of_all, POINTS, batched=True, folder=tmp_path, executor=Inline())
    one, two = (functools.partial(functions.plus, more=more) for more in (1, 1 + 2**-52))
    points = grid(n=[1])
    sweep(one, points, folder=tmp_path / "plus", executor=Inline())
    with pytest.raises(StudyError, match=r"more=1\.0000000000000002"):
        sweep(two, points, folder=tmp_path / "plus", executor=Inline())
    manifest = tmp_path / "sweep.json"
    manifest.write_text(manifest.read_text().replace('"hapticbridge": "', '"hapticbridge": "9'))
    with pytest.raises(StudyError, match="by hapticbridge 9"):
        sweep(functions.bound, POINTS, folder=tmp_path, executor=Inline())
    manifest.write_text("[]")
    with pytest.raises(StudyError, match="not the manifest"):
        sweep(functions.bound, POINTS, folder=tmp_path, executor=Inline())


VALUES = st.one_of(
    st.floats(), st.integers(-(2**63), 2**63 - 1), st.booleans(), st.text(max_size=20)
)


@settings(max_examples=60, deadline=None)
@given(values=st.lists(st.tuples(VALUES, VALUES), min_size=1, max_size=5))
@example(
    values=[("", "\n"), ("a\rb", "x"), (-0.0, 5e-324), (True, "True"), (1, 1.0), ("", "nan\0")]
)
@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_every_value_comes_back_from_a_part_with_its_bits(
    tmp_path_factory: pytest.TempPathFactory, form: str, values: list[tuple[Any, Any]]
) -> None:
    def bits(value: object) -> str:
        return value.hex() if isinstance(value, float) else repr(value)

    folder = ResultFolder(tmp_path_factory.mktemp("parts"), "f", form)
    points = {point_key(point): point for point in grid(n=range(len(values)))}
    outcomes = [Outcome({"a": plain(a), "b": plain(b)}, "") for a, b in values]
    outcomes[0] = Outcome({"b": outcomes[0].results["b"]}, "why")
    folder.add(points, outcomes)
    back = folder.read(points)
    for key, outcome in zip(points, outcomes, strict=True):
        assert back[key].error == outcome.error
        assert {name: bits(value) for name, value in back[key].results.items()} == {
            name: bits(value) for name, value in outcome.results.items()
        }


FINITE = st.floats(allow_nan=False, allow_infinity=False)


@given(first=FINITE, second=FINITE)
def test_two_floats_have_one_key_exactly_when_they_have_the_same_bits(
    first: float, second: float
) -> None:
    assert (point_key({"x": first}) == point_key({"x": second})) == (first.hex() == second.hex())
    above = math.nextafter(first, math.inf)
    assert point_key({"x": first}) != point_key({"x": above})
    assert point_key({"x": first, "y": second}) == point_key({"y": second, "x": first})


def test_keys_stay_what_they_are_between_versions() -> None:
    # folders of earlier sweeps depend on it
    key = point_key({"n": 1, "gain": 0.1, "on": True, "tool": "µ"})
    assert key == "863837771cc3867d0a4eed0183a1843b"
    assert len({point_key({"n": value}) for value in (1, 1.0, True, "1")}) == 4


def test_a_grid_turns_its_last_axis_fastest() -> None:
    points = grid(a=[1, 2], b=np.array([0.5, 1.5]), c="x")
    assert [(p["a"], p["b"], p["c"]) for p in points] == [
        *[(1, 0.5, "x"), (1, 1.5, "x")],
        *[(2, 0.5, "x"), (2, 1.5, "x")],
    ]
    assert type(points[0]["b"]) is float


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"points": []}, "no points"),
        ({"points": [{"n": 1}, {"n": 2}, {"n": np.int64(1)}]}, "point 2 is there twice"),
        ({"points": [{"n": math.nan}]}, "point 0: parameter 'n' is nan; it must be finite"),
        ({"points": [{"n": math.inf}]}, "must be finite"),
        ({"points": [{"n": [1]}]}, "neither a number nor a flag nor text"),
        ({"points": [{"n": 2**64}]}, "64 bits"),
        ({"points": [{"n": "\ud800"}]}, "surrogates"),
        ({"points": [{"n": 1}, {"m": 1}]}, "point 1 has the parameters m"),
        ({"points": [{"n": 1}, {"n": "a"}]}, "must be text in all points or in none"),
        ({"points": [{}]}, "no parameters"),
        ({"points": [3]}, "must be a mapping"),
        ({"points": [{"error": 1}]}, "adds that column"),
        ({"points": [{"": 1}]}, "has no name"),
        ({"format": "hdf5"}, "the formats are 'csv', 'parquet'"),
        ({"chunk": 0}, "whole number >= 1"),
        ({"chunk": True}, "whole number >= 1"),
        ({"scheduler": "tcp://127.0.0.1:1"}, "give one of them"),
        ({"function": lambda point: point}, "top level of a module"),
        ({"function": functools.partial(print, Future())}, "cannot be sent"),
    ],
)
def test_what_cannot_be_swept_is_refused_with_a_sentence(
    arguments: dict[str, Any], sentence: str
) -> None:
    usual: dict[str, Any] = {"function": functions.bound, "points": POINTS, "executor": Inline()}
    with pytest.raises(StudyError, match=sentence):
        sweep(**(usual | arguments))


def test_axes_that_span_no_grid_are_refused() -> None:
    unusable: list[dict[str, Any]] = [{}, {"a": []}, {"a": [math.nan]}, {"a": np.eye(2)}]
    for axes in unusable:
        with pytest.raises(StudyError, match="axis"):
            grid(**axes)


def test_a_folder_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(StudyError, match="is not a folder"):
            sweep(functions.bound, POINTS, folder=folder, executor=Inline())
    with pytest.raises(StudyError, match="cannot be made"):
        sweep(functions.bound, POINTS, folder="/proc/nowhere", executor=Inline())
    with pytest.raises(StudyError, match="cannot be written"):
        serial().write(tmp_path / "no" / "where.csv")
    with pytest.raises(StudyError, match="no column 'x'"):
        serial()["x"]


def test_what_is_not_installed_is_named_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("pyarrow", "pyarrow.parquet", "distributed"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(StudyError, match=r"pip install 'hapticbridge\[tables\]'"):
        sweep(functions.bound, POINTS, folder=tmp_path, format="parquet", executor=Inline())
    with pytest.raises(StudyError, match=r"pip install 'hapticbridge\[cluster\]'"):
        sweep(functions.bound, POINTS, scheduler="tcp://127.0.0.1:1")


def test_a_scheduler_that_does_not_answer_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("hapticbridge.study.workers._PATIENCE", 0.2)
    for address in ("tcp://127.0.0.1:1", "nonsense://x"):
        with pytest.raises(StudyError, match="no dask scheduler answers"):
            sweep(functions.bound, POINTS, scheduler=address)


def test_few_tasks_are_in_flight_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    flying: list[tuple[Future[Any], Callable[[], Any]]] = []
    most: list[int] = []

    class Idle(Executor):
        """Works only while somebody waits."""

        def submit(self, task: Callable[..., Any], /, *args: Any, **named: Any) -> Future[Any]:
            flying.append((Future(), functools.partial(task, *args, **named)))
            return flying[-1][0]

    def wait(*arguments: Any, **named: Any) -> Any:
        most.append(len(flying))
        while flying:
            future, work = flying.pop()
            future.set_result(work())
        return concurrent.futures.wait(*arguments, **named)

    monkeypatch.setattr(sys.modules["hapticbridge.study.sweep"], "wait_for", wait)
    half_more = functools.partial(functions.plus, more=0.5)
    table = sweep(half_more, grid(n=range(500)), executor=Idle(), chunk=1)
    assert table["sum"].tolist() == [n + 0.5 for n in range(500)]
    assert max(most) == 64
