"""Additional device damping required by the device's own update rate and delay."""

from __future__ import annotations

import math
from typing import Literal

from hapticbridge.coupling import Coupling
from hapticbridge.device.data_sheet import DeviceInfo
from hapticbridge.passivity import minimum_damping

_WHOLE = 1e-9
"""Excess over a whole number of ticks that counts as rounding, in ticks."""


def felt_period(info: DeviceInfo, period: float) -> float:
    """Returns the time in s for which a wrench acts: the loop's period, or the device's if longer.

    For a prescribed motion it is the loop's period.
    """
    if info.rate is None or info.is_prescribed:
        return period
    own = 1.0 / info.rate
    return own if own > period * (1.0 + _WHOLE) else period


def delay_ticks(info: DeviceInfo, period: float) -> int | None:
    """Returns the whole ticks from a sample to the resulting wrench; None if unknown."""
    if info.delay is None:
        return None
    return max(0, math.ceil(info.delay / felt_period(info, period) - _WHOLE))


def damping_for_delay(
    info: DeviceInfo,
    coupling: Coupling,
    period: float,
    axis: Literal["translation", "rotation"] = "translation",
) -> float:
    """Returns the additional damping required by the delay, in N s/m or N m s/rad.

        Δb = max(0, sup_θ [(K T/2) sin((2d + 1)θ/2)/sin(θ/2) − B cos((d + 1)θ)] − (K T/2 + B))

    d is the delay in ticks, T the result of ``felt_period``; for B = 0, Δb = K d T. With it the
    device is passive against a wall, which is necessary. For a general scene no finite damping
    suffices, so a device with a delay cannot be certified. An unknown delay adds nothing and cannot
    be certified either.

    Raises:
        CouplingError: The delay is longer than 50 ticks.

    References:
        Colgate & Schenkel 1997 (fixed environment).
    """
    ticks = delay_ticks(info, period)
    if not ticks:
        return 0.0
    felt = felt_period(info, period)
    late = minimum_damping(coupling, felt, delay=ticks, axis=axis)
    return max(0.0, late - minimum_damping(coupling, felt, axis=axis))
