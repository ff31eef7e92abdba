"""Comparison of two recorded runs: first tick, field and size of a difference."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.files import finite_or_null
from hapticbridge.kernel.record import (
    BIT_FIELDS,
    CLOCK_FIELDS,
    TICK_DTYPE,
    Column,
    TickFlag,
    columns_of,
)
from hapticbridge.recording import RecordingFile
from hapticbridge.recording.reader import open_hands
from hapticbridge.run.commands import CHANGES as COMMANDED
from hapticbridge.run.description import meta_float

# Result of a comparison


@dataclass(frozen=True, slots=True)
class Difference:
    """A difference in one number of one tick.

    Attributes:
        time: Time of the tick in s, its number times the period.
        ticks: Number of the tick in each run.
        column: Column of the record.
        unit: Unit of the column.
        values: Value in each run.
        bits: Names of the bits that differ, where the values are bits; else empty.
    """

    time: float
    ticks: tuple[int, int]
    column: str
    unit: str
    values: tuple[float, float]
    bits: tuple[str, ...] = ()

    @property
    def size(self) -> float:
        """|a − b|, infinite if one of them is not a number; of bits the count that differs."""
        if self.bits:
            return float(len(self.bits))
        a, b = self.values
        size = abs(a - b)
        return size if np.isfinite(size) else np.inf


@dataclass(frozen=True, slots=True)
class Comparison:
    """Differences of two recorded runs.

    Attributes:
        paths: The recordings.
        ticks: Number of records of each.
        periods: Period of each in s.
        compared: Number of pairs of ticks with equal due times.
        alone: Number of ticks of each without a partner where one was due: lost ticks, and those
            after the end of the shorter run.
        first: First difference, or None.
        largest: Largest difference of each column that differs.
        decisive: Differing metadata that determine what a run computes: name and both values.
        beside: Differing metadata that may explain a difference.
        events: Names of events with differing numbers, or of inputs and commands with differing
            content, and both numbers.
        notes: Problems of a whole file, one sentence each.
    """

    paths: tuple[Path, Path]
    ticks: tuple[int, int]
    periods: tuple[float, float]
    compared: int
    alone: tuple[int, int]
    first: Difference | None
    largest: tuple[Difference, ...]
    decisive: dict[str, tuple[str | None, str | None]]
    beside: dict[str, tuple[str | None, str | None]]
    events: dict[str, tuple[int, int]]
    notes: tuple[str, ...]

    @property
    def is_same(self) -> bool:
        """True if the runs agree in every tick, in length, and in decisive metadata and events."""
        return self.first is None and not any((*self.alone, self.decisive, self.events))

    def to_json(self) -> str:
        """Returns the comparison as one JSON object; a number that is not finite becomes null."""
        values = asdict(self) | {"paths": [str(path) for path in self.paths]}
        values["is_same"] = self.is_same
        for entry, found in zip(values["largest"], self.largest, strict=True):
            entry["size"] = found.size
        if self.first is not None:
            values["first"]["size"] = self.first.size
        return json.dumps(finite_or_null(values), allow_nan=False)


DECISIVE = (
    "scene_sha256",
    "scene_parameters",
    "grip",
    "method",
    "contact",
    "period_s",
    "substeps",
    "stiffness",
    "damping",
    "rotational_stiffness",
    "rotational_damping",
    "requested",
    "effective",
    "contact_stiffness",
    "scale",
    "force_scale",
    "axes",
    "force_limit",
    "torque_limit",
    "ramp_ticks",
    "guard",
    "device",
    "device_start",
    "device_origin",
    "handle_origin",
    "handle_start",
    "tool_start",
    "start_kinetic",
    "start_potential",
)
"""Metadata that determine what a run computes."""

_EXPLANATORY = ("versions", "host", "clock")
"""Metadata that may explain a difference, but do not cause one by themselves."""

_CHANGES = ("input", *COMMANDED)
"""Events that determine what a run computes; their content is compared, not only their number."""

_IGNORED_FLAGS = int(TickFlag.OVERRUN | TickFlag.DROPPED_BEFORE)
"""Flags set by clock and recorder; like times, they differ between any two real runs."""

SHORTEST, LONGEST = 1e-9, 1e3
"""Range of periods in s; ticks are matched by whole ns in 64 bits."""


def compare(first: str | Path, second: str | Path) -> Comparison:
    """Compares two recordings tick by tick and bit by bit, in constant memory.

    Ticks are matched by their due time, number times period. Runs at different rates are compared
    at coinciding ticks (1 kHz and 500 Hz: every second tick of the first), and gaps shift nothing.
    Clock times and the flags ``OVERRUN`` and ``DROPPED_BEFORE`` are ignored, because they differ
    between any two real runs. Several hands are compared in their order, and a difference names
    the hand.

    Raises:
        RecordingError: One of them cannot be read, has no period, or has ticks out of order.
    """
    hands = open_hands(first), open_hands(second)
    files = hands[0][0], hands[1][0]
    periods = _period(files[0]), _period(files[1])
    found = _Found(periods)
    found.add_all(files)
    decisive = _meta_differences(files, DECISIVE)
    of_scene = dict(decisive)
    if len(hands[0]) != len(hands[1]):
        decisive["hands"] = str(len(hands[0])), str(len(hands[1]))
    for pair in zip(hands[0][1:], hands[1][1:], strict=False):
        name = f" of '{pair[0].meta.get('grip', '')}'"
        own = _Found(periods, name)
        own.add_all(pair)
        found.take(own)
        for key, values in _meta_differences(pair, DECISIVE).items():
            if values != of_scene.get(key):
                decisive[key + name] = values
    return Comparison(
        paths=(files[0].path, files[1].path),
        ticks=(files[0].count, files[1].count),
        periods=periods,
        compared=found.compared,
        alone=(found.shared[0] - found.compared, found.shared[1] - found.compared),
        first=found.first,
        largest=tuple(found.largest.values()),
        decisive=decisive,
        beside=_meta_differences(files, _EXPLANATORY),
        events=_event_differences(files),
        notes=tuple(dict.fromkeys(n for each in hands for file in each for n in _notes(file))),
    )


class _Found:
    """Differences collected over matching ticks; ``of_hand`` ends the name of each column."""

    def __init__(self, periods: tuple[float, float], of_hand: str = "") -> None:
        self._periods, self._of_hand = periods, of_hand
        self._steps = round(periods[0] * 1e9), round(periods[1] * 1e9)
        self.compared = 0
        self.shared = [0, 0]
        self.first: Difference | None = None
        self.largest: dict[str, Difference] = {}

    def take(self, other: _Found) -> None:
        """Takes the differences of a further hand."""
        if other.first and (self.first is None or other.first.time < self.first.time):
            self.first = other.first
        self.largest |= other.largest

    def add_all(self, files: tuple[RecordingFile, RecordingFile]) -> None:
        """Compares all records with equal due times, block by block."""
        streams = self._due(files, 0), self._due(files, 1)
        nothing = [(np.zeros(0, TICK_DTYPE), np.zeros(0, np.int64)) for file in files]
        waiting = [*nothing]
        while True:
            for side in (0, 1):
                if not waiting[side][0].size:
                    waiting[side] = next(streams[side], nothing[side])
            (a, due_a), (b, due_b) = waiting
            if not (a.size and b.size):
                break
            # compare up to the end of the shorter block; the rest waits for the other's next block
            until = min(due_a.max(), due_b.max())
            _, own, other = np.intersect1d(due_a, due_b, return_indices=True)
            if own.size:
                self.add(a[own], b[other])
            waiting = [(rows[due > until], due[due > until]) for rows, due in waiting]
        for stream in streams:  # count the ticks after the end of the shorter run
            for _ in stream:
                pass

    def _due(
        self, files: tuple[RecordingFile, RecordingFile], side: int
    ) -> Iterator[tuple[NDArray[np.void], NDArray[np.int64]]]:
        """Yields the records of one file with their due times in ns."""
        last = -1
        for ticks in files[side].blocks():
            numbers = np.concatenate([[last], ticks["tick"]])
            if (back := np.flatnonzero(np.diff(numbers) <= 0)).size:
                raise RecordingError(
                    f"{files[side].path}: tick {numbers[back[0]]} is followed by tick "
                    f"{numbers[back[0] + 1]}; ticks out of order cannot be compared"
                )
            last = int(numbers[-1])
            due = ticks["tick"] * self._steps[side]
            self.shared[side] += int(np.count_nonzero(due % self._steps[1 - side] == 0))
            yield ticks, due

    def add(self, a: NDArray[np.void], b: NDArray[np.void]) -> None:
        """Compares records of equal due times in the fields that both have."""
        self.compared += len(a)
        earliest: tuple[int, Difference] | None = None
        both = set(b.dtype.names or ()) - set(CLOCK_FIELDS)
        b = _with_nearest_quaternions(a, b)
        for column in columns_of(a.dtype):
            if column.field not in both:
                continue
            x, y = _numbers(a, column), _numbers(b, column)
            unequal = x.view(np.int64) != y.view(np.int64)
            if not unequal.any():
                continue
            with np.errstate(invalid="ignore", over="ignore"):
                size = np.abs(x.astype(np.float64) - y.astype(np.float64))
            if column.field in BIT_FIELDS:
                size = np.bitwise_count(x.view(np.int64) ^ y.view(np.int64)).astype(np.float64)
            size = np.where(unequal, np.where(np.isfinite(size), size, np.inf), -1.0)
            at = int(np.argmax(unequal))
            if earliest is None or at < earliest[0]:
                earliest = at, self._difference(column, a, b, at)
            worst = self._difference(column, a, b, int(np.argmax(size)))
            known = self.largest.get(worst.column)
            if known is None or worst.size > known.size:
                self.largest[worst.column] = worst
        if self.first is None and earliest is not None:
            self.first = earliest[1]

    def _difference(
        self, column: Column, a: NDArray[np.void], b: NDArray[np.void], at: int
    ) -> Difference:
        ticks = int(a["tick"][at]), int(b["tick"][at])
        values = _numbers(a, column)[at].item(), _numbers(b, column)[at].item()
        time = ticks[0] * self._periods[0]
        bits: tuple[str, ...] = ()
        if (names := BIT_FIELDS.get(column.field)) is not None:
            changed = int(values[0]) ^ int(values[1])
            changed_bits = [bit for bit in range(64) if changed >> bit & 1]
            bits = tuple(names.get(str(1 << bit)) or f"bit {bit}" for bit in changed_bits)
        return Difference(time, ticks, column.name + self._of_hand, column.unit, values, bits)


def _with_nearest_quaternions(a: NDArray[np.void], b: NDArray[np.void]) -> NDArray[np.void]:
    """Returns b with the one of q and −q, which are one orientation, that is nearer to a's."""
    for name in sorted(set(a.dtype.names or ()) & set(b.dtype.names or ())):
        if name.endswith("_quaternion"):
            is_other = (a[name] * b[name]).sum(axis=1) < 0.0
            if is_other.any():
                b = b.copy()
                b[name][is_other] *= -1.0
    return b


