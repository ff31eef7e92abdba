"""What JSON cannot hold is left out of it."""

from __future__ import annotations

import json
import math

import pytest

from hapticbridge.files import finite_or_null, read_json


def test_numbers_that_are_not_finite_become_null_as_deep_as_they_lie() -> None:
    facts = {"a": math.nan, "b": [1.5, -math.inf, (math.inf, "x")], "c": {"d": {"e": math.nan}}}
    told = json.dumps(finite_or_null(facts), allow_nan=False)
    assert json.loads(told) == {"a": None, "b": [1.5, None, [None, "x"]], "c": {"d": {"e": None}}}


def test_everything_else_stays_as_it_is() -> None:
    facts = {"n": 3, "t": True, "s": "nan", "x": 0.0, "none": None, "l": []}
    assert finite_or_null(facts) == facts


@pytest.mark.parametrize("text", ["", "nan?", "{", "1" * 5000, "[" * 100_000, b"\xff"])
def test_what_is_no_json_is_one_kind_of_error(text: str | bytes) -> None:
    with pytest.raises(ValueError):
        read_json(text)


def test_json_is_read_as_it_was_written() -> None:
    assert read_json(b'{"a": [1, 2.5, null]}') == read_json('{"a": [1, 2.5, null]}')
    assert read_json("[1]") == [1]
