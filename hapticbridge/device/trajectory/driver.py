"""Devices with a prescribed motion, from a table of poses or a recording."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.data_sheet import (
    AXES,
    USUAL_FORCE_LIMIT,
    USUAL_SPEED_LIMIT,
    USUAL_TORQUE_LIMIT,
    DeviceInfo,
    checked_period,
)
from hapticbridge.device.trajectory.motion import NORM_TOLERANCE, Motion, pose_at
from hapticbridge.errors import DeviceError
from hapticbridge.jit import compiled, direct
from hapticbridge.pose import store_quaternion, store_vector
from hapticbridge.tick import SAMPLE_DTYPE

_STATE_DTYPE = np.dtype([("tick", "<i8"), ("cursor", "<i8"), ("period", "<f8")])

_PERIOD_TOLERANCE = 1e-9
"""Relative difference of periods that counts as rounding, as between whole ns and decimal text."""


@compiled
def _next_sample(
    states: NDArray[np.void], motion: NDArray[np.float64], samples: NDArray[np.void]
) -> None:
    """Writes the pose at the time of the tick, and advances to the next tick."""
    s = states[0]
    sample = samples[0]
    s.cursor, position, quaternion = pose_at(motion, s.tick * s.period, s.cursor)
    s.tick += 1
    store_vector(sample.position, position)
    store_quaternion(sample.quaternion, quaternion)
    sample.buttons = 0


def _prescribed(
    *,
    duration: float,
    rate: float | None,
    force_limit: float,
    torque_limit: float,
    speed_limit: float,
) -> DeviceInfo:
    """Returns the data sheet of a device that no force moves."""
    return DeviceInfo(
        name="trajectory",
        axes=AXES,
        mass=None,
        damping=None,
        rotational_inertia=None,
        rotational_damping=None,
        friction=None,
        resolution=None,
        force_limit=force_limit,
        torque_limit=torque_limit,
        speed_limit=speed_limit,
        rate=rate,
        delay=0.0,
        is_prescribed=True,
        is_real=False,
        duration=duration,
    )


class TrajectoryDevice:
    """Device that follows a motion under any force; sample k is the pose at k · period.

    Between the motion's rows the position is interpolated linearly and the orientation by slerp.
    After the last row the pose is constant. Poses are reported as stored; the bridge may take them
    relative to the first one.

    Args:
        motion: Poses over time (``read_motion`` reads them from a CSV file).
        force_limit: Force limit of the data sheet in N, >= 0; it limits the recorded wrench.
        torque_limit: Torque limit of the data sheet in N m, >= 0; it limits the recorded wrench.
        speed_limit: Speed limit of the data sheet in m/s, >= 0.

    Raises:
        DeviceError: A limit is out of range.
    """

    def __init__(
        self,
        motion: Motion,
        *,
        force_limit: float = USUAL_FORCE_LIMIT,
        torque_limit: float = USUAL_TORQUE_LIMIT,
        speed_limit: float = USUAL_SPEED_LIMIT,
    ) -> None:
        self.info = _prescribed(
            duration=motion.duration,
            rate=None,
            force_limit=force_limit,
            torque_limit=torque_limit,
            speed_limit=speed_limit,
        )
        self._table = motion.table
        self._states = np.zeros(1, _STATE_DTYPE)
        self._is_started = False

    def start(self, period: float) -> NDArray[np.void]:
        """Goes to the first row, and compiles the functions of the loop."""
        self._states[0] = (0, 0, checked_period(period))
        sample = np.zeros(1, SAMPLE_DTYPE)
        self._advance = direct(_next_sample, self._states, self._table, sample)
        self._advance(self._states.copy(), self._table, sample)
        self._is_started = True
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        """Returns the pose of this tick, without buttons."""
        if not self._is_started:
            raise DeviceError("the trajectory is read before it was started; call start() first")
        self._advance(self._states, self._table, sample)
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Ignores the wrench, because the motion is prescribed."""

    def close(self) -> None:
        """Does nothing, because the device holds no resources."""


class ReplayDevice:
    """Device that repeats a recording's device motion sample by sample, with buttons.

    Sample k equals row k of the recording, bit for bit; after the last row the sample is constant.
    Missed deadlines of the recorded run are not reproduced as time.

    Args:
        ticks: The recording's rows, ``TICK_DTYPE``, at least two.
        period: The recorded loop's period in s; ``start`` accepts no other.
        name: Name of the recording in messages.
        force_limit: Force limit of the data sheet in N, >= 0; it limits the recorded wrench.
        torque_limit: Torque limit of the data sheet in N m, >= 0; it limits the recorded wrench.
        speed_limit: Speed limit of the data sheet in m/s, >= 0.

    Raises:
        DeviceError: Fewer than two rows, missing rows, a pose that is not finite or not a rotation,
            or a limit or period out of range.
    """

    def __init__(
        self,
        ticks: NDArray[np.void],
        period: float,
        *,
        name: str = "recording",
        force_limit: float = USUAL_FORCE_LIMIT,
        torque_limit: float = USUAL_TORQUE_LIMIT,
        speed_limit: float = USUAL_SPEED_LIMIT,
    ) -> None:
        if len(ticks) < 2:
            raise DeviceError(f"{name}: holds {len(ticks)} of at least two ticks")
        numbers = ticks["tick"]
        if (gaps := np.flatnonzero(np.diff(numbers) != 1)).size:
            raise DeviceError(
                f"{name}: tick {numbers[gaps[0]]} is followed by tick {numbers[gaps[0] + 1]}; "
                "a motion with rows missing cannot be replayed sample by sample"
            )
        quaternions = ticks["device_quaternion"]
        norms = np.linalg.norm(quaternions, axis=1)
        is_good = np.isfinite(ticks["device_position"]).all(axis=1)
        is_good &= np.abs(norms - 1.0) <= NORM_TOLERANCE
        if not is_good.all():
            raise DeviceError(
                f"{name}: the device's pose at tick {numbers[np.argmin(is_good)]} is not finite, "
                "or its quaternion not of norm 1"
            )
        self._name = name
        self._period = checked_period(period)
        self._samples = np.zeros(len(ticks), SAMPLE_DTYPE)
        self._samples["position"] = ticks["device_position"]
        self._samples["quaternion"] = quaternions
        self._samples["buttons"] = ticks["buttons"]
        self.info = _prescribed(
            duration=(len(ticks) - 1) * self._period,
            rate=1.0 / self._period,
            force_limit=force_limit,
            torque_limit=torque_limit,
            speed_limit=speed_limit,
        )
        self._tick = -1

    def start(self, period: float) -> NDArray[np.void]:
        """Goes to the first row; the loop's period must equal the recording's."""
        if abs(checked_period(period) - self._period) > _PERIOD_TOLERANCE * self._period:
            raise DeviceError(
                f"{self._name}: was recorded at {1.0 / self._period:.9g} Hz, the loop runs at "
                f"{1.0 / period:.9g} Hz; a recording is replayed sample by sample, so the rates "
                "must be the same"
            )
        self._tick = 0
        return np.asarray(self._samples[:1].copy())

    def read(self, sample: NDArray[np.void]) -> int:
        """Returns the recorded sample of this tick."""
        tick = self._tick
        if tick < 0:
            raise DeviceError(f"{self._name} is read before it was started; call start() first")
        sample[0] = self._samples[tick]
        if tick + 1 < len(self._samples):
            self._tick = tick + 1
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Ignores the wrench, because the motion is prescribed."""

    def close(self) -> None:
        """Does nothing, because the device holds no resources."""
