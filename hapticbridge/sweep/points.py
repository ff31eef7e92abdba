"""The points of a sweep: what a point may hold, its key, and the grid of several axes."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterable, Mapping

import numpy as np

from hapticbridge.errors import StudyError

Value = float | int | bool | str
"""What a point or a result holds: a number, a flag or text."""

Point = dict[str, Value]
"""One point of a sweep: parameter names and their values."""

RESERVED = ("point", "kinds", "error")
"""Columns that a sweep adds itself."""

LONGEST_TEXT = 10_000
"""Letters; the csv module reads no field beyond 131 072, and nobody reads these."""

_KINDS = {bool: "b", int: "i", float: "f", str: "s"}


def plain(value: object) -> Value:
    """Returns a value as Python's own float, int, bool or str, NumPy's scalars included.

    Every NaN becomes the same one, so that equal tables are equal in their bits.

    Raises:
        ValueError: It is something else, an integer beyond 64 bits, or text that is too long or
            is no Unicode.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return value
    if isinstance(value, int):
        if not -(2**63) <= value < 2**63:
            raise ValueError(f"the integer {value:.3e} does not fit into 64 bits")
        return int(value)
    if isinstance(value, float):
        return math.nan if math.isnan(value) else float(value)
    if isinstance(value, str):
        if len(value) > LONGEST_TEXT:
            raise ValueError(f"text of {len(value)} letters; at most {LONGEST_TEXT} are kept")
        value.encode()  # a lone surrogate has no bytes: UnicodeEncodeError is a ValueError
        return str.__str__(value)  # of an Enum too, its text and not its name
    raise ValueError(f"{value!r:.60} is neither a number nor a flag nor text")


def kind_of(value: Value) -> str:
    """Returns one letter for the type of a plain value: b, i, f or s."""
    return _KINDS[type(value)]


def of_kind(kind: str, cell: object) -> Value:
    """Returns the plain value of a cell that was written down; the way back of ``kind_of``.

    Raises:
        ValueError: The cell is not a value of that kind, or there is no such kind.
    """
    if kind == "f":
        return float(str(cell))
    if kind == "i":
        return int(str(cell))
    if kind == "s":
        return str(cell)
    if kind == "b" and str(cell) in ("True", "False"):
        return str(cell) == "True"
    raise ValueError(f"{cell!r:.60} is no value of kind {kind!r}")


def point_key(point: Mapping[str, Value]) -> str:
    """Returns the key of a point: 32 hexadecimal digits.

    The key depends on names and values, not on the order of names. Floats enter with all their
    bits, so 0.1 + 0.2 and 0.3 are two points; 1, 1.0 and True are three, since a function may
    tell them apart.
    """
    parts = [
        [name, kind_of(value), value.hex() if isinstance(value, float) else value]
        for name, value in sorted(point.items())
    ]
    text = json.dumps(parts, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def grid(**axes: object) -> list[Point]:
    """Returns every combination of the values of several axes.

    The first axis changes slowest and the last fastest, as in nested loops in the order of the
    arguments.

    Args:
        axes: For each parameter its values, or one value that is the same in all points.

    Returns:
        The points, as many as the product of the axes' lengths.

    Raises:
        StudyError: There is no axis, an axis is empty, or a value is not a finite number, a flag
            or text.
    """
    if not axes:
        raise StudyError("a grid needs at least one axis")
    values = []
    for name, axis in axes.items():
        several = isinstance(axis, Iterable) and not isinstance(axis, str | bytes)
        if isinstance(axis, np.ndarray) and axis.ndim != 1:
            raise StudyError(f"axis '{name}' has shape {axis.shape}; it must be one row of values")
        found = [_parameter(name, value) for value in (axis if several else [axis])]  # type: ignore[attr-defined]
        if not found:
            raise StudyError(f"axis '{name}' is empty; it must hold at least one value")
        values.append(found)
    return [dict(zip(axes, combined, strict=True)) for combined in itertools.product(*values)]


def checked_points(points: Iterable[Mapping[str, object]]) -> dict[str, Point]:
    """Returns points by their keys, in their order, with plain values.

    Raises:
        StudyError: There is no point, one is no mapping or is there twice, its parameters are not
            those of the first, or a value is out of range; the message names the point.
    """
    found: dict[str, Point] = {}
    kinds: dict[str, bool] = {}
    for number, given in enumerate(points):
        if not isinstance(given, Mapping):
            raise StudyError(f"point {number} is {given!r:.60}; it must be a mapping of parameters")
        point = {name: _parameter(name, value, number) for name, value in given.items()}
        texts = {name: isinstance(value, str) for name, value in point.items()}
        if not number:
            kinds = texts
            _check_names(point)
        if texts.keys() != kinds.keys():
            raise StudyError(
                f"point {number} has the parameters {', '.join(map(str, point)) or 'none'}; "
                f"the first point has {', '.join(kinds)}"
            )
        if odd := next((name for name in texts if texts[name] != kinds[name]), None):
            raise StudyError(
                f"point {number}: parameter '{odd}' is {point[odd]!r:.60}; it must be text in "
                "all points or in none"
            )
        if point_key(point) in found:
            raise StudyError(f"point {number} is there twice: {point!r:.200}")
        found[point_key(point)] = point
    if not found:
        raise StudyError("there are no points; a sweep needs at least one")
    return found


def _check_names(point: Point) -> None:
    """Refuses names that no table can have."""
    if not point:
        raise StudyError("point 0 has no parameters; it needs at least one")
    for name in point:
        if not isinstance(name, str) or not name or not name.isprintable():
            raise StudyError(f"parameter {name!r:.60} has no name; it must be printable text")
        if name in RESERVED:
            raise StudyError(f"no parameter may be named '{name}': the sweep adds that column")


def _parameter(name: str, value: object, number: int | None = None) -> Value:
    """Returns the plain value of a parameter, or says which one is wrong."""
    where = f"axis '{name}'" if number is None else f"point {number}: parameter '{name}'"
    try:
        found = plain(value)
    except ValueError as error:
        raise StudyError(f"{where}: {error}") from None
    if isinstance(found, float) and not math.isfinite(found):
        raise StudyError(f"{where} is {found}; it must be finite")
    return found
