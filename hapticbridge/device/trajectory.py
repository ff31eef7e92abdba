"""Devices whose motion is given beforehand: from a table of poses, or from a recording."""

from __future__ import annotations

import math
import os
import stat
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.device.base import (
    AXES,
    USUAL_FORCE_LIMIT,
    USUAL_SPEED_LIMIT,
    USUAL_TORQUE_LIMIT,
    DeviceInfo,
    checked_period,
)
from hapticbridge.errors import DeviceError
from hapticbridge.jit import compiled, direct
from hapticbridge.pose import (
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
from hapticbridge.record import SAMPLE_DTYPE

# A prescribed motion: poses over time, interpolated within a tick.

TIME_AND_POSITION = ("t", "x", "y", "z")
ORIENTATION = ("qw", "qx", "qy", "qz")
NORM_TOLERANCE = 1e-3
"""How far a quaternion's norm may be from 1: room for four printed digits, not for a mistake."""
LARGEST_NUMBER = 1e12
"""No time in s and no position in m is beyond this; sums and differences stay finite."""


class Motion:
    """Poses at increasing times, linear and by slerp in between, at rest after the last.

    Attributes:
        table: Shape (n, 8), n >= 2: time in s from the first row (so it starts at 0), position
            in m, unit quaternion (w, x, y, z) with w >= 0.
    """

    def __init__(
        self, times: ArrayLike, positions: ArrayLike, quaternions: ArrayLike | None = None
    ) -> None:
        """Takes a motion from arrays.

        Args:
            times: Shape (n,), in s, n >= 2, finite and strictly increasing.
            positions: Shape (n, 3), in m, finite. Neither is beyond ±1e12.
            quaternions: Shape (n, 4), (w, x, y, z), of norm 1 within 1e-3; None: no rotation.

        Raises:
            DeviceError: A shape or value is not as above; the message names the row, from 0.
        """
        columns = [np.asarray(times, dtype=np.float64), np.asarray(positions, dtype=np.float64)]
        count = columns[0].size
        if quaternions is None:
            columns.append(np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)))
        else:
            columns.append(np.asarray(quaternions, dtype=np.float64))
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
        _normalise(table)
        self.table: NDArray[np.float64] = table

    @property
    def duration(self) -> float:
        """Time of the last pose in s, counted from the first."""
        return float(self.table[-1, 0])

    def relative(self) -> Motion:
        """Returns the motion from its first pose: p − p_0, and q ⊗ q_0⁻¹ in the same axes."""
        return Motion(
            self.table[:, 0],
            self.table[:, 1:4] - self.table[0, 1:4],
            _relative_rotations(self.table[:, 4:]),
        )


def first_fault(table: NDArray[np.float64]) -> tuple[int, str] | None:
    """Returns the first row that is no part of a motion, and why; None where all are."""
    faults: list[tuple[int, str]] = []
    is_good = np.abs(table) <= LARGEST_NUMBER
    if not is_good.all():
        row = int(np.argmin(is_good.all(axis=1)))
        column = int(np.argmin(is_good[row]))
        name, value = (TIME_AND_POSITION + ORIENTATION)[column], float(table[row, column])
        fault = f"is beyond ±{LARGEST_NUMBER:g}" if np.isfinite(value) else "is not finite"
        faults.append((row, f"{name} = {value:g} {fault}"))
        table = table[:row]
    times = table[:, 0]
    late = np.flatnonzero(~(times[1:] > times[:-1]))
    if late.size:
        row = int(late[0]) + 1
        faults.append(
            (
                row,
                f"time {times[row]:.9g} s after {times[row - 1]:.9g} s; "
                "times must strictly increase",
            )
        )
    norms = np.linalg.norm(table[:, 4:], axis=1)
    off = np.flatnonzero(~(np.abs(norms - 1.0) <= NORM_TOLERANCE))
    if off.size:
        row = int(off[0])
        faults.append(
            (
                row,
                f"quaternion of norm {norms[row]:.6g}; it must be 1 within {NORM_TOLERANCE:g}",
            )
        )
    return min(faults, default=None)


@compiled
def _normalise(table: NDArray[np.float64]) -> None:
    """Scales the quaternions of a table to norm 1 and w >= 0."""
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
    result = np.empty(quaternions.shape)
    _relative_to_first(np.ascontiguousarray(quaternions), result)
    return result


