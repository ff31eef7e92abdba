"""Decay of a device's swing on a virtual wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NOISE_STEPS = 2.0
"""Amplitude in steps of resolution below which a swing has decayed."""

DIED_DOWN = 1e-3
"""Amplitude relative to the largest deflection, without unit, below which a swing has decayed."""

HALTED = 0.95
"""Share of the allowed force, without unit, at which the wall counts as saturated. It then no
longer acts as a wall."""


@dataclass(frozen=True, slots=True)
class Trial:
    """Result of one wall.

    Attributes:
        stiffness: K in N/m.
        damping: B in N s/m.
        is_borne: True if the swing decayed.
        growth: Amplitude in the last third of the trial over that in the middle third, without
            unit; 0 if nothing swings any more.
        swing: Period of one swing in s; 0 if nothing moved.
        energy: Energy in J from the wall to the device after the push.
        peak: Largest force after the push in N.
    """

    stiffness: float
    damping: float
    is_borne: bool
    growth: float
    swing: float
    energy: float
    peak: float


def judged(
    position: Array,
    applied: Array,
    push: int,
    period: float,
    *,
    stiffness: float,
    damping: float,
    force: float,
    resolution: float,
) -> Trial:
    """Classifies a swing as decaying or not.

    Its squared amplitude is x² + (x'/ω)². For a swing of one frequency ω it does not depend on the
    phase at which a third of the trial begins. The centre of the swing is the mean of the last
    third. A weight pulls the device away from the wall's position, and a slow return without
    swinging is closest to its end there.

    Args:
        position: x − x_0 in m, shape (n,).
        applied: Force on the device in N, shape (n,).
        push: Length of the push in ticks.
        period: T in s.
        stiffness: K in N/m.
        damping: B in N s/m.
        force: Largest allowed force in N.
        resolution: Step of the position in m.
    """
    after = position[push:] - np.array_split(position[push:], 3)[2].mean()
    speed = np.diff(after, append=after[-1])
    fastest = float(np.std(speed))
    ratio = float(np.std(after)) / fastest if fastest > 0.0 else 0.0
    thirds = np.array_split(after, 3)
    amplitude = np.array_split(after**2 + (ratio * speed) ** 2, 3)
    middle, last = (float(np.sqrt(np.mean(part))) for part in amplitude[1:])
    peak = float(np.abs(applied[push:]).max())
    is_quiet = last <= max(NOISE_STEPS * resolution, DIED_DOWN * float(np.abs(after).max()))
    growth = 0.0 if is_quiet or middle == 0.0 else last / middle
    is_saturated = np.abs(applied[-len(thirds[2]) :]) >= HALTED * force
    return Trial(
        stiffness=stiffness,
        damping=damping,
        is_borne=growth < 1.0 and not is_saturated.any(),
        growth=growth,
        swing=2.0 * np.pi * ratio * period,
        energy=float(applied[push:-1] @ np.diff(position[push:])),
        peak=peak,
    )
