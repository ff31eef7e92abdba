"""Many couplings at once, and the checks on numbers that every bound shares."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.arguments import Arguments
from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError

Axis = Literal["translation", "rotation"]
"""Which pair of K and B a bound is about."""


_ARGUMENTS = Arguments(CouplingError)


def checked(
    name: str, value: ArrayLike, unit: str = "", *, positive: bool = False
) -> NDArray[np.float64]:
    """Returns numbers as an array, all finite and >= 0 (> 0 if positive), or CouplingError."""
    return _ARGUMENTS.numbers(name, value, unit, least=0, is_open=positive)


def scalar(name: str, value: float, unit: str = "", *, positive: bool = False) -> float:
    """Returns one number, finite and >= 0 (> 0 if positive), or raises CouplingError."""
    return _ARGUMENTS.number(name, value, unit, least=0, is_open=positive)


def whole(name: str, value: int, least: int = 0) -> int:
    """Returns a number of samples.

    Raises:
        CouplingError: It is not a whole number, or less than the least that is valid.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise CouplingError(f"{name} is {value!r}; it must be a whole number of samples >= {least}")
    return int(value)


def together(**arrays: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Broadcasts arrays to one shape, or raises CouplingError."""
    shape = _ARGUMENTS.shape(**arrays)
    return [np.broadcast_to(array, shape) for array in arrays.values()]


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
        arrays = {}
        for field in fields(self):
            name = f"coupling {field.name}"
            value = getattr(self, field.name)
            array = checked(name, value, positive=field.name == "stiffness").copy()
            array.flags.writeable = False
            object.__setattr__(self, field.name, array)
            arrays[field.name] = array
        together(**arrays)


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
    stiffness, damping = (np.asarray(value, dtype=np.float64) for value in pair)
    stiffness, damping = together(stiffness=stiffness, damping=damping)
    return stiffness, damping
