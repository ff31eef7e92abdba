"""A device of your own: a handle on a rail, swung by a simulated hand."""

import math

import numpy as np
from numpy.typing import NDArray

import hapticbridge as hb


class Rail:
    """One axis, 2 N s/m of damping, 0.6 kg with the hand."""

    info = hb.DeviceInfo(
        name="rail", axes=("x",), force_limit=10.0, damping=2.0, delay=0.0, is_real=False
    )

    def start(self, period: float) -> NDArray[np.void]:
        """Brings the handle to rest at its origin."""
        self.period, self.tick = period, 0
        self.position = self.velocity = self.force = 0.0
        sample = np.zeros(1, hb.SAMPLE_DTYPE)
        sample["quaternion"][0] = 1.0, 0.0, 0.0, 0.0
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        """Moves handle and hand by a tick, and reports the pose."""
        if self.tick > 0:
            pull = 0.5 * math.cos(6.0 * self.tick * self.period) + self.force
            self.velocity += self.period * (pull - 2.0 * self.velocity) / 0.6
            self.position += self.period * self.velocity
        self.tick += 1
        sample["position"][0] = self.position, 0.0, 0.0
        sample["quaternion"][0] = 1.0, 0.0, 0.0, 0.0
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Takes the force along x in N."""
        self.force = float(wrench[0])

    def close(self) -> None:
        """Ends the force."""
        self.force = 0.0


with hb.Bridge("virtual_wall", Rail(), clock=hb.SimulatedClock()) as bridge:
    summary = bridge.run(duration=2.0)
print(f"{summary.peak_force:.2f} N at the wall: {summary.environment}")
