"""Arrays of couplings, and argument checks shared by all bounds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.arguments import LARGEST, SMALLEST, Arguments, shown
from hapticbridge.coupling import Coupling
from hapticbridge.errors import CouplingError

Axis = Literal["translation", "rotation"]
"""Kind of axis; it selects the pair of K and B."""

MOST_DELAY = 50
"""Largest delay in samples: 50 ms at 1 kHz, where a coupling is too soft to be useful. The time to
compute a bound grows with its square."""

MOST_SAMPLES = 10**8
"""Largest length of a run or series in samples: a day at 1 kHz, which still fits into memory."""

_ARGUMENTS = Arguments(CouplingError)
# a frequency is an angle divided by a period, so its range is squared
_FREQUENCIES = Arguments(CouplingError, SMALLEST**2, LARGEST**2)


def checked(
    name: str, value: ArrayLike, unit: str = "", *, positive: bool = False
) -> NDArray[np.float64]:
    """Returns an array of finite numbers >= 0 (> 0 if positive), or raises CouplingError."""
    return _ARGUMENTS.numbers(name, value, unit, least=0, is_open=positive)


def scalar(name: str, value: float, unit: str = "", *, positive: bool = False) -> float:
    """Returns one number, finite and >= 0 (> 0 if positive), or raises CouplingError."""
    return _ARGUMENTS.number(name, value, unit, least=0, is_open=positive)


def frequencies(value: ArrayLike) -> NDArray[np.float64]:
    """Returns frequencies in rad/s as an array, all finite and > 0, or raises CouplingError."""
    return _FREQUENCIES.numbers("frequency", value, "rad/s", least=0, is_open=True)


def finite(name: str, value: ArrayLike, unit: str = "") -> NDArray[np.float64]:
    """Returns finite numbers of any sign as an array, or raises CouplingError."""
    return _ARGUMENTS.numbers(name, value, unit)


def whole(name: str, value: int, least: int = 0, most: int = MOST_SAMPLES) -> int:
    """Returns a whole number of samples in [least, most], or raises CouplingError."""
    return _ARGUMENTS.whole(name, value, "samples", least=least, most=most)


def delayed_by(value: int) -> int:
    """Returns a delay of 0 to ``MOST_DELAY`` samples, or raises CouplingError."""
    return whole("delay", value, most=MOST_DELAY)


def one_of(name: str, value: str, valid: Iterable[str]) -> str:
    """Returns the value if it is one of the valid names, or raises CouplingError."""
    return _ARGUMENTS.one_of(name, value, valid)


def together(**arrays: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Broadcasts arrays to one shape, or raises CouplingError."""
    shape = _ARGUMENTS.shape(**arrays)
    return [np.broadcast_to(array, shape) for array in arrays.values()]


def plain(array: NDArray[np.float64]) -> float | NDArray[np.float64]:
    """Returns a float for an array without dimensions, and any other array unchanged."""
    return array if array.ndim else float(array)


@dataclass(frozen=True, slots=True, eq=False)
class CouplingGrid:
    """Couplings in arrays, for maps over thousands; the fields broadcast as in NumPy.

    The bounds of this package accept it in place of a ``Coupling``; a bridge does not. The fields
    are kept as read-only arrays.

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


_OF_ROTATION = ("rotational_stiffness", "rotational_damping")


def spring_and_damper(
    coupling: Coupling | CouplingGrid, axis: Axis = "translation"
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns K and B of one kind of axis, broadcast to one shape.

    Raises:
        CouplingError: The axis is unknown, the coupling has a wrong type, or a value is out of
            range.
    """
    is_translation = one_of("axis", axis, ("translation", "rotation")) == "translation"
    if not isinstance(coupling, Coupling | CouplingGrid):
        raise CouplingError(
            f"coupling is {shown(coupling)}; it must be a Coupling or a CouplingGrid"
        )
    names = ("stiffness", "damping") if is_translation else _OF_ROTATION
    if isinstance(coupling, Coupling):
        # Coupling has no upper limit and accepts fractions.Fraction, so convert and check here
        stiffness, damping = (
            checked(f"coupling {name}", float(getattr(coupling, name)), positive=is_first)
            for name, is_first in zip(names, (is_translation, False), strict=True)
        )
        return stiffness, damping
    stiffness, damping = together(**{name: getattr(coupling, name) for name in names})
    return stiffness, damping


def single(coupling: Coupling) -> tuple[float, float]:
    """Returns K and B in translation of one coupling.

    Raises:
        CouplingError: The argument is not a ``Coupling``, or a value is out of range.
    """
    if not isinstance(coupling, Coupling):
        raise CouplingError(f"coupling is {shown(coupling)}; it must be one Coupling")
    stiffness, damping = spring_and_damper(coupling)
    return float(stiffness), float(damping)
