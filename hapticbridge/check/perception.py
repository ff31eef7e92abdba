"""Perceptible difference between two versions of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.demand.pulse import FORCE_FLOOR
from hapticbridge.errors import SceneError

WEBER = 0.07
"""Just noticeable difference of a force as a share of it, without unit: 7 % from 2.5 to 10 N in the
fingers (Pang, Tan & Durlach 1991). For torque 12.7 % was measured (Jandura & Srinivasan 1994), so 7
% is the stricter choice. A larger value allows more simplification."""

LEVER = 0.05
"""Lever arm in m that converts a torque threshold into a force threshold: half a hand's breadth.
The torque threshold is at least the force threshold times this arm."""


@dataclass(frozen=True, slots=True)
class FeltError:
    """Difference of two versions of a scene under one motion of the handle.

    Attributes:
        force_rms: RMS force difference over all ticks and axes in N: √(mean ‖Δf‖²).
        force_peak: Largest ‖Δf‖ in N.
        torque_rms: RMS torque difference in N m: √(mean ‖Δτ‖²).
        torque_peak: Largest ‖Δτ‖ in N m.
        force_threshold: One just noticeable difference of force, in N.
        torque_threshold: One just noticeable difference of torque, in N m.
        position_peak: Largest distance between the two tools, in m.
        angle_peak: Largest angle between the two tools, in rad.
    """

    force_rms: float
    force_peak: float
    torque_rms: float
    torque_peak: float
    force_threshold: float
    torque_threshold: float
    position_peak: float
    angle_peak: float

    @property
    def force(self) -> float:
        """RMS force difference in just noticeable differences."""
        return self.force_rms / self.force_threshold

    @property
    def torque(self) -> float:
        """RMS torque difference in just noticeable differences."""
        return self.torque_rms / self.torque_threshold

    @property
    def jnd(self) -> float:
        """Larger of force and torque difference; 1 is just noticeable."""
        return max(self.force, self.torque)

    @property
    def peak(self) -> float:
        """Largest momentary difference in just noticeable differences; reported, not judged."""
        return max(self.force_peak / self.force_threshold, self.torque_peak / self.torque_threshold)


def felt_error(original: NDArray[np.void], variant: NDArray[np.void]) -> FeltError:
    """Compares two rehearsals of one motion.

        felt = max(RMS ‖Δf‖ / θ_f, RMS ‖Δτ‖ / θ_τ)
        θ_f = max(0.07 RMS ‖f‖, 0.03 N),    θ_τ = max(0.07 RMS ‖τ‖, 0.05 m · θ_f)

    The RMS runs over the whole motion. An event that comes one tick later therefore does not count
    with its full height, but a short event is diluted by the rest of the motion. Compare motions
    that do one thing.

    Args:
        original: Records, ``TICK_DTYPE``; its wrenches set the thresholds.
        variant: Records of the same motion: equally many, or every n-th at an n-th of the rate.

    Raises:
        SceneError: There are no records, or they are not of the same motion.

    References:
        Pang, Tan & Durlach, Perception & Psychophysics 49, 1991. King, Donlin & Hannaford, IEEE
        Haptics Symposium 2010. Lee & Hannaford, Haptic Interfaces Symposium 2003. Jandura &
        Srinivasan, ASME Dynamic Systems and Control 55, 1994.
    """
    if original.size == 0 or variant.size == 0:
        raise SceneError("there is nothing to compare: a motion needs at least one tick")
    every = max(1, round(original.size / variant.size))
    rows = original[::every]
    if rows.size != variant.size:
        raise SceneError(
            f"{original.size} and {variant.size} ticks are not of the same motion; one number must "
            "be a multiple of the other"
        )
    whole = original["wrench_on_tool"]
    force_threshold = max(WEBER * _rms(whole[:, :3]), FORCE_FLOOR)
    torque_threshold = max(WEBER * _rms(whole[:, 3:]), LEVER * force_threshold)
    difference = variant["wrench_on_tool"] - rows["wrench_on_tool"]
    apart = variant["tool_position"] - rows["tool_position"]
    return FeltError(
        force_rms=_rms(difference[:, :3]),
        force_peak=float(np.linalg.norm(difference[:, :3], axis=1).max()),
        torque_rms=_rms(difference[:, 3:]),
        torque_peak=float(np.linalg.norm(difference[:, 3:], axis=1).max()),
        force_threshold=force_threshold,
        torque_threshold=torque_threshold,
        position_peak=float(np.linalg.norm(apart, axis=1).max()),
        angle_peak=float(tool_angles(rows, variant).max()),
    )


def tool_angles(first: NDArray[np.void], second: NDArray[np.void]) -> NDArray[np.float64]:
    """Returns the angles in rad between the tools of two records, shape (n,), from 0 to π.

    It uses sine and cosine of half the angle; the arccosine alone rounds below 3e-8 rad.
    """
    a, b = first["tool_quaternion"], second["tool_quaternion"]
    sine = np.linalg.norm(_vector_part(a, b), axis=1)
    return np.asarray(2.0 * np.arctan2(sine, np.abs(np.sum(a * b, axis=1))))


def _rms(vectors: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _vector_part(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the vector part of a b⁻¹, whose length is the sine of half the angle."""
    return b[:, :1] * a[:, 1:] - a[:, :1] * b[:, 1:] - np.cross(a[:, 1:], b[:, 1:])
