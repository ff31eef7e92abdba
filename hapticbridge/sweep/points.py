"""Points of a sweep: checked mappings of parameters, their keys, and grids of them."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterable, Mapping

import numpy as np

from hapticbridge.errors import StudyError

Value = float | int | bool | str
"""Type of a parameter or a result: a number, a flag or text."""

Point = dict[str, Value]
"""Parameters of one evaluation by name."""


def plain(value: object) -> Value:
    """Converts a value to Python's own float, int, bool or str.

    Every NaN becomes the same NaN, so that equal tables are equal in their bits.

    Raises:
        ValueError: The value has another type, is an integer beyond 64 bits, or is text that
            has no UTF-8 form.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise ValueError(f"the integer {value:.3e} does not fit into 64 bits")
    if isinstance(value, float):
        return math.nan if math.isnan(value) else float(value)
    if isinstance(value, str):
        value.encode()
    if isinstance(value, bool | int | str):
        return value
    raise ValueError(f"{value!r:.60} is neither a number nor a flag nor text")


def point_key(point: Mapping[str, Value]) -> str:
    """Returns the key of a point: its names in order with their values, as JSON.

    Floats enter with all their digits, so 0.1 + 0.2 and 0.3 are two points. 1, 1.0 and True are
    three points, because a function may distinguish them.
    """
    return json.dumps(point, sort_keys=True)


def grid(**axes: object) -> list[Point]:
    """Combines the values of several axes; the last axis varies fastest.

    Args:
        axes: For each parameter its values, or one value for all points.

    Raises:
        StudyError: There is no axis, an axis is empty or not one-dimensional, or a value is not a
            finite number, a flag or text.
    """
    if not axes:
        raise StudyError("a grid needs at least one axis")
    values = []
    for name, axis in axes.items():
        is_single = isinstance(axis, str | bytes) or not isinstance(axis, Iterable)
        row = [axis] if is_single else list(axis)  # type: ignore[call-overload]
        if not row:
            raise StudyError(f"axis '{name}' is empty; it must hold at least one value")
        values.append([_parameter(value, f"axis '{name}'") for value in row])
    return [dict(zip(axes, combined, strict=True)) for combined in itertools.product(*values)]


def checked_points(points: Iterable[Mapping[str, object]]) -> dict[str, Point]:
    """Returns points by their keys, in order, with plain values.

    Raises:
        StudyError: There is no point, a point is no mapping, repeats another one or has other
            parameters than the first, or a value is out of range. The message names the point.
    """
    found: dict[str, Point] = {}
    names: list[str] = []
    for number, raw in enumerate(points):
        if not isinstance(raw, Mapping) or not raw:
            raise StudyError(f"point {number} is {raw!r:.60}; it must be a mapping of parameters")
        point = {
            name: _parameter(value, f"point {number}: parameter '{name}'")
            for name, value in raw.items()
        }
        names = names or sorted(point)
        if sorted(point) != names:
            raise StudyError(
                f"point {number} has the parameters {', '.join(point)}; the first point has "
                f"{', '.join(names)}"
            )
        if "error" in point:
            raise StudyError("no parameter may be named 'error': the sweep adds that column")
        if point_key(point) in found:
            raise StudyError(f"point {number} is there twice: {point!r:.200}")
        found[point_key(point)] = point
    if not found:
        raise StudyError("there are no points; a sweep needs at least one")
    return found


def _parameter(value: object, place: str) -> Value:
    try:
        found = plain(value)
    except ValueError as error:
        raise StudyError(f"{place}: {error}") from None
    if isinstance(found, float) and not math.isfinite(found):
        raise StudyError(f"{place} is {found}; it must be finite")
    return found
