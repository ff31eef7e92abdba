"""Devices with a prescribed motion, from a table of poses or a recording."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.device.base import (
    AXES,
    USUAL_SPEED_LIMIT,
    DeviceInfo,
    checked_period,
)
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.jit import compiled, direct
from hapticbridge.kernel.pose import (
    Quaternion,
    Vector,
    canonical,
    conjugate,
    product,
    quaternion_exp,
    rotation_between,
    scaled,
    store_quaternion,
    store_vector,
)
from hapticbridge.kernel.record import SAMPLE_DTYPE

UNFELT_FORCE_LIMIT, UNFELT_TORQUE_LIMIT = 100.0, 10.0
"""Default limits in N and N m of a prescribed motion, which drives no motor. The coupling's force
level acts on the tool too, so a device's limit here would let a heavy tool drop."""

# Prescribed motion: poses over time, interpolated within a tick

TIME_AND_POSITION = ("t", "x", "y", "z")
ORIENTATION = ("qw", "qx", "qy", "qz")
NORM_TOLERANCE = 1e-3
"""Largest deviation of a quaternion's norm from 1, without unit. It admits four printed digits, but
no mistake."""
MAX_NUMBER = 1e12
"""Largest magnitude of a time in s or a position in m; sums and differences remain finite."""


class Motion:
    """Poses at increasing times, interpolated linearly and by slerp, constant after the last.

    Attributes:
        table: Shape (n, 8), n >= 2: time in s from the first row (starting at 0), position in m,
            unit quaternion (w, x, y, z) with w >= 0.
    """

    def __init__(
        self, times: ArrayLike, positions: ArrayLike, quaternions: ArrayLike | None = None
    ) -> None:
        """Creates a motion from arrays.

        Args:
            times: Shape (n,), in s, n >= 2, finite and strictly increasing.
            positions: Shape (n, 3), in m, finite. Times and positions must be within ±1e12.
            quaternions: Shape (n, 4), (w, x, y, z), of norm 1 within 1e-3; None: no rotation.

        Raises:
            DeviceError: A shape or value is not valid; the message names the row, from 0.
        """
        count = np.size(np.asarray(times))
        if quaternions is None:
            quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        raw = times, positions, quaternions
        try:
            columns = [np.asarray(values, dtype=np.float64) for values in raw]
        except (TypeError, ValueError, OverflowError):  # text, or rows of different lengths
            raise DeviceError(
                "a motion's times, positions and quaternions must be numbers"
            ) from None
        shapes = [column.shape for column in columns]
        if shapes != [(count,), (count, 3), (count, 4)] or count < 2:
            raise DeviceError(
                f"a motion's times, positions and quaternions have the shapes {shapes}; they must "
                "be (n,), (n, 3) and (n, 4) with n >= 2"
            )
        table = np.column_stack(columns)
        if fault := first_fault(table):
            raise DeviceError(f"row {fault[0]} of the motion: {fault[1]}")
        table[:, 0] -= table[0, 0]
        direct(_normalise, table)(table)
        self.table: NDArray[np.float64] = table

    @property
    def duration(self) -> float:
        """Time of the last pose in s, counted from the first."""
        return float(self.table[-1, 0])

    def relative(self) -> Motion:
        """Returns the motion relative to its first pose: p − p_0 and q ⊗ q_0⁻¹."""
        return Motion(
            self.table[:, 0],
            self.table[:, 1:4] - self.table[0, 1:4],
            _relative_rotations(self.table[:, 4:]),
        )


PER_SECOND = {"ms": 1e3, "µs": 1e6, "ns": 1e9}
"""Number of these units of time in 1 s."""


def first_fault(table: NDArray[np.float64]) -> tuple[int, str] | None:
    """Returns the first invalid row of a motion and the reason; None if all rows are valid."""
    faults: list[tuple[int, str]] = []
    is_good = np.abs(table) <= MAX_NUMBER
    if not is_good.all():
        row = int(np.argmin(is_good.all(axis=1)))
        column = int(np.argmin(is_good[row]))
        name, value = (TIME_AND_POSITION + ORIENTATION)[column], float(table[row, column])
        fault = f"is beyond ±{MAX_NUMBER:g}" if np.isfinite(value) else "is not finite"
        for unit, count in PER_SECOND.items():
            if name == "t" and 1e8 * count < value < 4e9 * count:  # from 1973 to 2096
                fault += f"; times are in s, and this is one of a clock in {unit}"
        faults.append((row, f"{name} = {value:g} {fault}"))
        table = table[:row]
    times = table[:, 0]
    late = np.flatnonzero(~(times[1:] > times[:-1]))
    if late.size:
        row = int(late[0]) + 1
        faults.append(
            (
                row,
                f"time {times[row]:.15g} s after {times[row - 1]:.15g} s; "
                "times must strictly increase",
            )
        )
    norms = np.linalg.norm(table[:, 4:], axis=1)
    off = np.flatnonzero(~(np.abs(norms - 1.0) <= NORM_TOLERANCE))
    if off.size:
        row = int(off[0])
        faults.append(
            (row, f"quaternion of norm {norms[row]:.6g}; it must be 1 within {NORM_TOLERANCE:g}")
        )
    return min(faults, default=None)


@compiled
def _normalise(table: NDArray[np.float64]) -> None:
    for row in table:
        row[4], row[5], row[6], row[7] = canonical((row[4], row[5], row[6], row[7]))


