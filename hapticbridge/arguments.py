"""Validation of arguments, with one-sentence refusals."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Real
from typing import TypeGuard

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
                f"{name} is {shown(value)}; it must be a whole number{_of(unit, 'of')} >= {least} "
                f"and <= {most}"
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


def _range(least: float, most: float, is_open: bool) -> str:
    if least == -np.inf and most == np.inf:
        return "finite"
    if most == np.inf:
        return f"finite and {'>' if is_open else '>='} {least:g}"
    return f"in {'(' if is_open else '['}{least:g}, {most:g}]"
