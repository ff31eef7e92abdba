"""Normal velocity of an impact over its normal impulse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hapticbridge.arguments import Array


@dataclass(frozen=True, slots=True)
class NormalPath:
    """Piecewise linear v_n(P_n): slope ``first`` up to ``corner``, then slope ``second`` > 0.

    If ``first`` <= 0 (a jam), the corner is finite: μ|G| >= D and A D > G² give μA > |G|.

    Attributes:
        start: v_n at P_n = 0 in m/s, < 0.
        first: dv_n/dP_n up to the corner in 1/kg, any sign.
        second: dv_n/dP_n beyond the corner in 1/kg, > 0.
        corner: P_n at which the slip ends in N s, >= 0; inf if it never ends.
    """

    start: Array
    first: Array
    second: Array
    corner: Array

    def impulse_at(self, target: Array) -> Array:
        """Returns P_n at which v_n reaches a target >= 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            early = np.where(self.first > 0, (target - self.start) / self.first, np.inf)
        corner = np.where(np.isfinite(self.corner), self.corner, 0.0)
        at_corner = self.start + self.first * corner
        late = corner + (target - at_corner) / self.second
        return np.where(early <= self.corner, early, late)

    def impulse_after_work(self, compression: Array, e: Array) -> Array:
        """Returns P_n at which restitution has returned e² of the work done in compression."""
        corner = np.where(np.isfinite(self.corner), self.corner, 0.0)
        at_corner = self.start + self.first * corner
        turns_early = compression <= self.corner  # compression ends in the first segment
        # ∫ v_n dP_n up to P_c: one triangle, or a trapezium and a triangle
        taken = np.where(
            turns_early,
            0.5 * self.start * compression,
            0.5 * (self.start + at_corner) * corner + 0.5 * at_corner * (compression - corner),
        )
        returned = -(e**2) * taken
        slope = np.where(turns_early, self.first, self.second)
        # for a slope <= 0 the other branch below is used
        with np.errstate(divide="ignore", invalid="ignore"):
            plain = compression + np.sqrt(2 * returned / slope)
        # Restitution that begins before the corner may continue beyond it by q, a root of
        # ½ second q² + v q = rest. This form of the root does not cancel for a small rest.
        speed = np.maximum(at_corner, 0.0)
        rest = np.maximum(returned - 0.5 * speed * (corner - compression), 0.0)
        root = speed + np.sqrt(speed**2 + 2 * self.second * rest)
        beyond = corner + 2 * rest / np.where(root > 0, root, 1.0)
        return np.where(turns_early & (plain > self.corner), beyond, plain)