@compiled
def _relative_to_first(quaternions: NDArray[np.float64], result: NDArray[np.float64]) -> None:
    first = quaternions[0]
    inverse = conjugate((first[0], first[1], first[2], first[3]))
    for i in range(quaternions.shape[0]):
        q = quaternions[i]
        turned = product((q[0], q[1], q[2], q[3]), inverse)
        for j in range(4):
            result[i, j] = turned[j]


def _relative_rotations(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    source, result = np.ascontiguousarray(quaternions), np.empty(quaternions.shape)
    direct(_relative_to_first, source, result)(source, result)
    return result


@compiled
def pose_at(table: NDArray[np.float64], time: float, cursor: int) -> tuple[int, Vector, Quaternion]:
    """Returns the pose of a motion at a time, interpolated linearly and by slerp.

    Args:
        table: ``Motion.table``.
        time: Time in s from the first row, >= 0; from the last row on, the last pose is returned.
        cursor: Row returned by an earlier call with an equal or earlier time, or 0; the search
            starts there.

    Returns:
        The row at or before the time, the position in m, and the quaternion.
    """
    last = table.shape[0] - 1
    while cursor < last and table[cursor + 1, 0] <= time:
        cursor += 1
    a = table[cursor]
    position = (a[1], a[2], a[3])
    quaternion = (a[4], a[5], a[6], a[7])
    if cursor == last or time <= a[0]:
        return cursor, position, quaternion
    b = table[cursor + 1]
    fraction = (time - a[0]) / (b[0] - a[0])
    position = (
        a[1] + fraction * (b[1] - a[1]),
        a[2] + fraction * (b[2] - a[2]),
        a[3] + fraction * (b[3] - a[3]),
    )
    turn = rotation_between(quaternion, (b[4], b[5], b[6], b[7]))
    turned = product(quaternion_exp(scaled(fraction, turn)), quaternion)
    return cursor, position, canonical(turned)


LISSAJOUS_AMPLITUDE = 0.01
"""Amplitude of the default motion along each axis in m."""
LISSAJOUS_ROTATION = 0.1
"""Amplitude of the default motion about each axis in rad."""
LISSAJOUS_EASE = 2.0
"""Time in s in which the default motion grows from rest to its full amplitude."""
DEFAULT_SECONDS = 5.0
"""Duration in s of the default hand motion, which reaches its full size after 2 s."""
_FREQUENCIES = (0.23, 0.31, 0.41, 0.17, 0.13, 0.19)
"""Frequencies of the default motion per axis in Hz: slow, without simple ratios."""


@compiled
def lissajous(time: float) -> tuple[Vector, Quaternion]:
    """Returns the default motion: a slow Lissajous figure that starts at rest.

        A s²(3 − 2s) sin(2πft),    s = min(t/2 s, 1)

    for each axis of translation and of the rotation vector, with its own f below 0.5 Hz and A = 1
    cm or 0.1 rad. The largest speed is 4.1 cm/s.
    """
    growth = min(time / LISSAJOUS_EASE, 1.0)
    ease = growth * growth * (3.0 - 2.0 * growth)
    phase = 2.0 * math.pi * time
    position = (
        math.sin(_FREQUENCIES[0] * phase),
        math.sin(_FREQUENCIES[1] * phase),
        math.sin(_FREQUENCIES[2] * phase),
    )
    rotation = (
        math.sin(_FREQUENCIES[3] * phase),
        math.sin(_FREQUENCIES[4] * phase),
        math.sin(_FREQUENCIES[5] * phase),
    )
    return (
        scaled(LISSAJOUS_AMPLITUDE * ease, position),
        quaternion_exp(scaled(LISSAJOUS_ROTATION * ease, rotation)),
    )


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


def _prescribed(duration: float, rate: float | None, **sheet: Any) -> DeviceInfo:
    """Returns the data sheet of a device that no force moves."""
    return DeviceInfo(
        name="trajectory",
        axes=AXES,
        rate=rate,
        delay=0.0,
        is_prescribed=True,
        is_real=False,
        duration=duration,
        **sheet,
    )


class TrajectoryDevice:
    """Device that follows a motion under any force; sample k is the pose at k · period.

    Between the motion's rows the position is interpolated linearly and the orientation by slerp.
    After the last row the pose is constant. Poses are reported as stored; the bridge may take them
    relative to the first one.

    Args:
        motion: Poses over time (``read_motion`` reads them from a CSV file).
        force_limit: Force level in N of the data sheet, > 0; it limits the wrench on the tool and
            the recorded one.
        torque_limit: Torque level in N m of the data sheet, > 0.
        speed_limit: Speed limit of the data sheet in m/s, >= 0.

    Raises:
        DeviceError: A limit is out of range.
    """

    def __init__(
        self,
        motion: Motion,
        *,
        force_limit: float = UNFELT_FORCE_LIMIT,
        torque_limit: float = UNFELT_TORQUE_LIMIT,
        speed_limit: float = USUAL_SPEED_LIMIT,
    ) -> None:
        self.info = _prescribed(
            duration=motion.duration,
            rate=None,
            buttons=0,
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
        force_limit: Force level in N of the data sheet, > 0; it limits the wrench on the tool and
            the recorded one.
        torque_limit: Torque level in N m of the data sheet, > 0.
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
        force_limit: float = UNFELT_FORCE_LIMIT,
        torque_limit: float = UNFELT_TORQUE_LIMIT,
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
