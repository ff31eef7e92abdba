"""Prescribed motion: poses over time, interpolated within a tick."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.errors import DeviceError
from hapticbridge.jit import compiled
from hapticbridge.pose import (
    Quaternion,
    Vector,
    canonical,
    conjugate,
    product,
    quaternion_exp,
    rotation_between,
    scaled,
)

TIME_AND_POSITION = ("t", "x", "y", "z")
ORIENTATION = ("qw", "qx", "qy", "qz")
NORM_TOLERANCE = 1e-3
"""Largest deviation of a quaternion's norm from 1, without unit. It admits four printed digits, but
no mistake."""
LARGEST_NUMBER = 1e12
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
        """Returns the motion relative to its first pose: p − p_0 and q ⊗ q_0⁻¹."""
        return Motion(
            self.table[:, 0],
            self.table[:, 1:4] - self.table[0, 1:4],
            _relative_rotations(self.table[:, 4:]),
        )


def first_fault(table: NDArray[np.float64]) -> tuple[int, str] | None:
    """Returns the first invalid row of a motion and the reason; None if all rows are valid."""
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
