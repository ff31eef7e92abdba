"""Tables of maps, written by hand: what a map reads from them is known beforehand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hapticbridge.lab.maps.base import Point
from hapticbridge.sweep.results import Outcome, Table, table_of

Row = tuple[Point, Mapping[str, float | int | str | bool] | str]
"""A point, and what was computed there; a text is why it failed."""


def written(rows: Sequence[Row]) -> Table:
    """Returns the table that a sweep would have made of these rows."""
    outcomes = [Outcome({}, got) if isinstance(got, str) else Outcome(got) for _, got in rows]
    return table_of([point for point, _ in rows], outcomes)


def without_rows(table: Table) -> Table:
    """Returns a table with the same columns and no row."""
    return table.select(table.failed & ~table.failed)
