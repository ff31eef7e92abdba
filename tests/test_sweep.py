"""A sweep gives the same table on any workers and after any interruption."""

from __future__ import annotations

import asyncio
import csv
import functools
import math
import os
import re
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sweep_functions as functions
from hypothesis import example, given, settings
from hypothesis import strategies as st

import hapticbridge
from hapticbridge.errors import StudyError
from hapticbridge.files import install_command
from hapticbridge.signals import holding_interrupts
from hapticbridge.sweep import (
    WORKER_DIED,
    Interrupted,
    Outcome,
    ResultFile,
    Table,
    cores,
    grid,
    plain,
    point_key,
    sweep,
)

POINTS = grid(stiffness=[1000, 3000.0, 1e4 / 3], damping=np.linspace(0.1, 0.3, 3), tool="peg")


def computed(scratch: Path) -> Counter[int]:
    return Counter(map(int, (scratch / "computed").read_text().split()))


def serial(function: Callable[[Any], Any] = functions.bound, points: Any = POINTS) -> Table:
    return sweep(function, points, workers=1)


def kept(path: Path) -> list[str]:
    """Returns the lines of a file of results below the first."""
    return path.read_text().splitlines()[1:]


def is_same(first: Table, second: Table) -> bool:
    """Tells whether two tables have the same columns, types and bits."""
    return list(first.columns) == list(second.columns) and all(
        column.dtype == other.dtype
        and (column.tolist() if column.dtype == object else column.tobytes())
        == (other.tolist() if other.dtype == object else other.tobytes())
        for column, other in zip(first.columns.values(), second.columns.values(), strict=True)
    )


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
        assert is_same(sweep(functions.bound, POINTS, workers=threads, chunk=1), expected)
    assert is_same(sweep(functions.bound, POINTS, workers=2), expected)
    for _ in range(2):  # computed, then read
        again = sweep(functions.bound, POINTS, results=tmp_path / "kept", chunk=2, workers=1)
        assert is_same(again, expected)


def test_a_dask_cluster_of_two_workers_gives_the_same_bits() -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, processes=True, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        table = sweep(functions.bound, POINTS, workers=cluster.scheduler_address, chunk=1)
        assert is_same(table, serial())


def test_a_scheduler_that_does_not_answer_is_refused_beside_a_running_loop_too() -> None:
    pytest.importorskip("distributed")

    async def notebook() -> None:  # it runs a loop in the thread that sweeps
        sweep(functions.bound, POINTS, workers="tcp://127.0.0.1:1")

    with pytest.raises(StudyError, match=r"no dask scheduler answers at 'tcp://127\.0\.0\.1:1'"):
        asyncio.run(notebook())


def test_the_order_of_rows_is_that_of_points_whatever_ends_first() -> None:
    with ThreadPoolExecutor(2) as threads:
        table = sweep(functions.last_ends_first, grid(n=range(8)), workers=threads, chunk=1)
    assert table["square"].tolist() == [n * n for n in range(8)]
    assert table["square"].dtype == np.int64


