"""Whether the swing of a device on a virtual wall dies down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NOISE_STEPS = 2.0
"""Amplitude in steps of resolution below which a swing has died down."""

DIED_DOWN = 1e-3
"""Share of the largest deflection below which a swing has died down, whatever it does then."""

HALTED = 0.95
"""Share of the allowed force at which the wall pushes as hard as it may: it is not a wall then."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One wall.

    Attributes:
        stiffness: K in N/m.
        damping: B in N s/m.
        is_borne: Whether the swing died down.
        growth: Amplitude in the last third of the trial over that in the middle third, without
            unit; 0 where nothing swung any more.
        swing: Time of one swing in s; 0 where nothing moved.
        energy: What the wall gave to the device after the push, in J.
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
    given: Array,
    push: int,
    period: float,
    *,
    stiffness: float,
    damping: float,
    force: float,
    resolution: float,
) -> Trial:
    """Tells a swing that dies down from one that does not.

    Its amplitude is that of x² + (x'/ω)², which for a swing of one frequency ω does not depend on
    where in a swing a third of the trial begins. What it swings about is the mean of the last
    third: a weight pulls it off the wall's place, and a slow return that does not swing is nearest
    there.

    Args:
        position: x − x_0 in m, shape (n,).
        given: Force on the device in N, shape (n,).
        push: Ticks of the push.
        period: T in s.
        stiffness: K in N/m.
        damping: B in N s/m.
        force: Largest force that was allowed, in N.
        resolution: Step of the position in m.
    """
    after = position[push:] - np.array_split(position[push:], 3)[2].mean()
    speed = np.diff(after, append=after[-1])
    fastest = float(np.std(speed))
    ratio = float(np.std(after)) / fastest if fastest > 0.0 else 0.0
    thirds = np.array_split(after, 3)
    amplitude = np.array_split(after**2 + (ratio * speed) ** 2, 3)
    middle, last = (float(np.sqrt(np.mean(part))) for part in amplitude[1:])
    peak = float(np.abs(given[push:]).max())
    is_quiet = last <= max(NOISE_STEPS * resolution, DIED_DOWN * float(np.abs(after).max()))
    growth = 0.0 if is_quiet or middle == 0.0 else last / middle
    halted = np.abs(given[-len(thirds[2]) :]) >= HALTED * force
    return Trial(
        stiffness=stiffness,
        damping=damping,
        is_borne=growth < 1.0 and not halted.any(),
        growth=growth,
        swing=2.0 * np.pi * ratio * period,
        energy=float(given[push:-1] @ np.diff(position[push:])),
        peak=peak,
    )
