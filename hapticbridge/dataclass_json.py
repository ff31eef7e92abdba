"""Frozen dataclasses as JSON, and back, checked against the types of their fields.

Types are numbers, texts, flags, None, ``Literal``, tuples, mappings by text, dataclasses and unions
of them. ``Annotated[T, S]`` is a field that takes T and is stored as S. Infinity is the text
``inf``; every number reads back to an equal double.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from numbers import Integral, Real
from typing import Any, Literal, TypeVar, get_args, get_origin

from hapticbridge.arguments import is_number, members, shown, types_of
from hapticbridge.errors import HapticBridgeError, RecordingError, choices
from hapticbridge.files import read_json

T = TypeVar("T")


def to_json(value: Any) -> str:
    """Returns a dataclass, or a nesting of them, as JSON."""
    return json.dumps(_plain(value), allow_nan=False)


def from_json(
    kind: type[T], text: str, name: str, error: type[HapticBridgeError] = RecordingError
) -> T:
    """Returns the dataclass of a text that ``to_json`` wrote.

    Args:
        kind: The dataclass.
        text: JSON from anywhere.
        name: Name of the text for messages.
        error: Class of the errors.

    Raises:
        HapticBridgeError: ``error``: the text is no JSON, a field is unknown, missing, of another
            type, or the dataclass refuses its value. The message names the field.
    """
    try:
        value: T = _value(kind, read_json(text), name)
    except HapticBridgeError as reason:
        raise error(str(reason)) from None
    except RecursionError:
        raise error(f"{name} is nested too deeply") from None
    except ValueError as reason:
        raise error(f"{name} is not JSON: {reason}") from None
    return value


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, Integral):
        return int(value)
    if isinstance(value, Real):
        return float(value) if math.isfinite(value) else str(float(value))
    raise TypeError(f"{shown(value)} has no form in JSON")


_INFINITE = ("inf", "-inf")


def _value(kind: Any, value: Any, name: str) -> Any:
    """Returns a JSON value as an object of a type; ``name`` is the value's for messages."""
    kinds, origin, arguments = members(kind), get_origin(kind), get_args(kind)
    if kinds != (kind,):
        return _member(kinds, value, name)
    if not _is_form(kind, value):
        raise HapticBridgeError(f"{name} is {shown(value)}; it must be {_words(kind)}")
    if is_dataclass(kind):
        return _object(kind, value, name)
    if origin is tuple:
        return tuple(_value(arguments[0], each, f"{name}[{i}]") for i, each in enumerate(value))
    if origin is Mapping:
        return {key: _value(arguments[1], each, f"{name}.{key:.60}") for key, each in value.items()}
    return float(value) if kind is float else value


def _member(kinds: Sequence[Any], value: Any, name: str) -> Any:
    """Returns a value as the first type of a union that takes it."""
    able = [kind for kind in kinds if _is_form(kind, value)]
    if not able:
        words = " or ".join(dict.fromkeys(map(_words, kinds)))
        raise HapticBridgeError(f"{name} is {shown(value)}; it must be {words}")
    for kind in able[:-1]:
        with suppress(HapticBridgeError):  # the last type says why
            return _value(kind, value, name)
    return _value(able[-1], value, name)


_WORDS: dict[Any, str] = {
    float: "a finite number or 'inf'",
    int: "a whole number",
    str: "a text",
    bool: "true or false",
    type(None): "null",
    tuple: "a list",
}


def _words(kind: Any) -> str:
    origin = get_origin(kind)
    if origin is Literal:
        return choices(get_args(kind))
    return _WORDS.get(origin or kind, "an object")


def _is_form(kind: Any, value: Any) -> bool:
    """Returns True if a type is written in this kind of JSON value."""
    origin = get_origin(kind)
    if kind is float:
        return value in _INFINITE if isinstance(value, str) else _is_finite(value)
    if origin is Literal:
        return any(value == each and type(value) is type(each) for each in get_args(kind))
    if origin is tuple:
        return isinstance(value, list)
    if origin is Mapping or is_dataclass(kind):
        return isinstance(value, dict)
    return type(value) is kind


def _is_finite(value: Any) -> bool:
    return is_number(value) and math.isfinite(value)


def _object(kind: Any, value: dict[str, Any], name: str) -> Any:
    known = types_of(kind)
    names = [field.name for field in fields(kind)]
    for words, wrong in (("unknown fields", value.keys() - names), ("no", names - value.keys())):
        if wrong:
            raise HapticBridgeError(f"{name} has {words} {choices(wrong)}")
    own = {each: _value(known[each], value[each], f"{name}.{each}") for each in names}
    try:
        return kind(**own)
    except HapticBridgeError as error:
        raise HapticBridgeError(f"{name} is refused: {error}") from None
