"""Record of one tick, sample of a device, and due times of ticks.

All fields are 8 bytes wide and little-endian. A record is therefore a NumPy structured scalar, a
row of the shared-memory ring, and the payload of a message in the recording.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import IntFlag
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray


class TickFlag(IntFlag):
    """Bits of the record's ``flags``; 8 is unused.

    Attributes:
        OVERRUN: The tick started a period or more after its deadline; deadlines were skipped.
        DROPPED_BEFORE: Records before this one were lost because the ring was full.
        FORCE_LIMITED: Force or torque was scaled down to its limit.
        RAMPING: The device gets less than the whole wrench, and the handle follows it in part.
        CONTROLLER_ACTIVE: The passivity controller injected damping.
        CONTACT: At least one contact acted.
        CLUTCH: The device moves without the handle.
        STALE_SAMPLE: The device had no new sample since the previous tick.
        TRIP: The guard stopped the run in this tick and sent zero wrench. A tick that is not finite
            is not recorded; the event ``trip`` names it.
        REANCHORED: The handle slipped, or followed the device in part: its pose belongs to the
            device's present pose from this tick on.
        MIDPOINT: The coupling was lossless in this tick: its torque follows the midpoint rule.
        SWINGING: The device's force comes late, or its samples in coarse steps, and it swings; the
            force was lowered before this tick and stays lower.
        RUNS_AWAY: The device did not move as its force pushed, as with a reversed axis; the force
            was taken away before this tick.
        PROBED: The force is lowered for a moment to see whether the device follows it, or returns.
    """

    OVERRUN = 1
    DROPPED_BEFORE = 2
    FORCE_LIMITED = 4
    RAMPING = 16
    CONTROLLER_ACTIVE = 32
    CONTACT = 64
    CLUTCH = 128
    STALE_SAMPLE = 256
    TRIP = 512
    MIDPOINT = 1024
    REANCHORED = 2048
    SWINGING = 4096
    RUNS_AWAY = 8192
    PROBED = 16384


TICK_DTYPE = np.dtype(
    [
        ("tick", "<i8"),
        ("deadline_ns", "<i8"),
        ("wake_ns", "<i8"),
        ("read_ns", "<i8"),
        ("write_ns", "<i8"),
        ("flags", "<i8"),
        ("buttons", "<i8"),
        ("contacts", "<i8"),
        ("solver_iterations", "<i8"),
        ("device_position", "<f8", 3),
        ("device_quaternion", "<f8", 4),
        ("handle_position", "<f8", 3),
        ("handle_quaternion", "<f8", 4),
        ("tool_position", "<f8", 3),
        ("tool_quaternion", "<f8", 4),
        ("wrench_on_tool", "<f8", 6),
        ("wrench_on_device", "<f8", 6),
        ("kinetic", "<f8"),
        ("potential", "<f8"),
        ("coupling_work", "<f8"),
        ("actuator_work", "<f8"),
        ("external_work", "<f8"),
        ("environment_energy", "<f8"),
        ("device_energy", "<f8"),
        ("injected_damping", "<f8"),
        ("injected_rotational_damping", "<f8"),
        ("lever", "<f8"),
        ("contact_tank", "<f8"),
        ("scene_step", "<i8"),
        ("scene_tank", "<f8"),
        ("pulse", "<f8", 3),
        ("pulse_account", "<f8"),
        ("blow_speed", "<f8"),
        ("blow_restitution", "<f8"),
        ("blow_rebound", "<f8"),
        ("blow_energy", "<f8"),
    ]
)
"""One record. Row k holds the sample read in tick k, the wrench computed from it, and the energies
after the step. Positions are in m, quaternions (w, x, y, z) with w >= 0, energies and cumulative
works in J. Wrenches (force in N, torque in N m) are in the world frame about the grip
(``wrench_on_tool``) or in the device's frame (``wrench_on_device``). ``injected_damping`` in N s/m
and ``injected_rotational_damping`` in N m s/rad are the passivity controller's largest on any axis
of that kind. ``lever`` is the ratio of the lever between device and handle, 0 to 1: the part of
the wrench that was sent, and of the device's motion to the next sample that the handle makes.
``contact_tank`` is the energy in J that may pay for the depenetration of rigid contacts
(``kernel.rigid_contact``). ``scene_step`` counts the steps shown so far of a scene that is slower
than the loop, and ``scene_tank`` is the energy in J that the hand has given and that scene has not
yet got; both are 0 for a scene that steps in every tick (``kernel.shown_tool``). ``pulse`` is the
part of the force on the device that answers a blow, in the device's frame, and ``pulse_account``
the energy in J that may still pay for it (``kernel.impact_pulse``). ``blow_energy`` is the energy
in J that the tool's blows of the tick took from the bodies; of the largest one, ``blow_speed`` is
the normal speed in m/s, ``blow_restitution`` the coefficient of restitution that its contact asks
for, and ``blow_rebound`` the one that it had; all are 0 without a blow. Of several hands, the tool
of the first one counts; of a slower scene none. A contact that does not bounce is noted with
pulses alone."""

PLANES = 16
"""Largest number of surfaces near a tool that stop it between two of its poses."""

POST_DTYPE = np.dtype(
    [
        ("has_velocity", "<i8"),
        ("planes", "<i8"),
        ("work", "<f8"),
        ("pose", "<f8", 7),
        ("velocity", "<f8", 6),
        ("normals", "<f8", 3 * PLANES),
        ("arms", "<f8", 3 * PLANES),
        ("gaps", "<f8", PLANES),
    ]
)
"""Tool as another program shows it: the pose of the grip in m and as a quaternion
(w, x, y, z), its velocity in m/s and rad/s where ``has_velocity`` is 1, and surfaces near it: for
each a normal away from the surface, the arm from the grip to the point of the tool next to it in m
and the gap there in m. ``work`` in J is all that the coupling has done on the program's tool so
far, 0 where the program applies no wrench."""

FORMAT = "13"
"""Format of a recording: its fields, the request with its options, and the numbers that follow from
it. A recording of another format is refused, so other fields in any of them need the next number.

