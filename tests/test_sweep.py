"""A sweep gives the same table on any workers."""

from __future__ import annotations

import concurrent.futures
import csv
import functools
import math
import os
import sys
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sweep_functions as functions
from hypothesis import example, given, settings
from hypothesis import strategies as st
from sweep_runs import POINTS, computed, serial

from hapticbridge.errors import StudyError
from hapticbridge.sweep.points import grid, plain, point_key
from hapticbridge.sweep.results import Outcome, ResultFolder
from hapticbridge.sweep.sweep import InThisProcess, cores, sweep


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
                executor=InThisProcess(),
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
        table = sweep(
            functions.oddities, grid(n=range(8)), folder=tmp_path, executor=InThisProcess()
        )
        assert table.failed.tolist() == [False, *[True] * 6, False]
        assert table.results == ("x", "extra", "late")
        np.testing.assert_equal(table["x"], [1.5, *[math.nan] * 6, 2.0])
        assert table["late"].tolist() == [""] * 7 + ["text"]
    assert "not a mapping" in table["error"][1]
    assert "name of another column" in table["error"][3]
    short = sweep(functions.one_too_few, grid(n=range(3)), batched=True, executor=InThisProcess())
    assert all("returned 0 results for 1 points" in text for text in short["error"])


def test_other_points_reuse_those_that_are_known(scratch: Path) -> None:
    reports: list[tuple[int, int]] = []
    more = grid(n=range(6, 15), gain=[0.1])
    sweep(functions.counted, functions.COUNTED, folder=scratch / "parts", executor=InThisProcess())
    table = sweep(
        functions.counted,
        more,
        folder=scratch / "parts",
        executor=InThisProcess(),
        progress=lambda done, total: reports.append((done, total)),
    )
    assert set(computed(scratch).values()) == {1}
    assert table["n"].tolist() == list(range(6, 15))
    assert reports[0] == (6, 9)
    assert reports[-1] == (9, 9)


VALUES = st.one_of(
    st.floats(), st.integers(-(2**63), 2**63 - 1), st.booleans(), st.text(max_size=20)
)


@settings(max_examples=60)
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

    monkeypatch.setattr(sys.modules["hapticbridge.sweep.sweep"], "wait_for", wait)
    half_more = functools.partial(functions.plus, more=0.5)
    table = sweep(half_more, grid(n=range(500)), executor=Idle(), chunk=1)
    assert table["sum"].tolist() == [n + 0.5 for n in range(500)]
    assert max(most) == 64
