"""Line of passivity in the plane of K and B."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.passivity.wall import wall_supremum

_Array = NDArray[np.float64]

SECANTS, SETTLED = 60, 1e-13
"""Largest number of secant steps towards the line against a wall, and relative step in K at which
they end. About ten steps are taken. The step equals the resolution of the bound. Both without
unit."""

SOFT = 1e-12
"""Stiffness, as a share of B/T or b/T, that stands for K → 0, without unit."""


@dataclass(frozen=True, slots=True)
class PassiveLine:
    """Largest passive stiffness of a device as a function of the coupling's damping.

    Attributes:
        b: Device damping in N s/m, > 0.
        period: T in s, > 0.
        delay: d in samples; for d >= 1 the line is that against a wall.
        filter_time: τ in s, >= 0.
    """

    b: float
    period: float
    delay: int
    filter_time: float

    @property
    def share(self) -> float:
        """Share of B in the device condition without a delay: T/(T + 2τ)."""
        return self.period / (self.period + 2 * self.filter_time)

    def stiffness(self, damping: _Array) -> _Array:
        """Returns the largest K in N/m for any hand; with a delay, against a wall."""
        if self.delay == 0:
            return np.maximum(0.0, 2 * (self.b - self.share * damping) / self.period)
        # The damping that a wall requires is convex in K, so secants from above never cross the
        # line. They start above it, because at ω → 0 a wall already requires (d + ½) K T − B.
        soft = SOFT * self.b / self.period
        before, last = ((self.b + damping) / (self.period * self.delay) * x for x in (1.1, 1.0))
        needed_before = self._needed(before, damping)
        for _ in range(SECANTS):
            needed = self._needed(last, damping)
            rise, step = needed_before - needed, before - last
            following = last - (needed - self.b) * step / np.where(rise > 0, rise, np.inf)
            before, needed_before = last, needed
            last = np.clip(following, soft, last)
            if (before - last <= SETTLED * before).all():
                break
        return np.where(last > 2 * soft, last, 0.0)

    def largest_damping(self) -> float:
        """Returns the B in N s/m at which ``stiffness`` falls to 0."""
        if self.delay == 0:
            return self.b / self.share
        return float(self.b / self._needed(np.full(1, SOFT / self.period), np.ones(1))[0])

    def _needed(self, stiffness: _Array, damping: _Array) -> _Array:
        return wall_supremum(
            stiffness, damping, self.period, "backward", self.delay, self.filter_time
        )[0]
