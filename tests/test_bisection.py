"""The search that all maps share."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticbridge.errors import StudyError
from hapticbridge.lab.maps.base import Bracket, agreement, largest_stable


@given(limit=st.floats(0.011, 90.0), width=st.floats(1e-6, 0.1))
def test_a_search_ends_with_the_limit_in_a_bracket_of_its_width(limit: float, width: float) -> None:
    found = largest_stable(lambda x: x <= limit, 0.01, 100.0, width)
    assert found.lower <= limit <= found.upper
    assert found.upper <= found.lower * (1 + width)
    assert found.lower <= found.middle <= found.upper
    assert abs(found.middle / limit - 1) <= width / 2 * 1.001


def test_a_limit_beyond_an_end_is_said_and_not_made_up() -> None:
    assert largest_stable(lambda _: False, 1.0, 2.0) == Bracket(0.0, 1.0)
    assert largest_stable(lambda _: False, 1.0, 2.0).middle == 0.0
    assert largest_stable(lambda _: True, 1.0, 2.0) == Bracket(2.0, math.inf)
    assert largest_stable(lambda _: True, 1.0, 2.0).middle == math.inf


def test_an_agreement_is_never_finer_than_half_the_search() -> None:
    assert agreement([1.0001], [1.0], 0.002) == 0.001
    assert agreement([1.0, 0.9], [1.0, 1.0], 0.002) == pytest.approx(0.1)
    assert agreement([math.nan], [1.0]) is None
    assert agreement([], []) is None


def test_a_search_without_a_range_is_refused() -> None:
    with pytest.raises(StudyError, match="0 < lower < upper"):
        largest_stable(lambda _: True, 0.0, 1.0)
