"""How two recorded runs differ, in one object."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from hapticbridge.jsonable import jsonable


@dataclass(frozen=True, slots=True)
class Difference:
    """Two numbers that should be one.

    Attributes:
        time: Of the tick in s, its number times the period.
        ticks: Number of the tick in either run.
        column: Which number of the record.
        unit: Its unit.
        values: In either run.
    """

    time: float
    ticks: tuple[int, int]
    column: str
    unit: str
    values: tuple[float, float]

    @property
    def size(self) -> float:
        """|a − b|; infinite where only one of them is a number."""
        a, b = self.values
        size = abs(a - b)
        return size if np.isfinite(size) else np.inf


@dataclass(frozen=True, slots=True)
class Comparison:
    """How two recorded runs differ.

    Attributes:
        paths: The recordings.
        ticks: How many records each has.
        periods: Of either in s.
        compared: How many pairs of ticks of one time there are.
        alone: How many ticks of either have none of the other run at their time, where it should
            have one: what was lost, or recorded after the end of the shorter run.
        first: Where they part, or None.
        largest: Per column that differs anywhere, where it differs most.
        decisive: Metadata that decide what a run computes and differ: name, and either value.
        beside: Metadata that may explain a difference.
        events: Names of events whose counts differ, or of inputs and commands that say other
            things, and either count.
        notes: What is wrong with a file as a whole, a sentence each.
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
        """Whether both are the same run: alike in every tick, in length, and in what decided it."""
        return self.first is None and not any((*self.alone, self.decisive, self.events))

    def to_json(self) -> str:
        """Returns it as one JSON object; a number that is not finite becomes null."""
        values = asdict(self) | {"paths": [str(path) for path in self.paths]}
        values["is_same"] = self.is_same
        for told, found in zip(values["largest"], self.largest, strict=True):
            told["size"] = found.size
        if self.first is not None:
            values["first"]["size"] = self.first.size
        return json.dumps(jsonable(values), allow_nan=False)
