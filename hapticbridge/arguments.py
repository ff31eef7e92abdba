"""Validation of arguments and of the fields of dataclasses, with one-sentence refusals.

A field has its type, default, unit and valid values in one place (``option``). ``check_fields``
holds an object to them, ``value_from`` reads a value from text. The command line, the recorded
request and the what-if are made from the same fields.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, replace
from functools import cache
from numbers import Real
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    TypeGuard,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.errors import HapticBridgeError, choices

Array = NDArray[np.float64]

SMALLEST, LARGEST = 1e-30, 1e30
"""Range of a magnitude in the unit of the argument; no real or simulated quantity lies outside. The
theory multiplies about ten arguments, and 1e300 is still a double, so nothing relevant overflows.
Larger limits could overflow. A smaller magnitude counts as 0 if 0 is valid."""

LONGEST = 80
"""Largest number of characters of a refused value in a message."""


@dataclass(frozen=True, slots=True)
class Arguments:
    """Checks of the arguments of one part of the package, with that part's own error.

    Attributes:
        error: Exception to raise.
        smallest: Smallest magnitude other than 0.
        largest: Largest magnitude.
    """

    error: type[HapticBridgeError]
    smallest: float = SMALLEST
    largest: float = LARGEST

    def numbers(
        self,
        name: str,
        value: ArrayLike,
        unit: str = "",
        *,
        least: float = -np.inf,
        most: float = np.inf,
        is_open: bool = False,
    ) -> Array:
        """Returns finite numbers within limits as an array of doubles.

        Args:
            name: Name of the argument, for the message.
            value: Numbers of any shape, not empty; no flags, text or dates. Magnitudes are at most
                ``largest``; those below ``smallest`` become 0.
            unit: Unit, for the message.
            least: Smallest valid value.
            most: Largest valid value.
            is_open: True excludes the smallest value itself, and magnitudes below ``smallest``.

        Raises:
            HapticBridgeError: ``error``: a value is not a number, not finite, or out of range. The
                message names the first such value and the range.
        """
        try:
            raw = np.asarray(value)
        except (TypeError, ValueError, OverflowError):  # as rows of different lengths
            raw = np.empty(0, dtype=object)
        if raw.dtype.kind not in "iuf":
            raise self.error(f"{name} is {shown(value)}; it must be numbers{_of(unit)}")
        with np.errstate(over="ignore"):  # longer floats become inf, which is refused
            array = raw.astype(np.float64)
        if array.size == 0:
            raise self.error(f"{name} is an empty array; it must hold at least one number")
        is_valid = np.isfinite(array) & (array <= most)
        is_valid &= array > least if is_open else array >= least
        if not is_valid.all():
            raise self.error(
                f"{name} is {_first(array, ~is_valid, unit)}; "
                f"it must be {_range(least, most, is_open)}"
            )
        size = np.abs(array)
        is_tiny = size < self.smallest
        is_extreme = size > self.largest
        if is_open:
            is_extreme |= is_tiny
        if is_extreme.any():
            raise self.error(
                f"{name} is {_first(array, is_extreme, unit)}; "
                f"its magnitude must lie between {self.smallest:g} and {self.largest:g}"
            )
        array[is_tiny] = 0.0
        return array

    def number(
        self,
        name: str,
        value: float,
        unit: str = "",
        *,
        least: float = -np.inf,
        most: float = np.inf,
        is_open: bool = False,
    ) -> float:
        """Returns one finite number within limits; arrays are refused.

        Raises:
            HapticBridgeError: As for ``numbers``, or the value has dimensions.
        """
        array = self.numbers(name, value, unit, least=least, most=most, is_open=is_open)
        if array.ndim:
            raise self.error(f"{name} has shape {array.shape}; it must be one number{_of(unit)}")
        return float(array)

    def whole(self, name: str, value: int, unit: str = "", *, least: int, most: int) -> int:
        """Returns a whole number within limits; flags and floats are refused.

        Raises:
            HapticBridgeError: The value is not a whole number or out of range.
        """
        is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        if not is_whole or not least <= value <= most:
            raise self.error(
                f"{name} is {shown(value)}; it must be a whole number{_of(unit, 'of')}, "
                f"{_range(least, most)}"
            )
        return int(value)

    def one_of(self, name: str, value: str, valid: Iterable[str]) -> str:
        """Returns the value if it is one of the valid names.

        Raises:
            HapticBridgeError: The value is not valid; the message lists the choices.
        """
        names = tuple(valid)
        if not isinstance(value, str) or value not in names:
            raise self.error(f"{name} is {shown(value)}; choose one of {choices(names)}")
        return value

    def shape(self, **arrays: Array) -> tuple[int, ...]:
        """Returns the shape to which arrays broadcast together.

        Raises:
            HapticBridgeError: They do not broadcast; the message names each with its shape.
        """
        try:
            return np.broadcast_shapes(*(array.shape for array in arrays.values()))
        except ValueError:
            shapes = ", ".join(
                f"{name.replace('_', ' ')} {array.shape}" for name, array in arrays.items()
            )
            raise self.error(f"shapes do not broadcast together: {shapes}") from None


def is_number(value: object) -> TypeGuard[float]:
    """Returns True for a real number that a double holds, also inf and nan; False for a flag."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        return False
    try:
        float(value)
    except OverflowError:  # a whole number of more than 308 digits
        return False
    return True


