"""Argument checks of the reference mechanics."""

from __future__ import annotations

from collections.abc import Iterable

from numpy.typing import ArrayLike

from hapticbridge.arguments import Arguments, Array, shown
from hapticbridge.coupling import Coupling
from hapticbridge.errors import MechanicsError

MOST_STEPS = 10**8
"""Largest length of a run in steps: a day at 1 kHz, which still fits into memory."""

_ARGUMENTS = Arguments(MechanicsError)


def finite(name: str, value: ArrayLike, unit: str) -> Array:
    """Returns finite numbers as an array, or raises MechanicsError."""
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


def whole(name: str, value: int, least: int) -> int:
    """Returns a whole number in [least, ``MOST_STEPS``], or raises MechanicsError."""
    return _ARGUMENTS.whole(name, value, least=least, most=MOST_STEPS)


def chosen(name: str, value: str, valid: Iterable[str]) -> str:
    """Returns the value if it is one of the valid names, or raises MechanicsError."""
    return _ARGUMENTS.one_of(name, value, valid)


def common_shape(**arrays: Array) -> tuple[int, ...]:
    """Returns the broadcast shape of the arrays, or raises MechanicsError."""
    return _ARGUMENTS.shape(**arrays)


def spring_and_damper(coupling: Coupling) -> tuple[float, float]:
    """Returns K in N/m and B in N s/m of a coupling, or raises MechanicsError."""
    if not isinstance(coupling, Coupling):
        raise MechanicsError(f"coupling is {shown(coupling)}; it must be a Coupling")
    return (
        _ARGUMENTS.number("coupling stiffness", float(coupling.stiffness), "N/m", least=0),
        _ARGUMENTS.number("coupling damping", float(coupling.damping), "N s/m", least=0),
    )
