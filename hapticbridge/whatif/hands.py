"""Who moves the handle when a run is simulated again: the recorded motion, or a model hand.

A recorded motion is followed whatever the changed bridge does. That is exact, and no hand: a
stiffer wall would be pressed in as far as the softer one was.

A model hand gives way; what it wants follows from the recording (``intent``).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.device import AXES, DeviceInfo, Hand, Motion
from hapticbridge.device.lateness import delay_ticks
from hapticbridge.device.simulated.driver import SimulatedDevice
from hapticbridge.device.trajectory.driver import ReplayDevice, TrajectoryDevice
from hapticbridge.tick import SAMPLE_DTYPE
from hapticbridge.whatif.intent import intended

Array = NDArray[np.float64]


def missing_for_closed_loop(info: DeviceInfo) -> str:
    """Returns why a device's motion cannot be simulated, or nothing."""
    if info.is_prescribed:
        return "the recorded motion was prescribed: no device answered to the force"
    needed = {"mass": info.mass, "damping": info.damping}
    if info.turns:
        needed["rotational_inertia"] = info.rotational_inertia
        needed["rotational_damping"] = info.rotational_damping
    unknown = [name.replace("_", " ") for name, value in needed.items() if value is None]
    if unknown:
        return f"the device's {' and '.join(unknown)} unknown: 'hapticbridge identify' measures it"
    return ""


class _Buttons:
    """The recorded buttons at the times of a loop, which may have another rate."""

    def __init__(self, ticks: NDArray[np.void], period: float) -> None:
        self._pressed, self._recorded = ticks["buttons"].copy(), period
        self._tick, self._share = 0, 1.0

    def start(self, period: float) -> None:
        self._tick, self._share = 0, period / self._recorded

    def read(self, sample: NDArray[np.void]) -> None:
        """Puts those of this tick into a sample; after the last they stay as they are."""
        row = int(self._tick * self._share + 1e-9)  # a period in decimals is rounded
        sample["buttons"] = self._pressed[min(row, len(self._pressed) - 1)]
        self._tick += 1


class RecordedMotion(ReplayDevice):
    """The recorded samples, one a tick, from where the device was before the first one."""

    def __init__(
        self, ticks: NDArray[np.void], period: float, start: tuple[float, ...], info: DeviceInfo
    ) -> None:
        super().__init__(
            ticks,
            period,
            force_limit=info.force_limit,
            torque_limit=info.torque_limit,
            speed_limit=info.speed_limit,
        )
        self._before = start

    def start(self, period: float) -> NDArray[np.void]:
        """See ``Device.start``."""
        return _placed(super().start(period), self._before)


class ResampledMotion(TrajectoryDevice):
    """The recorded motion at another rate, linear between the samples and by slerp."""

    def __init__(
        self, ticks: NDArray[np.void], period: float, start: tuple[float, ...], info: DeviceInfo
    ) -> None:
        times = period * np.arange(len(ticks))
        motion = Motion(times, ticks["device_position"], ticks["device_quaternion"])
        super().__init__(
            motion,
            force_limit=info.force_limit,
            torque_limit=info.torque_limit,
            speed_limit=info.speed_limit,
        )
        self._before = start
        self._buttons = _Buttons(ticks, period)

    def start(self, period: float) -> NDArray[np.void]:
        """See ``Device.start``."""
        self._buttons.start(period)
        return _placed(super().start(period), self._before)

    def read(self, sample: NDArray[np.void]) -> int:
        """See ``TrajectoryDevice.read``."""
        flags = super().read(sample)
        self._buttons.read(sample)
        return flags


class IdentifiedDevice(SimulatedDevice):
    """The recorded device as its data sheet knows it, in a model hand that wants what it wanted.

    Args:
        info: The recorded device, with mass and damping (``missing_for_closed_loop``).
        hand: Who holds it.
        ticks: The recorded rows, ``TICK_DTYPE``, at least three.
        period: The recorded loop's in s.
        start: Device pose (7,) before the first tick.
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
            # without rotation nothing turns, whatever the inertia
            rotational_inertia=info.rotational_inertia or 1e-4,
            rotational_damping=info.rotational_damping or 0.0,
            hand=hand,
            resolution=info.resolution or 0.0,
            friction=info.friction or 0.0,
            delay=delay_ticks(info, period) or 0,
            force_limit=info.force_limit,
            torque_limit=info.torque_limit,
            speed_limit=info.speed_limit,
        )
        self._motion = intended(info, hand, ticks, period, start)
        self._start = np.array(start)
        self._origin = Rotation.from_quat(self._start[3:], scalar_first=True)
        self._buttons = _Buttons(ticks, period)
        self._felt = np.array([axis in info.axes for axis in AXES], dtype=np.float64)
        self.info = replace(info, is_real=False, duration=float(self._motion[-1, 0]))

    def start(self, period: float, parts: int = 1) -> NDArray[np.void]:
        """See ``SimulatedDevice.start``; the hand may pull from the start on."""
        sample = super().start(period, parts)
        self._buttons.start(period)
        state = self._states[0]
        state["target_position"] = self._motion[0, 1:4]
        state["target_quaternion"] = self._motion[0, 4:]
        return self._there(sample)

    def read(self, sample: NDArray[np.void]) -> int:
        """See ``SimulatedDevice.read``."""
        flags = super().read(sample)
        self._buttons.read(sample)
        self._there(sample)
        return flags

    def write(self, wrench: Array) -> None:
        """See ``SimulatedDevice.write``; what the device has no axis for does nothing."""
        super().write(wrench * self._felt)

    def _there(self, sample: NDArray[np.void]) -> NDArray[np.void]:
        """Moves a sample that counts from the start to where the recorded device was."""
        sample["position"][0] += self._start[:3]
        turned = Rotation.from_quat(sample["quaternion"][0], scalar_first=True) * self._origin
        sample["quaternion"][0] = turned.as_quat(canonical=True, scalar_first=True)
        return sample


def _placed(sample: NDArray[np.void], pose: tuple[float, ...]) -> NDArray[np.void]:
    placed = np.zeros(1, SAMPLE_DTYPE)
    placed["buttons"] = sample["buttons"]
    placed["position"][0], placed["quaternion"][0] = pose[:3], pose[3:]
    return placed