def _numbers(ticks: NDArray[np.void], column: Column) -> NDArray[np.int64 | np.float64]:
    field = ticks[column.field]
    if column.field == "flags":
        field = field & ~_IGNORED_FLAGS
    return np.ascontiguousarray(field if column.part is None else field[:, column.part])


def _period(file: RecordingFile) -> float:
    period = meta_float(file.meta, "period_s")
    if not SHORTEST <= period <= LONGEST:
        raise RecordingError(
            f"{file.path}: metadata 'period_s' is {period:g}; it must be from {SHORTEST:g} to "
            f"{LONGEST:g} s"
        )
    return period


def _meta_differences(
    files: tuple[RecordingFile, RecordingFile], names: tuple[str, ...]
) -> dict[str, tuple[str | None, str | None]]:
    pairs = {name: (files[0].meta.get(name), files[1].meta.get(name)) for name in names}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def _event_differences(files: tuple[RecordingFile, RecordingFile]) -> dict[str, tuple[int, int]]:
    lists = [[str(event.get("event", "unnamed")) for event in file.events] for file in files]
    names = dict.fromkeys(lists[0] + lists[1])
    counts = {name: (lists[0].count(name), lists[1].count(name)) for name in names}
    other = {
        name for name in _CHANGES if _events_named(files[0], name) != _events_named(files[1], name)
    }
    return {name: pair for name, pair in counts.items() if pair[0] != pair[1] or name in other}


def _events_named(file: RecordingFile, name: str) -> list[dict[str, Any]]:
    """Returns the events of a name without their times and origin."""
    return [
        {key: value for key, value in event.items() if key not in ("time_ns", "by")}
        for event in file.events
        if event.get("event") == name
    ]


def _notes(file: RecordingFile) -> Iterator[str]:
    if file.cut_sentence:
        yield f"{file.path}: {file.cut_sentence}; the rest is compared"
    if file.problems:
        yield f"{file.path} is damaged: {'; '.join(file.problems)}"
