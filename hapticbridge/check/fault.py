"""Faults of a scene, each with its place and remedy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hapticbridge.check.source_map import Place


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of a scene.

    Attributes:
        kind: Name of the kind of fault.
        place: File, line and element.
        sentence: Description with its numbers.
        change: Text to write at the place.
        is_note: True if a run works as well without the change; the scene counts as sound.
    """

    kind: str
    place: Place
    sentence: str
    change: str
    is_note: bool = False


def number(value: float) -> str:
    """Formats a number with three digits and no exponent: ``2500``, ``0.0375``."""
    if not math.isfinite(value):
        return "infinite"
    return np.format_float_positional(float(f"{value:.3g}"), trim="-")


def length(value: float) -> str:
    """Formats a length given in m: ``375 µm``, ``4.2 mm``, ``3.1 m``."""
    for unit, size in (("m", 1.0), ("mm", 1e-3)):
        if abs(value) >= size:
            return f"{number(value / size)} {unit}"
    return f"{number(1e6 * value)} µm"


def weight(mass: float) -> str:
    """Formats a mass given in kg: ``1.2 kg``, ``35 g``."""
    return f"{number(mass)} kg" if mass >= 0.1 else f"{number(1e3 * mass)} g"


def others(count: int) -> str:
    """Returns " and N more", or nothing for N = 0."""
    return f" and {count} more" if count > 0 else ""
