"""Many couplings at once, and the checks on numbers that every bound shares."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError

Axis = Literal["translation", "rotation"]
"""Which pair of K and B a bound is about."""


def checked(
    name: str, value: ArrayLike, unit: str = "", *, positive: bool = False
) -> NDArray[np.float64]:
    """Returns finite, non-negative numbers as an array.

    Args:
        name: What the numbers are, for the message.
        value: Any shape.
        unit: For the message.
        positive: Whether 0 is out of range too.

    Raises:
        CouplingError: A value is not a finite number, negative, or 0 where that is out of range.
    """
    limit = "> 0" if positive else ">= 0"
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CouplingError(f"{name} is {value!r}; it must be a number or an array") from error
    good = (array > 0 if positive else array >= 0) & (array < np.inf)
    if array.size == 0:
        raise CouplingError(f"{name} is an empty array; it must hold at least one number")
    if not good.all():
        first = float(array[~good][0]) if array.ndim else float(array)
        raise CouplingError(f"{name} is {first!r} {unit}; it must be finite and {limit}")
    return array


def scalar(name: str, value: float, unit: str = "", *, positive: bool = False) -> float:
    """Returns one finite, non-negative number; arrays are refused.

    Raises:
        CouplingError: As for ``checked``, or the value has more than one element.
    """
    array = checked(name, value, unit, positive=positive)
    if array.ndim:
        raise CouplingError(f"{name} has shape {array.shape}; it must be one number")
    return float(array)


def whole(name: str, value: int, least: int = 0) -> int:
    """Returns a number of samples.

    Raises:
        CouplingError: It is not a whole number, or less than the least that is valid.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise CouplingError(f"{name} is {value!r}; it must be a whole number of samples >= {least}")
    return int(value)


def together(*arrays: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Broadcasts arrays to one shape.

    Raises:
        CouplingError: The shapes do not fit together.
    """
    try:
        return list(np.broadcast_arrays(*arrays))
    except ValueError as error:
        shapes = ", ".join(str(array.shape) for array in arrays)
        raise CouplingError(f"shapes {shapes} do not broadcast to one shape") from error


def plain(array: NDArray[np.float64]) -> float | NDArray[np.float64]:
    """Returns a float for an array without dimensions, and any other array as it is."""
    return array if array.ndim else float(array)


@dataclass(frozen=True, slots=True, eq=False)
class CouplingGrid:
    """Couplings side by side: each field an array, or a number that holds for all.

    What ``Coupling`` is for one spring and damper, for maps over thousands. The bounds of this
    package take either; a bridge takes only a ``Coupling``. The fields broadcast against each
    other as in NumPy and are kept as read-only arrays.

    Attributes:
        stiffness: K in N/m, finite and > 0.
        damping: B in N s/m, finite and >= 0.
        rotational_stiffness: K_r in N m/rad, finite and >= 0.
        rotational_damping: B_r in N m s/rad, finite and >= 0.

    Raises:
        CouplingError: A value is not finite or out of range, or the shapes do not broadcast.
    """

    stiffness: ArrayLike
    damping: ArrayLike = 0.0
    rotational_stiffness: ArrayLike = 0.0
    rotational_damping: ArrayLike = 0.0

    def __post_init__(self) -> None:
        arrays = []
        for field in fields(self):
            name = f"coupling {field.name}"
            value = getattr(self, field.name)
            array = checked(name, value, positive=field.name == "stiffness").copy()
            array.flags.writeable = False
            object.__setattr__(self, field.name, array)
            arrays.append(array)
        together(*arrays)


def spring_and_damper(
    coupling: Coupling | CouplingGrid, axis: Axis = "translation"
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns K and B of one kind of axis, broadcast to one shape.

    Raises:
        CouplingError: The axis is unknown.
    """
    if axis == "translation":
        pair = (coupling.stiffness, coupling.damping)
    elif axis == "rotation":
        pair = (coupling.rotational_stiffness, coupling.rotational_damping)
    else:
        raise CouplingError(f"axis is {axis!r}; choose 'translation' or 'rotation'")
    stiffness, damping = together(*(np.asarray(value, dtype=np.float64) for value in pair))
    return stiffness, damping
