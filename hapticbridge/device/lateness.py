"""What a device's own rate and the age of its samples ask of its damping, beyond the loop's."""

from __future__ import annotations

import math
from typing import Literal

from hapticbridge.coupling import Coupling
from hapticbridge.device.data_sheet import DeviceInfo
from hapticbridge.passivity import minimum_damping

_WHOLE = 1e-9  # of a tick: a delay that is this little above whole ticks is as many


def felt_period(info: DeviceInfo, period: float) -> float:
    """Returns for how long in s a device feels one wrench: a loop's period, or its own if longer.

    Args:
        info: The device; one whose motion is prescribed feels nothing.
        period: The loop's, in s.
    """
    if info.rate is None or info.is_prescribed:
        return period
    own = 1.0 / info.rate
    return own if own > period * (1.0 + _WHOLE) else period


def delay_ticks(info: DeviceInfo, period: float) -> int | None:
    """Returns after how many whole ticks a wrench answers a sample; None where that is unknown.

    Args:
        info: The device.
        period: The loop's, in s.
    """
    if info.delay is None:
        return None
    return max(0, math.ceil(info.delay / felt_period(info, period) - _WHOLE))


def damping_for_delay(
    info: DeviceInfo,
    coupling: Coupling,
    period: float,
    axis: Literal["translation", "rotation"] = "translation",
) -> float:
    """Returns how much more damping b the delay asks for, in N s/m or N m s/rad.

        Δb = max(0, sup_θ [(K T/2) sin((2d + 1)θ/2)/sin(θ/2) − B cos((d + 1)θ)] − (K T/2 + B))

    d the delay in ticks, T the period that is felt; for B = 0 it is K d T. With it the device bears
    a wall behind the coupling, which is necessary. For any scene no finite damping is enough, so
    nobody can certify a device with a delay. An unknown delay adds nothing, and certifies nothing.

    Args:
        info: The device.
        coupling: K and B of the law.
        period: The loop's, in s.
        axis: Which gains to take.

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
