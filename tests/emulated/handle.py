"""The mechanics behind an emulated device: a handle with mass, damping and friction, in a hand."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device import Motion, SimulatedDevice, read_motion
from hapticbridge.scene import scene_path

STEP = 125e-6
"""Step in s: the force is held over each one, which is then exact. An eighth of a loop's period, a
high-speed USB microframe: a force that arrives between two ticks acts at most this much late."""

_ROUNDING = 1e-6
"""Tolerance in steps: a time that is this little short of a step's end has reached it. Times are
sums of periods in binary fractions and miss whole steps by rounding, which must not cost a step."""


class Handle:
    """A simulated device that is moved up to a time, however irregularly the time is told.

    Attributes:
        force: Shape (6,): force in N and torque in N m on the handle, held until changed. Change it
            after ``advance``, or it acts in the past.

    Args:
        mechanics: What moves, not yet started: mass, damping, friction and hand as they should be.
            Encoder steps belong to the model of the device, not here.
    """

    def __init__(self, mechanics: SimulatedDevice) -> None:
        self.force: NDArray[np.float64] = np.zeros(6)
        self._mechanics = mechanics
        self._sample = mechanics.start(STEP)
        self._start: float | None = None
        self._steps = 0

    def advance(self, now: float) -> None:
        """Moves the handle up to a time; the first call only says when time begins.

        Args:
            now: In s; a time before the newest one changes nothing.
        """
        if self._start is None:
            self._start = now
            self._mechanics.read(self._sample)
        due = math.floor((now - self._start) / STEP + _ROUNDING)
        while self._steps < due:
            self._mechanics.write(self.force)
            self._mechanics.read(self._sample)
            self._steps += 1

    def pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns position in m and unit quaternion (w, x, y, z) from where the handle started."""
        sample = self._sample[0]
        return sample["position"].copy(), sample["quaternion"].copy()

    def velocity(self) -> NDArray[np.float64]:
        """Returns velocity in m/s and angular velocity in rad/s, shape (6,)."""
        return self._mechanics.velocity


def planar_hand(scene: str) -> Motion:
    """Returns the path that comes with a scene in x and z, laid into the x and y of a stick."""
    table = read_motion(scene_path(scene).with_suffix(".csv")).table
    return Motion(table[:, 0], np.column_stack([table[:, 1], table[:, 3], 0.0 * table[:, 0]]))