def shown(value: object) -> str:
    """Formats a refused value for a message: one line of limited length."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # a whole number of more digits than Python prints
        text = f"a {type(value).__name__}"
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…"


def _of(unit: str, word: str = "in") -> str:
    return f" {word} {unit}" if unit else ""


def _first(array: Array, is_wrong: NDArray[np.bool_], unit: str) -> str:
    return f"{float(array[is_wrong].flat[0]):g} {unit}".rstrip()


def _range(least: float, most: float, is_open: bool = False, is_finite: bool = True) -> str:
    if least == -np.inf and most == np.inf:
        return "finite" if is_finite else "a number"
    above = f"{'>' if is_open else '>='} {least:.10g}"
    if most == np.inf:
        return f"finite and {above}" if is_finite else f"{above}, inf for none"
    return f"{above} and <= {most:.10g}" if is_open else f"{least:.10g} to {most:.10g}"


# Fields of dataclasses


@dataclass(frozen=True, slots=True)
class Rule:
    """Unit and valid values of a field, and its flag on the command line.

    Attributes:
        unit: Unit of its number.
        least: Smallest valid number.
        most: Largest valid number.
        is_open: True excludes the smallest number itself.
        is_finite: False admits inf, for no limit.
        is_filled: True refuses an empty text.
        flag: Name of the flag, without dashes; empty for the field's name.
        no_flag: Reason why the field has no flag; empty for one that has.
        metavar: Word for the value in help; empty for that of its type.
        is_positional: True for a word without a flag.
        is_repeated: True for a tuple whose flag is repeated, once per value.
        gains_of: Class of whose fields a mapping holds some by name.
        source: Class and name of the field that documents it; None for itself.
    """

    unit: str = ""
    least: float = -np.inf
    most: float = np.inf
    is_open: bool = False
    is_finite: bool = True
    is_filled: bool = False
    flag: str = ""
    no_flag: str = ""
    metavar: str = ""
    is_positional: bool = False
    is_repeated: bool = False
    gains_of: type[Any] | None = None
    source: tuple[Any, str] | None = None

    def valid(self) -> str:
        """Returns the valid numbers in words."""
        return _range(self.least, self.most, self.is_open, self.is_finite)

    def admits(self, number: float) -> bool:
        """Returns True for a valid number; NaN is none."""
        is_above = number > self.least if self.is_open else number >= self.least
        is_below = number <= self.most and (not self.is_finite or number < np.inf)
        return is_above and is_below and (not self.is_finite or number > -np.inf)


def rule(**values: Any) -> dict[str, Rule]:
    """Returns the metadata of a field that has a ``Rule`` with these values."""
    return {"rule": Rule(**values)}


def option(default: Any = MISSING, **values: Any) -> Any:
    """Returns a field of a dataclass with a default and a ``Rule`` with these values."""
    return field(default=default, metadata=rule(**values))


def shared(owner: type[Any], name: str, default: Any = MISSING, **values: Any) -> Any:
    """Returns a field with the default, the rule and the text of another class's field.

    Args:
        owner: The other class.
        name: The field there.
        default: Default in place of the other one.
        **values: Values of ``Rule`` in place of the other one's.
    """
    [other] = [each for each in fields(owner) if each.name == name]
    own = replace(rule_of(other), source=(owner, name), **values)
    return field(default=other.default if default is MISSING else default, metadata={"rule": own})


_NO_RULE = Rule()


def rule_of(each: Field[Any]) -> Rule:
    """Returns the rule of a field; of one without, the rule that admits every finite number."""
    own: Rule = each.metadata.get("rule", _NO_RULE)
    return own


@cache
def types_of(kind: Any) -> dict[str, Any]:
    """Returns the types of a dataclass's fields, by name."""
    return get_type_hints(kind, include_extras=True)


def members(kind: Any, *, is_stored: bool = True) -> tuple[Any, ...]:
    """Returns the types of a union, or the one type.

    A field ``Annotated[T, S]`` takes T and is stored as S, or written as S in a text.
    """
    if get_origin(kind) is Annotated:
        return members(get_args(kind)[is_stored])
    return get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)


