"""The checks of the reference mechanics' arguments: each returns what is valid, or raises."""

from __future__ import annotations

from collections.abc import Iterable

from numpy.typing import ArrayLike

from hapticbridge.arguments import Arguments, Array
from hapticbridge.errors import MechanicsError, choices

_ARGUMENTS = Arguments(MechanicsError)


def finite(name: str, value: ArrayLike, unit: str) -> Array:
    """Returns numbers as an array, all finite, or raises MechanicsError."""
    return _ARGUMENTS.numbers(name, value, unit)


def positive(name: str, value: ArrayLike, unit: str) -> Array:
    """Returns numbers as an array, all finite and > 0, or raises MechanicsError."""
    return _ARGUMENTS.numbers(name, value, unit, least=0, is_open=True)


def within(name: str, value: ArrayLike, unit: str, low: float, high: float) -> Array:
    """Returns numbers as an array, all finite and in [low, high], or raises MechanicsError."""
    return _ARGUMENTS.numbers(name, value, unit, least=low, most=high)


def step(period: float) -> float:
    """Returns the period T in s, one finite number > 0, or raises MechanicsError."""
    return _ARGUMENTS.number("period", period, "s", least=0, is_open=True)


def chosen(name: str, value: str, valid: Iterable[str]) -> str:
    """Returns the value if it is one of the valid names, or raises MechanicsError."""
    valid = tuple(valid)
    if value not in valid:
        raise MechanicsError(f"{name} is {value!r}; choose one of {choices(valid)}")
    return value


def common_shape(**arrays: Array) -> tuple[int, ...]:
    """Returns the shape to which the arrays broadcast together, or raises MechanicsError."""
    return _ARGUMENTS.shape(**arrays)
