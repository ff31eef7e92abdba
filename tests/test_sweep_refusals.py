"""What cannot be swept, and workers that cannot be had, are one sentence."""

from __future__ import annotations

import functools
import math
import socket
import sys
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sweep_functions as functions
from sweep_runs import POINTS, serial

from hapticbridge.errors import StudyError
from hapticbridge.sweep.points import grid
from hapticbridge.sweep.sweep import InThisProcess, sweep


def test_an_executor_of_somebody_else_that_breaks_is_one_sentence() -> None:
    class Broken(InThisProcess):
        def submit(self, task: Callable[..., Any], /, *args: Any, **named: Any) -> Future[Any]:
            raise BrokenExecutor

    with pytest.raises(StudyError, match="fresh"):
        sweep(functions.bound, POINTS, executor=Broken())
    with ThreadPoolExecutor(1) as threads:
        pass
    with pytest.raises(StudyError, match="takes no tasks"):
        sweep(functions.bound, POINTS, executor=threads)


def test_a_folder_of_another_function_or_version_is_refused(tmp_path: Path) -> None:
    sweep(functions.bound, POINTS, folder=tmp_path, executor=InThisProcess())
    with pytest.raises(StudyError, match=r"holds a sweep of sweep_functions\.bound .* start anew"):
        sweep(
            functions.bound_of_all, POINTS, batched=True, folder=tmp_path, executor=InThisProcess()
        )
    one, two = (functools.partial(functions.plus, more=more) for more in (1, 1 + 2**-52))
    points = grid(n=[1])
    sweep(one, points, folder=tmp_path / "plus", executor=InThisProcess())
    with pytest.raises(StudyError, match=r"more=1\.0000000000000002"):
        sweep(two, points, folder=tmp_path / "plus", executor=InThisProcess())
    manifest = tmp_path / "sweep.json"
    manifest.write_text(manifest.read_text().replace('"hapticbridge": "', '"hapticbridge": "9'))
    with pytest.raises(StudyError, match="by hapticbridge 9"):
        sweep(functions.bound, POINTS, folder=tmp_path, executor=InThisProcess())
    manifest.write_text("[]")
    with pytest.raises(StudyError, match="not the manifest"):
        sweep(functions.bound, POINTS, folder=tmp_path, executor=InThisProcess())


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
    usual: dict[str, Any] = {
        "function": functions.bound,
        "points": POINTS,
        "executor": InThisProcess(),
    }
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
            sweep(functions.bound, POINTS, folder=folder, executor=InThisProcess())
    with pytest.raises(StudyError, match="cannot be made"):
        sweep(functions.bound, POINTS, folder="/proc/nowhere", executor=InThisProcess())
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
        sweep(functions.bound, POINTS, folder=tmp_path, format="parquet", executor=InThisProcess())
    with pytest.raises(StudyError, match=r"pip install 'hapticbridge\[cluster\]'"):
        sweep(functions.bound, POINTS, scheduler="tcp://127.0.0.1:1")


def test_a_scheduler_that_does_not_answer_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody listens, there is no such protocol, or somebody listens and says nothing."""
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(sys.modules["hapticbridge.sweep.sweep"], "_PATIENCE", 0.2)
    # a client that was refused is given up after 10 s, with a traceback that nobody can catch
    monkeypatch.setattr(distributed, "Client", None)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        for address in ("tcp://127.0.0.1:1", "nonsense://x", f"tcp://127.0.0.1:{port}"):
            with pytest.raises(StudyError, match="no dask scheduler answers") as refusal:
                sweep(functions.bound, POINTS, scheduler=address)
            assert address in str(refusal.value)
            assert "()" not in str(refusal.value)
