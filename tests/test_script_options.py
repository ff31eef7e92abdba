"""Values that a script's option refuses in a sentence."""

from __future__ import annotations

import argparse
import runpy
import sys
from functools import partial
from pathlib import Path

import pytest

TYPES = runpy.run_path(str(Path(__file__).parents[1] / "scripts" / "argument_types.py"))


def test_a_number_in_range_is_returned() -> None:
    assert TYPES["whole"]("12") == 12
    assert TYPES["positive"]("1e-3") == 1e-3


@pytest.mark.parametrize("text", ["0", "-3", "1.5", "", "x", "²"])
def test_what_is_no_count_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="no whole number of 1 or more"):
        TYPES["whole"](text)


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "1e999", "", "x"])
def test_what_is_no_positive_number_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="no number above 0"):
        TYPES["positive"](text)


def test_a_file_to_write_is_refused_before_the_work_if_it_cannot_be(tmp_path: Path) -> None:
    assert TYPES["new_file"](str(tmp_path / "found.json")) == tmp_path / "found.json"
    assert TYPES["new_file"]("found.json") == Path("found.json")
    for path in (tmp_path, tmp_path / "none" / "found.json"):
        with pytest.raises(argparse.ArgumentTypeError, match="no file in an existing folder"):
            TYPES["new_file"](str(path))


SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.mark.parametrize("name", sorted(file.stem for file in (SCRIPTS / "benches").glob("*.py")))
def test_every_bench_says_what_it_measures_and_takes_json(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "path", [str(SCRIPTS), *sys.path])
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    monkeypatch.setattr(sys, "argv", ["bench", name, "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(SCRIPTS / "bench"), run_name="__main__")
    shown = capsys.readouterr().out
    assert ended.value.code == 0
    assert "--json FILE" in shown
    assert len(shown.split("\n\n")[1]) > 40  # its docstring


def test_ways_run_in_turn_and_the_first_pass_does_not_count() -> None:
    measuring = runpy.run_path(str(SCRIPTS / "measuring.py"))
    calls: list[str] = []

    def called(name: str) -> int:
        calls.append(name)
        return len(calls)

    ways = {name: partial(called, name) for name in "ab"}
    assert measuring["in_turn"](ways, 2) == {"a": [3, 5], "b": [4, 6]}
    assert calls == [*"ababab"]
    assert measuring["interval"]([1.0, 1.2, 1.1]) == "1.100 x (1.000 to 1.200, 75 %)"
