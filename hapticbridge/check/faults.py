"""What is wrong or risky in a scene: each fault with its place and the change that mends it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hapticbridge.check.places import Place


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that is wrong.

    Attributes:
        kind: What it is called, the same for all of its kind.
        place: File, line and element.
        sentence: What is wrong, with its numbers.
        change: What to write there.
    """

    kind: str
    place: Place
    sentence: str
    change: str


def number(value: float) -> str:
    """Returns a number with three digits and no exponent: ``2500``, ``0.0375``."""
    if not math.isfinite(value):
        return "infinite"
    return np.format_float_positional(float(f"{value:.3g}"), trim="-")


def length(value: float) -> str:
    """Returns a length in m as a person reads it: ``375 µm``, ``4.2 mm``, ``3.1 m``."""
    for unit, size in (("m", 1.0), ("mm", 1e-3)):
        if abs(value) >= size:
            return f"{number(value / size)} {unit}"
    return f"{number(1e6 * value)} µm"


def weight(mass: float) -> str:
    """Returns a mass in kg as a person reads it: ``1.2 kg``, ``35 g``."""
    return f"{number(mass)} kg" if mass >= 0.1 else f"{number(1e3 * mass)} g"


def others(count: int) -> str:
    """Returns how many more there are, as the end of a list's first name."""
    return f" and {count} more" if count > 0 else ""