def label(each: Field[Any]) -> str:
    """Returns the words for a field in messages, as its flag has them."""
    return (rule_of(each).flag or each.name).replace("_", " ").replace("-", " ")


def unit_of(kind: type[Any], name: str) -> str:
    """Returns the unit of a field; empty for one without."""
    return next((rule_of(each).unit for each in fields(kind) if each.name == name), "")


def check_fields(
    made: Any, error: type[HapticBridgeError] = HapticBridgeError, of: str = ""
) -> None:
    """Holds the fields of a frozen dataclass to their types and rules; numbers become plain ones.

    Fields of other types than numbers, flags, texts, choices and dataclasses are left to the class.

    Args:
        made: The object, in its ``__post_init__``.
        error: Class of the error.
        of: Words before the field's name in messages.

    Raises:
        HapticBridgeError: ``error``: a value is of another type or out of range.
    """
    kind: Any = type(made)
    for each, kinds, own in _checks(kind):
        value = getattr(made, each.name)
        plain = checked_value(f"{of}{label(each)}", value, kinds, own, error)
        if plain is not value:
            object.__setattr__(made, each.name, plain)


def checked_value(
    name: str,
    value: Any,
    kinds: tuple[Any, ...],
    own: Rule,
    error: type[HapticBridgeError] = HapticBridgeError,
) -> Any:
    """Returns a value that is of one of the types and that the rule admits, as a plain number.

    Raises:
        HapticBridgeError: ``error``: it is not; the message says what is valid.
    """
    kind = next((kind for kind in kinds if _fits(kind, value, own)), None)
    if kind is None:
        unit = f" {own.unit}" if own.unit and is_number(value) else ""
        raise error(f"{name} is {shown(value)}{unit}; it must be {_valid(kinds, own)}")
    return kind(value) if kind in (int, float) and type(value) is not kind else value


@cache
def _checks(kind: Any) -> tuple[tuple[Field[Any], tuple[Any, ...], Rule], ...]:
    """Returns the fields that ``check_fields`` holds to something, with types and rule."""
    found = []
    for each in fields(kind):
        kinds = members(types_of(kind)[each.name], is_stored=False)
        if all(_is_checked(member) for member in kinds):
            found.append((each, kinds, rule_of(each)))
    return tuple(found)


def _is_checked(kind: Any) -> bool:
    is_simple = kind in (bool, int, float, str, type(None)) or is_dataclass(kind)
    return is_simple or get_origin(kind) in (Literal, Mapping)


def _fits(kind: Any, value: Any, own: Rule) -> bool:
    """Returns True for a value of a type that its rule admits."""
    if kind is int:
        is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        return is_whole and own.admits(value)
    if kind is float:
        return is_number(value) and own.admits(value)
    if get_origin(kind) is Literal:
        return isinstance(value, str) and value in get_args(kind)
    is_empty = kind is str and own.is_filled and not value
    return isinstance(value, get_origin(kind) or kind) and not is_empty


def _valid(kinds: Iterable[Any], own: Rule) -> str:
    """Returns what a field takes, in words."""
    whole = f" >= {own.least:g}" if own.most == np.inf else f", {own.valid()}"
    words = {float: own.valid(), int: f"a whole number{whole}", bool: "True or False"}
    words |= {str: "a text that is not empty" if own.is_filled else "a text"}
    found = [
        f"{'one of ' if get_args(kind)[1:] else ''}{choices(get_args(kind))}"
        if get_origin(kind) is Literal
        else words.get(kind) or f"a {(get_origin(kind) or kind).__name__}"
        for kind in kinds
        if kind is not type(None)
    ]
    return ", or ".join(found)


def number_from(text: str, kind: Callable[[str], Any] = float) -> Any:
    """Returns the number of a type, ``float`` or ``int``, that a text writes in plain notation.

    Python also reads ``1_000`` and the digits of other scripts.

    Raises:
        ValueError: The text is none.
    """
    if "_" in text or not text.isascii():
        raise ValueError(text)
    return kind(text)


def value_from(kind: Any, text: str, own: Rule = _NO_RULE) -> Any:
    """Returns the value of a field's type that a text writes; its range is not checked.

    Raises:
        ValueError: It writes none; the message says what is valid.
    """
    words = {float: f"a number{_of(own.unit)}", int: f"a whole number{_of(own.unit, 'of')}"}
    valid = []
    for member in members(kind):
        if get_origin(member) is Literal:
            if text in get_args(member):
                return text
            valid.append(f"one of {choices(get_args(member))}")
        elif member in (int, float, str, Path):
            with suppress(ValueError):
                return number_from(text, member) if member in words else member(text)
            valid.append(words[member])
    raise ValueError(", or ".join(valid))
