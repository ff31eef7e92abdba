"""Numbers with units."""

from __future__ import annotations

import math

_PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"), (1e-12, "p"))


def format_si(value: float, unit: str) -> str:
    """Formats a number with an SI prefix and three digits: ``-3.41 mJ``, ``0 J``."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g} {unit}"
    for factor, prefix in _PREFIXES:
        if abs(value) >= factor:
            return f"{value / factor:.3g} {prefix}{unit}"
    return f"{value:.2g} {unit}"


def format_energy(joules: float) -> str:
    """Formats an energy; below 1 pJ is the rounding of the sums, which counts as 0."""
    return format_si(joules if abs(joules) >= 1e-12 else 0.0, "J")
