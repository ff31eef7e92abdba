"""Results of a sweep: the table of all points, and the file that keeps them between runs.

The file is JSON Lines. Its first line names the function, the versions of hapticbridge and MuJoCo
and a digest of the package's sources. Each other line holds one ``point`` with its ``results`` and
``error``. A line that was cut by a crash is skipped, and its point is computed again.
"""

from __future__ import annotations

import csv
import hashlib
import json
import math
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import StudyError, choices
from hapticbridge.files import import_extra
from hapticbridge.sweep.points import Point, Value, point_key

FORMATS = ("csv", "parquet")


class Outcome(NamedTuple):
    """Results of one point.

    Attributes:
        results: Values that the function returned; empty if it failed.
        error: Type and message of the failure; empty if there was none.
    """

    results: Mapping[str, Value]
    error: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns of equal length, one row per point, in the order of the points.

    A column holds int64, float64, bool, or Python's text (dtype object). Where a point failed,
    its numbers and flags are NaN and its text is empty, so an integer or flag column with a
    failed point is float64. ``table.select(~table.failed)`` leaves such rows out.

    Attributes:
        columns: The parameters, the results in order of first appearance, and ``error``.
    """

    columns: Mapping[str, NDArray[Any]]

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Returns a column.

        Raises:
            StudyError: There is no such column.
        """
        try:
            return self.columns[name]
        except KeyError:
            raise StudyError(
                f"the table has no column {name!r:.60}; it has {choices(self.columns)}"
            ) from None

    def numbers(self, name: str) -> NDArray[np.float64]:
        """Returns a column of numbers; NaN throughout where no point returned such a result."""
        return np.asarray(self.columns.get(name, np.full(len(self), np.nan)), dtype=np.float64)

    def texts(self, name: str) -> NDArray[np.object_]:
        """Returns a column of text; empty texts where no point returned such a result."""
        return np.asarray(self.columns.get(name, np.full(len(self), "")), dtype=object)

    def __len__(self) -> int:
        return len(self.columns["error"])

    @property
    def failed(self) -> NDArray[np.bool_]:
        """Mask of the points whose function failed; shape (rows,)."""
        return np.asarray(self.columns["error"] != "", dtype=bool)

    def select(self, rows: NDArray[Any]) -> Table:
        """Returns a table of the rows selected by a mask or by their numbers; types stay."""
        return Table({name: column[rows] for name, column in self.columns.items()})

    def write(self, path: str | os.PathLike[str], units: Mapping[str, str] | None = None) -> None:
        """Writes the table to one file, CSV or Parquet by the name's end.

        Numbers in CSV have as many digits as bring back the same double.

        Args:
            path: The file.
            units: Unit of a column by its name; Parquet keeps it as metadata ``unit``.

        Raises:
            StudyError: The ending is unknown, pyarrow is missing, or the file cannot be written.
        """
        path = Path(path)
        check_format(form := path.suffix.removeprefix("."))
        columns = {name: column.tolist() for name, column in self.columns.items()}
        try:
            if form == "csv":
                with path.open("w", newline="", encoding="utf-8") as file:
                    # quoted text: a lone carriage return in it would end the row otherwise
                    writer = csv.writer(file, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\n")
                    writer.writerow(columns)
                    writer.writerows(zip(*columns.values(), strict=True))
            else:
                _write_parquet(columns, path, units or {})
        except OSError as error:
            raise StudyError(f"{path}: cannot be written ({error.strerror})") from None


class Interrupted(KeyboardInterrupt):
    """Interruption of a sweep by Ctrl-C.

    Attributes:
        table: One row for each point that was computed, at least one, in the order of the
            points.
    """

    def __init__(self, table: Table) -> None:
        super().__init__()
        self.table = table


def table_of(points: Sequence[Point], outcomes: Sequence[Outcome]) -> Table:
    """Returns the table of points and their outcomes, in order."""
    results = dict.fromkeys(name for done in outcomes for name in done.results)
    columns = {name: _column([point[name] for point in points]) for name in points[0]}
    columns |= {name: _column([done.results.get(name) for done in outcomes]) for name in results}
    columns["error"] = np.array([done.error for done in outcomes], dtype=object)
    return Table(columns)


def check_format(name: str) -> None:
    """Refuses a format that does not exist or cannot be written here.

    Raises:
        StudyError: The format is unknown, or pyarrow is not installed.
    """
    if name not in FORMATS:
        raise StudyError(f"format {name!r:.60} is unknown; the formats are {choices(FORMATS)}")
    if name == "parquet":
        import_extra("pyarrow", "Parquet", "tables", StudyError)


def _write_parquet(
    columns: Mapping[str, list[Value]], path: Path, units: Mapping[str, str]
) -> None:
    arrow = import_extra("pyarrow", "Parquet", "tables", StudyError)
    parquet = import_extra("pyarrow.parquet", "Parquet", "tables", StudyError)
    arrays = [arrow.array(values, from_pandas=False) for values in columns.values()]
    fields = [
        arrow.field(name, array.type, metadata={"unit": units[name]} if name in units else None)
        for name, array in zip(columns, arrays, strict=True)
    ]
    parquet.write_table(arrow.table(arrays, schema=arrow.schema(fields)), path)


def _column(values: Sequence[Value | None]) -> NDArray[Any]:
    """Returns a column of one type: text if any value is, else the widest of the numbers."""
    types = {type(value) for value in values}
    if str in types:
        return np.array(["" if value is None else str(value) for value in values], dtype=object)
    if float in types or type(None) in types:
        return np.array([math.nan if v is None else float(v) for v in values], dtype=np.float64)
    return np.array(values, dtype=np.int64 if int in types else np.bool_)


class ResultFile:
    """The results of one sweep on disk.

    Raises:
        StudyError: The file cannot be read or written, or holds another sweep.
    """

    def __init__(self, path: str | os.PathLike[str], function: str) -> None:
        self.path = Path(path)
        identity = {
            "function": function,
            "hapticbridge": version("hapticbridge"),
            "mujoco": version("mujoco"),
            "sources": _sources(),
        }
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a+b") as file:
                file.seek(0)
                first, *self._lines = file.read().split(b"\n")
                if not first:
                    file.write(json.dumps(identity).encode() + b"\n")
                elif self._lines and self._lines[-1]:
                    file.write(b"\n")  # ends a line that a crash has cut
        except OSError as error:
            raise StudyError(f"{self.path}: cannot be written ({error.strerror})") from None
        found = _parsed(first) if first else identity
        if found != identity:
            raise StudyError(
                f"{self.path}: holds a sweep of {found.get('function')!s:.200} by hapticbridge "
                f"{found.get('hapticbridge')!s:.40}, not of {function:.200} by "
                f"{identity['hapticbridge']}, or by other sources or another MuJoCo than now; "
                "give another folder, or delete this file to start anew"
            )

    def read(self, wanted: Collection[str]) -> dict[str, Outcome]:
        """Returns the outcomes of some points, by the points' keys."""
        found = {}
        for line in filter(None, map(_parsed, self._lines)):
            if (key := point_key(line["point"])) in wanted:
                found[key] = Outcome(line["results"], line["error"])
        return found

    def add(self, points: Sequence[Point], outcomes: Sequence[Outcome]) -> None:
        """Appends points and their outcomes.

        Raises:
            StudyError: The file cannot be written.
        """
        lines = [
            json.dumps({"point": point, "results": dict(done.results), "error": done.error}) + "\n"
            for point, done in zip(points, outcomes, strict=True)
        ]
        try:
            with self.path.open("a", encoding="ascii") as file:
                file.writelines(lines)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise StudyError(f"{self.path}: cannot be written ({error.strerror})") from None


def _parsed(line: bytes) -> dict[str, Any]:
    """Returns the JSON object on a line, or an empty one if the line holds none."""
    try:
        found = json.loads(line)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


@cache
def _sources() -> str:
    """Returns a digest of the package's sources and shipped scenes: they decide the results."""
    digest = hashlib.blake2b(digest_size=16)
    package = Path(__file__).parents[1]
    for path in sorted(package.rglob("*")):
        if path.suffix in {".py", ".xml"}:
            digest.update(str(path.relative_to(package)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
