"""Identified parameters of one device axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.identify.estimate import Estimate

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AxisFit:
    """Identified parameters of one device axis.

    Attributes:
        mass: M in kg (rotation: kg m²).
        damping: b in N s/m (N m s/rad).
        friction: Coulomb friction f_c in N (N m).
        offset: Constant force c in N (N m): weight, or an offset of the motor.
        delay: Time in s from a write to its effect in a sample, beyond the hold.
        spring: Stiffness k in N/m (N m/rad) that explains the remainder, as of a hand or a cable.
        drag: b_2 in N s²/m² (N m s²/rad²) of a drag b_2 v |v| beside b v, as of oil. It belongs to
            the law if its interval excludes zero.
        drag_speed: Speed v in m/s (rad/s) at which ``damping`` is taken, as (b v + b_2 v |v|)/v. It
            is chosen so that ``damping`` is the smallest over the observed speeds: 0, or the
            largest speed if b_2 < 0.
        lost_gain: Share of the force above half of its maximum that had no effect, without unit: 0
            for a good motor, 1 for one that saturates there.
        unexplained: RMS force in N (N m) left by the law and by the position's noise and rounding.
        force: RMS of the applied force in N (N m).
        window: Length of the windows in s.
        count: Number of windows.
    """

    mass: Estimate
    damping: Estimate
    friction: Estimate
    offset: Estimate
    delay: Estimate
    spring: Estimate
    drag: Estimate
    drag_speed: float
    lost_gain: Estimate
    unexplained: float
    force: float
    window: float
    count: int

    def resistance(self, speed: Array) -> Array:
        """Returns b v + b_2 v |v| + f_c sign(v) in N (N m), with b_2 only if it is significant."""
        bend = self.drag.value * (np.abs(speed) - self.drag_speed) if self.drag.is_seen else 0.0
        return np.asarray(
            (self.damping.value + bend) * speed + self.friction.value * np.sign(speed)
        )
