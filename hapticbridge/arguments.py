"""What a numeric argument may be, refused in one sentence otherwise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.errors import HapticBridgeError

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Arguments:
    """Checks of the arguments of one part of the package, with that part's own error.

    Attributes:
        error: What is raised.
    """

    error: type[HapticBridgeError]

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
            name: What the numbers are, for the message.
            value: Any shape; not empty, and no flags or text.
            unit: For the message.
            least: Smallest valid value.
            most: Largest valid value.
            is_open: Whether the smallest value is out of range too.

        Raises:
            HapticBridgeError: The family's own: a value is not a number, not finite, or out of
                range; names the first such value and the range.
        """
        try:
            given = np.asarray(value)
        except ValueError:  # rows of different lengths
            given = np.empty(0, dtype=object)
        if given.dtype.kind not in "iuf":
            raise self.error(f"{name} is {value!r:.80}; it must be numbers{_of(unit)}")
        array = given.astype(np.float64)
        if array.size == 0:
            raise self.error(f"{name} is an empty array; it must hold at least one number")
        is_valid = np.isfinite(array) & (array <= most)
        is_valid &= array > least if is_open else array >= least
        if not is_valid.all():
            culprit = float(array[~is_valid].flat[0]) if array.ndim else float(array)
            shown = f"{culprit:g} {unit}".rstrip()
            raise self.error(f"{name} is {shown}; it must be {_range(least, most, is_open)}")
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

    def shape(self, **arrays: Array) -> tuple[int, ...]:
        """Returns the shape to which arrays broadcast together.

        Raises:
            HapticBridgeError: They do not; names each with its shape.
        """
        try:
            return np.broadcast_shapes(*(array.shape for array in arrays.values()))
        except ValueError:
            shapes = ", ".join(
                f"{name.replace('_', ' ')} {array.shape}" for name, array in arrays.items()
            )
            raise self.error(f"shapes do not broadcast together: {shapes}") from None


def _of(unit: str) -> str:
    return f" in {unit}" if unit else ""


def _range(least: float, most: float, is_open: bool) -> str:
    if least == -np.inf and most == np.inf:
        return "finite"
    if most == np.inf:
        return f"finite and {'>' if is_open else '>='} {least:g}"
    return f"in {'(' if is_open else '['}{least:g}, {most:g}]"
