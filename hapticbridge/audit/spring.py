"""Second computation of the coupling's springs, the twin of ``Spring`` in ``kernel.law``.

It imports nothing of the law on purpose: a fault there must not appear on both sides. Its force
levels are a second computation, too, of ``RunParameters.levels_on_tool``.

With u = K e + (B'/T) δe the wrench on the tool is g(‖u‖) u/‖u‖, and g(u) = min(u, F). All functions
take one number or vector per record.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.parameters import RunParameters

Array = NDArray[np.float64]


def levels_on_tool(parameters: RunParameters) -> tuple[float, float]:
    """Returns force and torque on the tool at the device's limits, in N and N m."""
    return (
        parameters.force_limit / parameters.force_scale,
        parameters.torque_limit * parameters.scale / parameters.force_scale,
    )


def shortened(vector: Array, limit: float) -> Array:
    """Scales vectors (n, 3) down to a largest norm."""
    norm = np.linalg.norm(vector, axis=1)
    share = np.divide(limit, norm, out=np.ones_like(norm), where=norm > limit)
    return np.asarray(vector * share[:, None])


@dataclass(frozen=True, slots=True)
class Spring:
    """Spring of the coupling for translation or rotation, with the gains of each record.

    Attributes:
        stiffness: K in N/m or N m/rad, (n,).
        level: F on the tool in N or N m.
    """

    stiffness: Array
    level: float

    def limited(self, u: Array) -> Array:
        """Returns the force g(‖u‖) u/‖u‖ of the linear law's u, (n, 3)."""
        return shortened(u, self.level)

    def force(self, stretch: Array) -> Array:
        """Returns the spring's own force at a stretch, (n, 3)."""
        return self.limited(self.stiffness[:, None] * stretch)

    def energy(self, stretch: Array) -> Array:
        """Returns ∫ g(K e) de in J from 0 to the length of a stretch, (n,)."""
        stiffness, length = self.stiffness, np.linalg.norm(stretch, axis=1)
        at_level = np.divide(
            self.level, stiffness, out=np.full_like(length, np.inf), where=stiffness > 0
        )
        elastic = np.minimum(length, at_level)
        return np.asarray(0.5 * stiffness * elastic**2 + self.level * (length - elastic))

    def is_straight(self, size: Array, change: Array) -> NDArray[np.bool_]:
        """Returns True where g has the slope 1 wherever the force ‖u‖ changes by less, (n,)."""
        return np.asarray(size + change <= self.level)


def springs(gains: Array, parameters: RunParameters) -> tuple[Spring, Spring]:
    """Returns the springs for translation and rotation; ``gains`` is K, B', K_r, B'_r, (n, 4)."""
    force, torque = levels_on_tool(parameters)
    return Spring(gains[:, 0], force), Spring(gains[:, 2], torque)
