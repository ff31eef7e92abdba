"""Values that a script's option refuses in a sentence."""

from __future__ import annotations

import argparse
import runpy
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
