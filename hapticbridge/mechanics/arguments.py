"""What an argument of the reference mechanics may be, refused in one sentence otherwise."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.errors import MechanicsError, choices

Array = NDArray[np.float64]


def finite(name: str, value: ArrayLike, unit: str) -> Array:
    """Returns the value as an array of doubles.

    Raises:
        MechanicsError: It is not numeric, or not all of it is finite.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise MechanicsError(f"{name} is {value!r}; it must be numbers in {unit}") from None
    _demand(np.isfinite(array), name, array, unit, "finite")
    return array


def positive(name: str, value: ArrayLike, unit: str) -> Array:
    """Returns the value as an array of doubles, all finite and > 0, or raises MechanicsError."""
    array = finite(name, value, unit)
    _demand(array > 0, name, array, unit, "> 0")
    return array


def within(name: str, value: ArrayLike, unit: str, low: float, high: float) -> Array:
    """Returns the value as an array, all of it in [low, high], or raises MechanicsError."""
    array = finite(name, value, unit)
    limits = f">= {low:g}" if high == np.inf else f"in [{low:g}, {high:g}]"
    _demand((array >= low) & (array <= high), name, array, unit, limits)
    return array


def step(period: float) -> float:
    """Returns the period T in s, one finite number > 0, or raises MechanicsError."""
    array = positive("period", period, "s")
    if array.ndim:
        raise MechanicsError(f"period has shape {array.shape}; it must be one number in s")
    return float(array)


def chosen(name: str, value: str, valid: Iterable[str]) -> str:
    """Returns the value if it is one of the valid names, or raises MechanicsError."""
    valid = tuple(valid)
    if value not in valid:
        raise MechanicsError(f"{name} is {value!r}; choose one of {choices(valid)}")
    return value


def common_shape(**arrays: Array) -> tuple[int, ...]:
    """Returns the shape to which the arrays broadcast together.

    Raises:
        MechanicsError: They do not.
    """
    try:
        return np.broadcast_shapes(*(array.shape for array in arrays.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise MechanicsError(f"shapes do not broadcast together: {shapes}") from None


def _demand(
    is_valid: NDArray[np.bool_] | np.bool_, name: str, array: Array, unit: str, limits: str
) -> None:
    if not np.all(is_valid):
        culprit = array[~np.asarray(is_valid)].flat[0]
        raise MechanicsError(f"{name} is {culprit:g} {unit}; it must be {limits}")