def test_a_failed_point_records_why_and_stops_nothing(tmp_path: Path) -> None:
    table = serial()
    (row,) = np.flatnonzero(table.failed)
    assert (table["stiffness"][row], table["damping"][row]) == (3000.0, 0.2)
    assert table["error"][row] == 'ValueError: no\r\n"bound", at 1.7\\udc80'
    assert math.isnan(table["needed"][row])
    assert table["verdict"][row] == ""
    rest = table.select(~table.failed)
    assert len(rest) == len(POINTS) - 1
    table.write(tmp_path / "table.csv")
    with (tmp_path / "table.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [float(line["needed"]) for line in rows if not line["error"]] == rest["needed"].tolist()


def test_results_that_no_table_can_hold_are_failures_of_their_point(tmp_path: Path) -> None:
    for _ in range(2):
        table = sweep(functions.oddities, grid(n=range(8)), results=tmp_path / "kept", workers=1)
        assert table.failed.tolist() == [False, *[True] * 6, False]
        np.testing.assert_equal(table["x"], [1.5, *[math.nan] * 6, 2.0])
        assert table["late"].tolist() == [""] * 7 + ["text"]
    assert "not a mapping" in table["error"][1]
    assert "name of another column" in table["error"][3]


def test_other_points_reuse_those_that_are_known(scratch: Path) -> None:
    reports: list[tuple[int, int]] = []
    sweep(functions.counted, functions.COUNTED, results=scratch / "kept", workers=1)
    table = sweep(
        functions.counted,
        grid(n=range(6, 15), gain=[0.1]),
        results=scratch / "kept",
        workers=1,
        progress=lambda done, total: reports.append((done, total)),
    )
    assert set(computed(scratch).values()) == {1}
    assert table["n"].tolist() == list(range(6, 15))
    assert reports[0] == (6, 9)
    assert reports[-1] == (9, 9)


VALUES = st.one_of(
    st.floats(), st.integers(-(2**63), 2**63 - 1), st.booleans(), st.text(max_size=20)
)


@settings(max_examples=25)
@given(values=st.lists(st.tuples(VALUES, VALUES), min_size=1, max_size=5))
@example(values=[("", "\n"), ("a\rb", "x"), (-0.0, 5e-324), (True, "True"), (1, 1.0)])
def test_every_value_comes_back_from_the_file_with_its_bits(
    tmp_path_factory: pytest.TempPathFactory, values: list[tuple[Any, Any]]
) -> None:
    def bits(value: object) -> str:
        return value.hex() if isinstance(value, float) else repr(value)

    path = tmp_path_factory.mktemp("results") / "kept"
    points = grid(n=range(len(values)))
    outcomes = [Outcome({"a": plain(a), "b": plain(b)}) for a, b in values]
    outcomes[0] = Outcome({"b": outcomes[0].results["b"]}, "why")
    ResultFile(path, "f").add(points, outcomes)
    back = ResultFile(path, "f").read([*map(point_key, points)])
    for point, outcome in zip(points, outcomes, strict=True):
        assert back[point_key(point)].error == outcome.error
        read = back[point_key(point)].results
        assert {name: bits(value) for name, value in read.items()} == {
            name: bits(value) for name, value in outcome.results.items()
        }


FINITE = st.floats(allow_nan=False, allow_infinity=False)


@given(first=FINITE, second=FINITE)
def test_two_floats_have_one_key_exactly_when_they_have_the_same_bits(
    first: float, second: float
) -> None:
    assert (point_key({"x": first}) == point_key({"x": second})) == (first.hex() == second.hex())
    assert point_key({"x": first}) != point_key({"x": math.nextafter(first, math.inf)})
    assert point_key({"x": first, "y": second}) == point_key({"y": second, "x": first})


def test_values_of_different_types_have_different_keys() -> None:
    assert len({point_key({"n": value}) for value in (1, 1.0, True, "1")}) == 4


def test_a_grid_turns_its_last_axis_fastest() -> None:
    points = grid(a=[1, 2], b=np.array([0.5, 1.5]), c="x")
    assert [(p["a"], p["b"], p["c"]) for p in points] == [
        *[(1, 0.5, "x"), (1, 1.5, "x")],
        *[(2, 0.5, "x"), (2, 1.5, "x")],
    ]
    assert type(points[0]["b"]) is float


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
    assert marker == "kill" or not killed.stderr
    path = scratch / "kept"
    count = len(kept(path))
    assert 0 < count < len(functions.COUNTED)
    resumed = sweep(functions.counted, functions.COUNTED, results=path, workers=1)
    often = computed(scratch)
    # in flight were at most two tasks a worker; they are computed again, and no kept point is
    assert sum(often.values()) - len(functions.COUNTED) <= len(functions.COUNTED) - count
    assert sum(times > 1 for times in often.values()) <= 2 * (os.cpu_count() or 1)
    assert is_same(resumed, serial(functions.counted, functions.COUNTED))


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_ctrl_c_while_workers_start_ends_them_without_a_word(scratch: Path) -> None:
    (scratch / "start").touch()
    program = [sys.executable, functions.__file__]
    stopped = subprocess.run(
        program, capture_output=True, timeout=60, start_new_session=True, check=False
    )
    assert not (scratch / "start").exists()
    assert (stopped.returncode, stopped.stdout, stopped.stderr) == (77, b"", b"")
    assert kept(scratch / "kept") == []


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_interrupts_are_held_for_a_while_and_then_arrive() -> None:
    def is_held() -> bool:
        return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())

    def interrupt() -> None:
        gate.wait()
        signal.raise_signal(signal.SIGINT)  # this thread takes what the main thread holds back

    done, gate = [], threading.Event()
    other = threading.Thread(target=interrupt)
    other.start()
    with pytest.raises(KeyboardInterrupt), holding_interrupts():
        assert is_held()
        with holding_interrupts():
            gate.set()
            other.join()
        done.append("all of it")
    assert done
    assert not is_held()


def test_a_worker_that_is_killed_once_costs_nothing(scratch: Path) -> None:
    (scratch / "die").touch()
    table = sweep(functions.counted, functions.COUNTED, chunk=4, workers=2)
    assert not (scratch / "die").exists()
    assert is_same(table, serial(functions.counted, functions.COUNTED))


def test_points_that_end_their_worker_are_found_and_recorded(scratch: Path) -> None:
    (scratch / "poison").touch()
    table = sweep(functions.counted, functions.COUNTED, chunk=3, workers=2)
    assert table["n"][table.failed].tolist() == [3, 4]
    assert set(table["error"][table.failed]) == {WORKER_DIED}