@compiled
def pose_at(table: NDArray[np.float64], time: float, cursor: int) -> tuple[int, Vector, Quaternion]:
    """Returns the pose of a motion at a time, interpolated linearly and by slerp.

    Args:
        table: ``Motion.table``.
        time: In s from the first row, >= 0; at and beyond the last row the last pose holds.
        cursor: The row that an earlier call with no later time returned, or 0: rows before it
            are not searched again.

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
"""Half the width of the default motion along each axis, in m."""
LISSAJOUS_ROTATION = 0.1
"""Largest angle of the default motion about each axis, in rad."""
LISSAJOUS_EASE = 2.0
"""The default motion grows from rest to its full size in this time, in s."""
_FREQUENCIES = (0.23, 0.31, 0.41, 0.17, 0.13, 0.19)  # Hz: slow, and no two in a simple ratio


@compiled
def lissajous(time: float) -> tuple[Vector, Quaternion]:
    """Returns the default motion: a slow Lissajous figure that starts at rest.

    Each axis, of translation and of the rotation vector, is A s²(3 − 2s) sin(2πft) with its own
    f below 0.5 Hz and s = min(t/2 s, 1), A = 1 cm or 0.1 rad. The fastest motion is 4.1 cm/s.
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


# Reads a motion from a CSV file, and says in which line a bad one is wrong.


def read_motion(path: str | os.PathLike[str]) -> Motion:
    """Reads a motion from a CSV file.

    The first line that is neither empty nor a comment (``#``) names the columns, in any order:
    ``t,x,y,z`` in s and m, and either all or none of ``qw,qx,qy,qz``. Every further line is a row
    of numbers; times strictly increase; the rate is free.

    Args:
        path: The file, UTF-8.

    Returns:
        The motion, its times counted from the first row.

    Raises:
        DeviceError: The file cannot be read, or a line is not as above; the message names it.
    """
    path = Path(path)
    lines = _read_lines(path)
    numbered = (
        (number, line)
        for number, line in enumerate(lines, start=1)
        if (content := line.lstrip()) and content[0] != "#"
    )
    header = next(numbered, None)
    if header is None:
        raise DeviceError(f"{path}: the file is empty; a header t,x,y,z and two rows are needed")
    names = _column_names(f"{path}, line {header[0]}", header[1])
    width = len(names)
    numbers: list[int] = []
    values: list[float] = []
    for number, line in numbered:
        fields = line.split(",")
        if len(fields) != width:
            raise DeviceError(
                f"{path}, line {number}: {len(fields)} fields where the header names "
                f"{width} columns"
            )
        try:
            values.extend(map(float, fields))
        except ValueError:
            column = next(i for i, field in enumerate(fields) if not _is_number(field))
            raise DeviceError(
                f"{path}, line {number}: column '{names[column]}' holds "
                f"{fields[column].strip()!r:.40}, which is not a number"
            ) from None
        numbers.append(number)
    if len(numbers) < 2:
        last = numbers[-1] if numbers else header[0]
        raise DeviceError(
            f"{path}, line {last}: the file ends after {len(numbers)} of at least "
            "two rows of numbers"
        )
    table = np.empty((len(numbers), 8))
    table[:, 4:] = (1.0, 0.0, 0.0, 0.0)
    data = np.array(values).reshape(len(numbers), width)
    for column, name in enumerate(TIME_AND_POSITION + ORIENTATION):
        if name in names:
            table[:, column] = data[:, names.index(name)]
    if fault := first_fault(table):
        raise DeviceError(f"{path}, line {numbers[fault[0]]}: {fault[1]}")
    return Motion(table[:, 0], table[:, 1:4], table[:, 4:])


def _read_lines(path: Path) -> list[str]:
    """Reads a text file; lines end in any of the usual ways, a byte-order mark is dropped."""
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            kind = "a directory" if stat.S_ISDIR(mode) else "not a regular file"
            raise DeviceError(f"{path}: is {kind}, not a CSV file")
        return path.read_text(encoding="utf-8-sig").split("\n")
    except FileNotFoundError:
        raise DeviceError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        line = path.read_bytes()[: error.start].count(b"\n") + 1
        raise DeviceError(f"{path}, line {line}: not UTF-8 text, so not a CSV file") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise DeviceError(f"{path}: cannot be read ({reason})") from None


def _column_names(where: str, line: str) -> list[str]:
    """Returns the columns that a header names, or says what is wrong with them."""
    # some programs quote the names of columns, none quotes numbers
    names = [field.strip().strip("\"'").strip().lower() for field in line.split(",")]
    needed = "a header with the columns t,x,y,z and optionally qw,qx,qy,qz is needed"
    if all(_is_number(name) for name in names):
        raise DeviceError(f"{where}: numbers where {needed}")
    known = TIME_AND_POSITION + ORIENTATION
    if missing := [name for name in TIME_AND_POSITION if name not in names]:
        raise DeviceError(f"{where}: column {', '.join(missing)} is missing; {needed}")
    if unknown := [name for name in names if name not in known]:
        raise DeviceError(f"{where}: unknown column {unknown[0]!r:.40}; {needed}")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DeviceError(f"{where}: column {twice} is there twice")
    missing = [name for name in ORIENTATION if name not in names]
    if 0 < len(missing) < len(ORIENTATION):
        raise DeviceError(
            f"{where}: column {', '.join(missing)} is missing; an orientation needs all of "
            "qw,qx,qy,qz, or none of them"
        )
    return names


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


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
