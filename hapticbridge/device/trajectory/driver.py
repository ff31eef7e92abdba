"""Devices whose motion is given beforehand: from a table of poses, or from a recording."""

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

_PERIOD_TOLERANCE = 1e-9  # relative: a period in whole ns and its decimal text differ by rounding


@compiled
def _next_sample(
    states: NDArray[np.void], motion: NDArray[np.float64], samples: NDArray[np.void]
) -> None:
    """Reports the pose at the time of the tick, and moves on to the next."""
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
    """Follows a motion whatever the force: the sample of tick k is its pose at k · period.

    Between the motion's rows the position is interpolated linearly and the orientation by slerp;
    after the last row it stays there. The poses are reported as the motion holds them; whether
    they count from the first one is the bridge's choice.

    Args:
        motion: Poses over time (``read_motion`` reads them from a CSV file).
        force_limit: In N, >= 0, for the data sheet: what the recorded wrench is limited to.
        torque_limit: In N m, >= 0, likewise.
        speed_limit: In m/s, >= 0, for the data sheet.

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
        """Goes to the first row, and compiles what the loop will call.

        Args:
            period: The loop's period in s, finite and > 0.

        Returns:
            The pose before the first tick, shape (1,), ``SAMPLE_DTYPE``.

        Raises:
            DeviceError: The period is not.
        """
        self._states[0] = (0, 0, checked_period(period))
        sample = np.zeros(1, SAMPLE_DTYPE)
        self._advance = direct(_next_sample, self._states, self._table, sample)
        self._advance(self._states.copy(), self._table, sample)
        self._is_started = True
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        """Reports the pose of this tick, no buttons.

        Args:
            sample: Shape (1,), ``SAMPLE_DTYPE``, filled in place.

        Raises:
            DeviceError: ``start`` has not been called.
        """
        if not self._is_started:
            raise DeviceError("the trajectory is read before it was started")
        self._advance(self._states, self._table, sample)
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Ignores the wrench: the motion is prescribed."""

    def close(self) -> None:
        """Does nothing: there is nothing to release."""


class ReplayDevice:
    """Repeats the device motion of a recording sample by sample, buttons included.

    Sample k is that of the recording's row k, to the bit; after the last one it stays there. A
    deadline that the recorded run missed does not come back as time.

    Args:
        ticks: The recording's rows, ``TICK_DTYPE``, at least two.
        period: The recorded loop's period in s; ``start`` accepts no other.
        name: What the recording is called in messages.
        force_limit: In N, >= 0, for the data sheet: what the recorded wrench is limited to.
        torque_limit: In N m, >= 0, likewise.
        speed_limit: In m/s, >= 0, for the data sheet.

    Raises:
        DeviceError: There are fewer than two rows, rows are missing in between, a pose is not
            finite or no rotation, or a limit or the period is out of range.
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
        """Goes to the first row.

        Args:
            period: The loop's period in s: that of the recording.

        Returns:
            The pose before the first tick, shape (1,), ``SAMPLE_DTYPE``.

        Raises:
            DeviceError: It is another.
        """
        if abs(checked_period(period) - self._period) > _PERIOD_TOLERANCE * self._period:
            raise DeviceError(
                f"{self._name}: was recorded at {1.0 / self._period:.9g} Hz, the loop runs at "
                f"{1.0 / period:.9g} Hz; a recording is replayed sample by sample, so the rates "
                "must be the same"
            )
        self._tick = 0
        return np.asarray(self._samples[:1].copy())

    def read(self, sample: NDArray[np.void]) -> int:
        """Reports the recorded sample of this tick.

        Args:
            sample: Shape (1,), ``SAMPLE_DTYPE``, filled in place.

        Raises:
            DeviceError: ``start`` has not been called.
        """
        tick = self._tick
        if tick < 0:
            raise DeviceError(f"{self._name} is read before it was started")
        sample[0] = self._samples[tick]
        if tick + 1 < len(self._samples):
            self._tick = tick + 1
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Ignores the wrench: the motion is prescribed."""

    def close(self) -> None:
        """Does nothing: there is nothing to release."""
