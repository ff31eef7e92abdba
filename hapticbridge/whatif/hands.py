"""Model hand that holds the recorded device in a repetition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.device import AXES, DeviceInfo, Hand
from hapticbridge.device.lateness import delay_ticks
from hapticbridge.device.simulated.driver import SimulatedDevice
from hapticbridge.whatif.again import Outside
from hapticbridge.whatif.intent import intended

Array = NDArray[np.float64]


def missing_for_closed_loop(info: DeviceInfo) -> str:
    """Returns the reason why a device's motion cannot be simulated, or empty."""
    if info.is_prescribed:
        return "the recorded motion was prescribed, so no device responded to the force"
    needed = {"mass": info.mass, "damping": info.damping}
    if info.turns:
        needed["rotational_inertia"] = info.rotational_inertia
        needed["rotational_damping"] = info.rotational_damping
    unknown = [name.replace("_", " ") for name, value in needed.items() if value is None]
    if unknown:
        return (
            f"unknown {' and '.join(unknown)} of the device; measure with 'hapticbridge identify'"
        )
    return ""


class IdentifiedDevice(SimulatedDevice):
    """The recorded device by its data sheet, in a model hand with the recorded hand's intent.

    Unlike a prescribed motion (``again``), the hand yields to the force. It needs mass and damping
    (``missing_for_closed_loop``) and at least three rows. The device is held at the pose ``start``
    (7,) until the first tick.
    """

    def __init__(
        self,
        info: DeviceInfo,
        hand: Hand,
        ticks: NDArray[np.void],
        period: float,
        start: tuple[float, ...],
    ) -> None:
        super().__init__(
            mass=info.mass or 0.0,
            damping=info.damping or 0.0,
            # without rotational axes the inertia has no effect
            rotational_inertia=info.rotational_inertia or 1e-4,
            rotational_damping=info.rotational_damping or 0.0,
            hand=hand,
            resolution=info.resolution or 0.0,
            friction=info.friction or 0.0,
            force_limit=info.force_limit,
            torque_limit=info.torque_limit,
            speed_limit=info.speed_limit,
        )
        self._motion = intended(info, hand, ticks, period, start)
        self._start = np.array(start)
        self._origin = Rotation.from_quat(self._start[3:], scalar_first=True)
        self._outside = Outside(ticks, period)
        self._felt = np.array([axis in info.axes for axis in AXES], dtype=np.float64)
        self.info = replace(info, is_real=False, duration=float(self._motion[-1, 0]))

    def start(self, period: float, parts: int = 1) -> NDArray[np.void]:
        """Implements ``SimulatedDevice.start``; the hand may pull from the start on."""
        self._delay = delay_ticks(self.info, period) or 0  # in ticks of this loop
        sample = super().start(period, parts)
        self._outside.start(period)
        state = self._states[0]
        state["target_position"] = self._motion[0, 1:4]
        state["target_quaternion"] = self._motion[0, 4:]
        return self._to_recorded_frame(sample)

    def read(self, sample: NDArray[np.void]) -> int:
        """Implements ``SimulatedDevice.read``."""
        flags = super().read(sample)
        # buttons only; this device always has new samples
        self._outside.read(sample)
        self._to_recorded_frame(sample)
        return flags

    def write(self, wrench: Array) -> None:
        """Implements ``SimulatedDevice.write``; components without a device axis have no effect."""
        super().write(wrench * self._felt)

    def _to_recorded_frame(self, sample: NDArray[np.void]) -> NDArray[np.void]:
        """Moves a sample from coordinates relative to the start to the device's coordinates."""
        sample["position"][0] += self._start[:3]
        turned = Rotation.from_quat(sample["quaternion"][0], scalar_first=True) * self._origin
        sample["quaternion"][0] = turned.as_quat(canonical=True, scalar_first=True)
        return sample