To add a field:

1. here: the field in ``TICK_DTYPE``, 8 bytes wide, with a sentence below it; the next
   ``FORMAT``; its unit in ``UNITS``, or for a vector its parts and unit in ``_PARTS``. Without a
   unit the import fails;
2. in ``kernel.tick``: a line of ``_record`` that writes it, after the module that computes it has
   put it into the tick's state (``kernel.state`` has the table of writers). What the sample alone
   gives is written by ``_record_sample``;
3. in the audit: a second computation from other fields, in ``audit.energy`` or
   ``audit.wrench_limits``. The re-simulation compares every field by itself, to the bit. If all
   hands must have equal values, its name in ``_SHARED`` of ``audit.verdict``;
4. in ``guide/recording_format.md``: its line in the table.

Ring, recording, export and comparison take the field from ``TICK_DTYPE``.
"""


def force_on_hand(ticks: NDArray[np.void], axes: ArrayLike) -> NDArray[np.float64]:
    """Returns the force of the device on the hand in the scene's frame, (n, 3) in N.

    It is ``wrench_on_device``, what the motors were sent, and opposite to the force on the tool
    times ``force_scale`` and the recorded lever. With a loop of the device's own it is what that
    reported at the sample.

    Args:
        ticks: Records, ``TICK_DTYPE``, (n,).
        axes: Row-major rotation from the device's frame to the scene's, 9 numbers.
    """
    rotation = np.asarray(axes, dtype=np.float64).reshape(3, 3)
    return np.asarray(ticks["wrench_on_device"][:, :3] @ rotation.T)


def has_flag(ticks: NDArray[np.void], flag: TickFlag) -> NDArray[np.bool_]:
    """Returns True for each record with at least one of some flags."""
    return np.asarray((ticks["flags"] & int(flag)) != 0)


_POSITION, _QUATERNION = (("x", "y", "z"), "m"), (("w", "x", "y", "z"), "1")
_WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz"), "N"
_PARTS: dict[str, tuple[tuple[str, ...], str]] = {
    "device_position": _POSITION,
    "device_quaternion": _QUATERNION,
    "handle_position": _POSITION,
    "handle_quaternion": _QUATERNION,
    "tool_position": _POSITION,
    "tool_quaternion": _QUATERNION,
    "wrench_on_tool": _WRENCH,
    "wrench_on_device": _WRENCH,
    "pulse": (("fx", "fy", "fz"), "N"),
}
UNITS = {
    **dict.fromkeys(("tick", "flags", "buttons", "contacts", "solver_iterations"), "1"),
    **dict.fromkeys(("lever", "scene_step", "blow_restitution", "blow_rebound"), "1"),
    **dict.fromkeys(("pulse_account", "blow_energy"), "J"),
    "blow_speed": "m/s",
    "deadline_ns": "ns",
    "wake_ns": "ns",
    "read_ns": "ns",
    "write_ns": "ns",
    "kinetic": "J",
    "potential": "J",
    "coupling_work": "J",
    "actuator_work": "J",
    "external_work": "J",
    "environment_energy": "J",
    "device_energy": "J",
    "contact_tank": "J",
    "scene_tank": "J",
    "injected_damping": "N s/m",
    "injected_rotational_damping": "N m s/rad",
}


class Column(NamedTuple):
    """One number of a record, as in tables and messages.

    Attributes:
        name: Name of the field, with a suffix such as ``_x`` for a vector.
        field: Field of ``TICK_DTYPE``.
        part: Index in the field; None for a scalar.
        unit: SI unit; ``ns`` if the name says so; ``1`` for counts, bits and quaternions.
    """

    name: str
    field: str
    part: int | None
    unit: str


def _columns() -> Iterator[Column]:
    for field in TICK_DTYPE.names or ():
        if field not in _PARTS:
            yield Column(field, field, None, UNITS[field])
            continue
        parts, unit = _PARTS[field]
        for index, part in enumerate(parts):
            is_torque = part.startswith("t")
            yield Column(f"{field}_{part}", field, index, "N m" if is_torque else unit)


COLUMNS = tuple(_columns())
"""All numbers of a record, in order."""


def columns_of(record: np.dtype[np.void]) -> tuple[Column, ...]:
    """Returns the columns of some fields of a record."""
    return tuple(column for column in COLUMNS if column.field in (record.names or ()))


CLOCK_FIELDS = ("deadline_ns", "wake_ns", "read_ns", "write_ns")
"""Fields that depend on the clock; they may differ between two runs with equal input."""

SAMPLE_DTYPE = np.dtype([("position", "<f8", 3), ("quaternion", "<f8", 4), ("buttons", "<i8")])
"""Device sample: position in m and orientation in the device's frame, button bits."""


