"""What JSON cannot hold is left out of it."""

from __future__ import annotations

import json
import math

from hapticbridge.files import finite_or_null


def test_numbers_that_are_not_finite_become_null_as_deep_as_they_lie() -> None:
    facts = {"a": math.nan, "b": [1.5, -math.inf, (math.inf, "x")], "c": {"d": {"e": math.nan}}}
    told = json.dumps(finite_or_null(facts), allow_nan=False)
    assert json.loads(told) == {"a": None, "b": [1.5, None, [None, "x"]], "c": {"d": {"e": None}}}


def test_everything_else_stays_as_it_is() -> None:
    facts = {"n": 3, "t": True, "s": "nan", "x": 0.0, "none": None, "l": []}
    assert finite_or_null(facts) == facts
