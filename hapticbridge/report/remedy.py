"""Stiffness, damping or rate that a device would bear."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from hapticbridge.certificate import run_conditions
from hapticbridge.report.evidence import Evidence

HALVINGS = 40
"""Number of bisections of a limit; the printed three digits need a third of them."""

FASTEST = 20_000.0
"""Largest rate in Hz that is proposed; loops of this package reach no higher one."""


def what_would_do(evidence: Evidence, *, is_late: bool = False) -> str:
    """Returns changes that satisfy the device condition, as a user would type them.

    Stiffness and damping are the requested ones, not the law's B'. Each is changed alone; a change
    that does not help alone is left out. A faster loop is no remedy for a delay (``is_late``). The
    device's damping must be known.
    """
    found = []
    for axis, units in _UNITS.items():
        if _holds(evidence, axis, "period", 1.0):
            continue
        name = axis.replace(" ", "_")
        for part, unit in zip(("stiffness", "damping"), units, strict=True):
            share = _largest(partial(_holds, evidence, axis, part))
            if share:
                value = share * getattr(evidence.asked, f"{name}{part}")
                found.append(f"lower the {axis}{part} to {_round_down(value)} {unit}")
    period = evidence.parameters.period
    slowest = period * FASTEST
    if not is_late and evidence.info.rate is None and slowest > 1:
        share = min(_largest(partial(_holds, evidence, axis, "period")) for axis in _UNITS)
        if share and 1 / share < slowest:
            found.append(f"raise the rate to {_round_up(1 / (share * period))} Hz")
    return ", or ".join(found) or "lower stiffness and damping together"


_UNITS = {"": ("N/m", "N s/m"), "rotational ": ("N m/rad", "N m s/rad")}
_ROUNDING = 1e-9  # relative; keeps a limit found by bisection from losing a digit


def _holds(evidence: Evidence, axis: str, part: str, share: float) -> bool:
    """Returns True if the condition on a kind of axis holds after one quantity is reduced.

    ``axis`` is a key of ``_UNITS``. ``part`` (``stiffness``, ``damping`` or ``period``) is reduced
    to ``share`` of its value.
    """
    worst, felt, method = evidence.worst, evidence.asked, evidence.method
    period = worst.period * (share if part == "period" else 1.0)
    if part != "period":
        name = f"{axis.replace(' ', '_')}{part}"
        felt = replace(felt, **{name: share * getattr(felt, name)})
    used = method.used(felt, period / worst.substeps)
    changed = replace(worst, coupling=used, period=period)
    kind = "rotation" if axis else "translation"
    conditions = run_conditions(evidence.info, changed, method)
    return all(c.holds is not False for c in conditions if c.axis == kind)


def _largest(holds: Callable[[float], bool]) -> float:
    """Returns the largest share in (0, 1) up to which all shares hold; 0 if none does."""
    low, high = 0.0, 1.0
    if not holds(1e-6):
        return 0.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def _round_down(value: float) -> str:
    """Formats a limit with three digits."""
    return _three_digits(value * (1 + _ROUNDING), math.floor)


def _round_up(value: float) -> str:
    """Formats a limit with three digits."""
    return _three_digits(value * (1 - _ROUNDING), math.ceil)


def _three_digits(value: float, rounded: Callable[[float], int]) -> str:
    digit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return f"{rounded(value / digit) * digit:.6g}"