# Due times of ticks


def due_times(ticks: NDArray[np.void], period: float) -> NDArray[np.float64]:
    """Returns the due times of ticks in s of the run's clock, with missed deadlines.

    This is the clock of the events' ``time_ns``; without a missed deadline it is (tick + 1) T. If
    the deadlines of a damaged file run backwards, all are computed as if none had been missed, so
    that plots over time remain possible. ``period`` is T in s.

    Returns:
        Shape (n,), increasing if the ticks' numbers are.
    """
    due = ticks["deadline_ns"]
    if due.size and (due[0] <= 0 or (np.diff(due) <= 0).any()):
        return np.asarray((ticks["tick"] + 1) * period)
    return np.asarray(1e-9 * due)


class Timeline:
    """Due times of any number of ticks; only missed deadlines are stored.

    Attributes:
        duration: Due time of the last tick in s; 0 without ticks.
    """

    def __init__(self, blocks: Iterable[NDArray[np.void]], period: float) -> None:
        rows, times = list[int](), list[float]()
        before: list[NDArray[np.void]] = []
        count = 0
        for block in blocks:
            if not len(block):
                continue
            part = np.concatenate([*before, block])
            due, first = due_times(part, period), count - len(before)
            # keep both sides of every step that is not one period, and the ends
            gaps = np.flatnonzero(np.abs(np.diff(due) - period) > 0.5 * period)
            kept = sorted({0, *gaps.tolist(), *(gaps + 1).tolist(), len(part) - 1})
            rows += [first + row for row in kept]
            times += due[kept].tolist()
            count += len(block)
            before = [part[-1:]]
        self._rows, self._times = np.array(rows, np.float64), np.array(times)
        self.duration = times[-1] if times else 0.0

    def row_at(self, time: float) -> int:
        """Returns the row of the tick due nearest to a time in s, from 0 to ``duration``."""
        return round(float(np.interp(time, self._times, self._rows)))


# Tables of ticks

SECONDS = "seconds"
"""Name of the first column of a table: due time of the tick in s of the run's clock."""

FLAG_LEGEND = {str(flag.value): flag.name for flag in TickFlag}
"""Names of the bits of the column ``flags``, by value."""

BIT_FIELDS: dict[str, dict[str, str | None]] = {"flags": FLAG_LEGEND, "buttons": {}}
"""Fields whose numbers are bits, with the bits' names by value as far as they have one."""


class TableColumns:
    """Columns of a table of ticks: ``SECONDS``, then one per number of a record.

    Args:
        record: Fields of a record.
        period: T in s.

    Attributes:
        units: Unit of each column, by name, in order.
        kinds: Kind of each column, ``i`` or ``f``, in order.
    """

    def __init__(self, record: np.dtype[np.void], period: float) -> None:
        self._columns, self._period = columns_of(record), period
        self.units = {SECONDS: "s"} | {column.name: column.unit for column in self._columns}
        self.kinds = ["f", *(record[column.field].base.kind for column in self._columns)]

    def values(self, ticks: NDArray[np.void]) -> list[NDArray[Any]]:
        """Returns the columns of some records, each contiguous, (n,), int64 or float64."""
        columns: list[NDArray[Any]] = [due_times(ticks, self._period)]
        for column in self._columns:
            field = ticks[column.field]
            columns.append(
                np.ascontiguousarray(field if column.part is None else field[:, column.part])
            )
        return columns