def test_ctrl_c_keeps_what_is_done(scratch: Path) -> None:
    (scratch / "ctrl-c").touch()
    again = functools.partial(
        sweep, functions.counted, functions.COUNTED, results=scratch / "kept", workers=1, chunk=2
    )
    with pytest.raises(Interrupted) as stop:
        again()
    assert len(kept(scratch / "kept")) == 6
    whole = serial(functions.counted, functions.COUNTED)
    assert is_same(stop.value.table, whole.select(np.arange(6)))
    assert is_same(again(), whole)
    assert computed(scratch)[5] == 2  # once in the file, once in the serial run


def test_a_line_that_a_crash_has_cut_is_computed_again(scratch: Path) -> None:
    path = scratch / "kept"
    again = functools.partial(
        sweep, functions.counted, functions.COUNTED, results=path, workers=1, chunk=1
    )
    expected = again()
    path.write_bytes(path.read_bytes()[:-9])
    for _ in range(2):
        assert is_same(again(), expected)
    assert computed(scratch)[11] == 2


def test_a_file_of_another_function_or_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "kept"
    sweep(functions.bound, POINTS, results=path, workers=1)
    with pytest.raises(StudyError, match=r"holds a sweep of sweep_functions\.bound .* start anew"):
        sweep(functions.counted, POINTS, results=path, workers=1)
    one, two = (functools.partial(functions.plus, more=more) for more in (1, 1 + 2**-52))
    points = grid(n=[1])
    sweep(one, points, results=tmp_path / "plus", workers=1)
    with pytest.raises(StudyError, match=r"more=1\.0000000000000002"):
        sweep(two, points, results=tmp_path / "plus", workers=1)
    kept = path.read_text()
    for name, words in (
        ("hapticbridge", "by hapticbridge 9"),
        ("mujoco", "or by other sources or another MuJoCo than now"),
        ("sources", "or by other sources or another MuJoCo than now"),
    ):
        path.write_text(kept.replace(f'"{name}": "', f'"{name}": "9'))
        with pytest.raises(StudyError, match=words):
            sweep(functions.bound, POINTS, results=path, workers=1)
    path.write_text("[]")
    with pytest.raises(StudyError, match="holds a sweep of None"):
        sweep(functions.bound, POINTS, results=path, workers=1)


def test_a_file_belongs_to_the_packages_sources_and_not_to_those_beside_it(tmp_path: Path) -> None:
    """A package that is installed lies in a folder of many others."""
    (tmp_path / "hapticbridge").symlink_to(Path(hapticbridge.__file__).parent)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    first: list[str] = []
    for other in ("value = 1", "value = 2"):
        (tmp_path / "other.py").write_text(other)
        kept = tmp_path / f"kept{len(first)}"
        program = (
            "from sweep_functions import bound, grid, sweep; "
            f"sweep(bound, grid(stiffness=[1.0], damping=[0.1]), results={str(kept)!r}, workers=1)"
        )
        command = [sys.executable, "-c", program]
        subprocess.run(command, check=True, env=environment, cwd=tmp_path)
        first.append(kept.read_text().splitlines()[0])
    assert first[0] == first[1]


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
        ({"points": [{}]}, "must be a mapping"),
        ({"points": [3]}, "must be a mapping"),
        ({"points": [{"error": 1}]}, "adds that column"),
        ({"chunk": 0}, "whole number >= 1"),
        ({"chunk": True}, "whole number >= 1"),
        ({"workers": 0}, "whole number >= 1"),
        ({"workers": 1.5}, "whole number >= 1"),
        ({"function": lambda point: point}, "top level of a module"),
        ({"function": functools.partial(print, Future())}, "cannot be sent"),
    ],
)
def test_what_cannot_be_swept_is_refused_with_a_sentence(
    arguments: dict[str, Any], sentence: str
) -> None:
    usual: dict[str, Any] = {"function": functions.bound, "points": POINTS, "workers": 1}
    with pytest.raises(StudyError, match=sentence):
        sweep(**(usual | arguments))


def test_axes_that_span_no_grid_are_refused() -> None:
    unusable: list[dict[str, Any]] = [{}, {"a": []}, {"a": [math.nan]}, {"a": np.eye(2)}]
    for axes in unusable:
        with pytest.raises(StudyError, match="axis"):
            grid(**axes)


def test_a_file_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file" / "below", Path("/proc/nowhere/kept")):
        with pytest.raises(StudyError, match="cannot write"):
            sweep(functions.bound, POINTS, results=path, workers=1)
    with pytest.raises(StudyError, match="cannot write"):
        serial().write(tmp_path / "no" / "where.csv")
    with pytest.raises(StudyError, match="the formats are 'csv', 'parquet'"):
        serial().write(tmp_path / "table.hdf5")


def test_what_is_not_installed_is_named_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("pyarrow", "pyarrow.parquet", "distributed"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(StudyError, match=re.escape(install_command("tables"))):
        serial().write(tmp_path / "table.parquet")
    with pytest.raises(StudyError, match=re.escape(install_command("cluster"))):
        sweep(functions.bound, POINTS, workers="tcp://127.0.0.1:1")
