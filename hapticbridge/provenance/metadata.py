"""Numbers of a recording's metadata."""

from __future__ import annotations

import math
from collections.abc import Mapping

from hapticbridge.errors import RecordingError
from hapticbridge.jsonable import read_json
from hapticbridge.provenance.start import STARTS

_MOST_TICKS = 2**31


def meta_float(meta: Mapping[str, str], name: str) -> float:
    """Returns a number of the metadata, equal to the last bit.

    Raises:
        RecordingError: It is missing, not a number or not finite.
    """
    try:
        value = float(meta[name])
    except KeyError:
        raise RecordingError(f"the recording's metadata lack '{name}'") from None
    except ValueError:
        raise RecordingError(f"metadata '{name}' is {meta[name]!r:.80}, not a number") from None
    if not math.isfinite(value):
        raise RecordingError(f"metadata '{name}' is {value}; it must be finite")
    return value


def meta_numbers(meta: Mapping[str, str], name: str, count: int) -> tuple[float, ...]:
    """Returns a list of numbers of the metadata.

    Raises:
        RecordingError: It is missing, or not ``count`` finite numbers.
    """
    text = meta.get(name)
    if text is None:
        raise RecordingError(f"the recording's metadata lack '{name}'")
    try:
        values = tuple(float(value) for value in read_json(text))
    except (ValueError, TypeError, OverflowError):
        values = ()
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise RecordingError(
            f"metadata '{name}' is {text!r:.80}; it must be {count} finite numbers"
        )
    return values


def meta_start(meta: Mapping[str, str], name: str) -> list[float]:
    """Returns one of ``STARTS`` from the metadata.

    Raises:
        RecordingError: It is missing, or has a wrong number of values.
    """
    if STARTS[name] == 1:
        return [meta_float(meta, name)]
    return list(meta_numbers(meta, name, STARTS[name]))


def meta_count(meta: Mapping[str, str], name: str) -> int:
    """Returns a count of the metadata.

    Raises:
        RecordingError: It is missing, not a whole number, or out of range.
    """
    value = meta_float(meta, name)
    if not value.is_integer() or not 0 <= value < _MOST_TICKS:
        raise RecordingError(f"metadata '{name}' is {value:g}; it must be a whole number >= 0")
    return int(value)
