"""Runs of several ways side by side, and the medians of their passes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np

Name = TypeVar("Name")
Result = TypeVar("Result")


def in_turn(
    ways: Mapping[Name, Callable[[], Result]], passes: int, *, warms: bool = True
) -> dict[Name, list[Result]]:
    """Runs every way once in each pass, so that a busy machine is as busy for each of them.

    A pass before the first one compiles and fills caches; it does not count.
    """
    found: dict[Name, list[Result]] = {name: [] for name in ways}
    for turn in range(-1 if warms else 0, passes):
        for name, way in ways.items():
            result = way()
            if turn >= 0:
                found[name].append(result)
    return found


def interval(values: Sequence[float]) -> str:
    """Returns the median ratio of the passes, their range, and the range's confidence level."""
    sure = 1 - 2 ** (1 - len(values))
    return f"{np.median(values):.3f} x ({min(values):.3f} to {max(values):.3f}, {100 * sure:.0f} %)"
