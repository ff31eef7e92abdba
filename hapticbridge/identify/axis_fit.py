"""What a run tells of one axis of a device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.identify.estimate import Estimate

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AxisFit:
    """What a run tells of one axis.

    Attributes:
        mass: M in kg (rotation: kg m²).
        damping: b in N s/m (N m s/rad).
        friction: Coulomb friction f_c in N (N m).
        offset: Constant force c in N (N m): weight, or an offset of the motor.
        delay: From a write until it shows in a sample, beyond the hold, in s.
        spring: Stiffness k in N/m (N m/rad) that would explain the rest: a hand, a cable.
        drag: Drag b_2 in N s²/m² (N m s²/rad²): a resistance b_2 v |v| beside b v, as of oil. It is
            part of the law where its interval leaves zero out.
        drag_speed: Speed v in m/s (rad/s) at which ``damping`` is taken, as (b v + b_2 v |v|)/v, so
            that it is the least at any speed that was seen: 0, or the largest where b_2 < 0.
        lost_gain: Share of the force above half of the largest that did not act, without unit: 0
            for a good motor, 1 for one that saturates there.
        unexplained: RMS of the force that neither the law nor the noise and rounding of the
            position explain, in N (N m).
        force: RMS of the force that was applied, in N (N m).
        window: Length of the windows used, in s.
        count: How many there were.
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
        """Returns b v + b_2 v |v| + f_c sign(v) in N (N m), with b_2 where it is seen.

        Args:
            speed: v in m/s (rad/s).
        """
        bend = self.drag.value * (np.abs(speed) - self.drag_speed) if self.drag.is_seen else 0.0
        return np.asarray(
            (self.damping.value + bend) * speed + self.friction.value * np.sign(speed)
        )
