"""Result of a comparison."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from hapticbridge.jsonable import jsonable


@dataclass(frozen=True, slots=True)
class Difference:
    """A difference in one number of one tick.

    Attributes:
        time: Time of the tick in s, its number times the period.
        ticks: Number of the tick in each run.
        column: Column of the record.
        unit: Unit of the column.
        values: Value in each run.
    """

    time: float
    ticks: tuple[int, int]
    column: str
    unit: str
    values: tuple[float, float]

    @property
    def size(self) -> float:
        """|a − b|; infinite if one of them is not a number."""
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
        return json.dumps(jsonable(values), allow_nan=False)
