"""Maps in general: files, resumption, failures, and the command."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from hapticbridge.cli import main
from hapticbridge.errors import StudyError
from hapticbridge.lab.maps import MAPS
from hapticbridge.lab.maps.base import (
    COLOURS,
    FILLED,
    VERDICTS,
    Point,
    Sentences,
    StabilityMap,
    draw_verdicts,
    run_map,
    verdict_numbers,
)
from hapticbridge.plotting import new_figure
from hapticbridge.sweep import Outcome, Table, table_of

calls: list[Point] = []


def points(count: int) -> Sequence[Point]:
    return [{"x": float(i)} for i in range(count)]


def square(point: Point) -> Mapping[str, float]:
    calls.append(point)
    x = float(point["x"])
    if x == 3.0:
        raise ValueError("three is no good")
    return {"y": x * x}


def fail(point: Point) -> Mapping[str, float]:
    raise ValueError(f"nothing at {point['x']}")


def summarize(table: Table) -> Mapping[str, Any]:
    return {"rows": len(table), "largest": table.numbers("y").max()}


def draw(_table: Table, _boundary: Mapping[str, Any]) -> Figure:
    return new_figure(4, 3)


def sentences(boundary: Mapping[str, Any]) -> Sentences:
    yield "the largest is {largest:g}", boundary


SQUARES = StabilityMap(
    name="squares",
    doc="Map ``squares``: numbers squared.",
    default_points=6,
    points=points,
    evaluate=square,
    summarize=summarize,
    draw=draw,
    sentences=sentences,
    twins=MAPS["restitution"].twins,
)


def test_a_map_writes_its_files_and_says_which_points_failed(tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        files = run_map(SQUARES, tmp_path / "new", workers=pool)
    assert files.failed == 1
    assert "three is no good" in files.table.read_text(encoding="utf-8")
    said = json.loads(files.boundary.read_text(encoding="utf-8"))
    assert said["points"] == 6
    assert said["boundary"] == {"rows": 5, "largest": 25.0}
    assert said["about"] == "numbers squared"
    assert said["paragraph"] == "the largest is 25."
    assert files.picture.read_bytes().startswith(b"\x89PNG")


def test_a_map_begun_again_computes_only_what_is_missing(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as pool:
        run_map(SQUARES, tmp_path, points=5, workers=pool)
        calls.clear()
        files = run_map(SQUARES, tmp_path, points=8, workers=pool)
    assert sorted(point["x"] for point in calls) == [5.0, 6.0, 7.0]
    assert files.finding.paragraph == "the largest is 49."


def test_a_map_can_keep_its_table_as_parquet(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as pool:
        files = run_map(SQUARES, tmp_path, workers=pool, form="parquet")
    assert files.table.name == "squares.parquet"
    assert files.table.read_bytes().startswith(b"PAR1")


def test_a_map_of_failures_is_an_error_that_says_the_first(tmp_path: Path) -> None:
    broken = replace(SQUARES, name="broken", evaluate=fail)
    with ThreadPoolExecutor(1) as pool, pytest.raises(StudyError, match=r"nothing at 0\.0"):
        run_map(broken, tmp_path, workers=pool)


def test_too_few_points_and_a_file_for_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match="points is 3"):
        run_map(SQUARES, tmp_path, points=3)
    blocker = tmp_path / "file"
    blocker.write_text("")
    with pytest.raises(StudyError, match="folder"):
        run_map(SQUARES, blocker)


def test_a_file_that_cannot_be_written_is_noticed_before_the_sweep(tmp_path: Path) -> None:
    (tmp_path / "squares.png").mkdir()
    calls.clear()
    with ThreadPoolExecutor(1) as pool, pytest.raises(StudyError, match=r"squares\.png"):
        run_map(SQUARES, tmp_path, workers=pool)
    assert not calls
    assert not (tmp_path / "squares.csv").exists()


def fail_to_read(_table: Table) -> Mapping[str, Any]:
    raise ZeroDivisionError


def test_the_table_is_kept_even_if_reading_it_fails(tmp_path: Path) -> None:
    unread = replace(SQUARES, name="unread", summarize=fail_to_read)
    with ThreadPoolExecutor(1) as pool, pytest.raises(ZeroDivisionError):
        run_map(unread, tmp_path, workers=pool)
    assert (tmp_path / "unread.csv").read_text(encoding="utf-8").count("\n") == 7


def test_an_unstable_loop_is_unstable_whatever_its_environment() -> None:
    names = np.array(["strict", "active", "within slack", "strict"], dtype=object)
    numbers = verdict_numbers([True, True, True, False], names)
    assert [VERDICTS[i] for i in numbers] == ["strict", "active", "within slack", "unstable"]


@pytest.mark.parametrize("side", [FILLED - 1, FILLED])
def test_a_coarse_grid_is_drawn_as_points_that_claim_nothing_between(side: int) -> None:
    axes = new_figure(4, 4).subplots()
    x, y = (each.ravel() for each in np.meshgrid(np.arange(side), np.arange(side)))
    verdict = (x > 2).astype(np.int64)
    draw_verdicts(axes, x.astype(float), y.astype(float), verdict)
    (drawn,) = axes.collections
    is_coarse = side < FILLED
    assert (type(drawn).__name__ == "PathCollection") == is_coarse
    if is_coarse:
        assert len(np.asarray(drawn.get_offsets())) == side**2
        seen = {to_hex(colour) for colour in np.asarray(drawn.get_facecolor())}
        assert seen == {COLOURS[0].lower(), COLOURS[1].lower()}


def test_command_lists_the_maps_for_an_unknown_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stability", "couplings"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    for name in (*MAPS, "all"):
        assert f"'{name}'" in said


@pytest.mark.parametrize("name", MAPS)
def test_a_table_without_a_computed_row_is_refused(name: str) -> None:
    given = MAPS[name].points(4)
    table = table_of(given, [Outcome({}, "SceneError: no") for _ in given])
    with pytest.raises(StudyError, match="no point could be computed; first: SceneError: no"):
        MAPS[name].read(table)
    with pytest.raises(StudyError, match=f"map '{name}': the table has no rows"):
        MAPS[name].read(table.select(table.failed & ~table.failed))
