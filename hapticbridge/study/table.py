"""The outcome of a sweep: a table with a row a point."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import StudyError, choices
from hapticbridge.files import import_extra
from hapticbridge.study.points import Point, Value

FORMATS = ("csv", "parquet")


class Outcome(NamedTuple):
    """What became of one point.

    Attributes:
        results: What the function returned; empty where it failed.
        error: Type and message of what it raised; empty where it did not.
    """

    results: Mapping[str, Value]
    error: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns of equal length, a row a point, in the order of the points.

    A column holds int64, float64, bool, or Python's text (dtype object). Where a point failed,
    its numbers and flags are NaN and its text is empty, so an integer or flag column with a
    failed point is float64. ``table.select(~table.failed)`` leaves such rows out.

    Attributes:
        columns: Name to column: the parameters, the results, and ``error``.
        parameters: Names of the points' values.
        results: Names of what the function returned, in the order in which they first appear.
    """

    columns: Mapping[str, NDArray[Any]]
    parameters: tuple[str, ...]
    results: tuple[str, ...]

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
        if name not in self.columns:
            return np.full(len(self), np.nan)
        return np.asarray(self.columns[name], dtype=np.float64)

    def texts(self, name: str) -> NDArray[np.object_]:
        """Returns a column of text; empty texts where no point returned such a result."""
        if name not in self.columns:
            return np.full(len(self), "", dtype=object)
        return np.asarray(self.columns[name], dtype=object)

    def __len__(self) -> int:
        return len(self.columns["error"])

    @property
    def failed(self) -> NDArray[np.bool_]:
        """Where the function raised; shape (rows,)."""
        return np.array([bool(text) for text in self.columns["error"]], dtype=bool)

    def select(self, rows: NDArray[Any]) -> Table:
        """Returns a table of some rows, chosen by a mask or by their numbers; types stay."""
        chosen = {name: column[rows] for name, column in self.columns.items()}
        return Table(chosen, self.parameters, self.results)

    def equals(self, other: Table) -> bool:
        """Tells whether another table has the same columns, types and bits."""
        return list(self.columns) == list(other.columns) and all(
            _same(column, other.columns[name]) for name, column in self.columns.items()
        )

    def write(self, path: str | os.PathLike[str], units: Mapping[str, str] | None = None) -> None:
        """Writes the table to one file, CSV or Parquet by the name's end.

        Numbers in CSV have as many digits as bring back the same double.

        Args:
            path: The file.
            units: By name of a column; Parquet keeps them as its metadata ``unit``.

        Raises:
            StudyError: The name ends otherwise, pyarrow is missing, or the file cannot be written.
        """
        path = Path(path)
        columns = {name: column.tolist() for name, column in self.columns.items()}
        check_format(form := path.suffix.removeprefix("."))
        try:
            path.write_bytes(csv_bytes(columns) if form == "csv" else parquet_bytes(columns, units))
        except OSError as error:
            raise StudyError(f"{path}: cannot be written ({error.strerror})") from None


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in the middle of a sweep, with what was done by then.

    Attributes:
        table: A row for each point that was done, at least one, in the order of the points.
    """

    def __init__(self, table: Table) -> None:
        super().__init__()
        self.table = table


def table_of(points: Sequence[Point], outcomes: Sequence[Outcome]) -> Table:
    """Returns the table of points and what became of them, in their order."""
    parameters = tuple(points[0])
    results = tuple(dict.fromkeys(name for done in outcomes for name in done.results))
    columns = {name: _column([point[name] for point in points]) for name in parameters}
    columns |= {name: _column([done.results.get(name) for done in outcomes]) for name in results}
    columns["error"] = np.array([done.error for done in outcomes], dtype=object)
    return Table(columns, parameters, results)


def check_format(name: str) -> None:
    """Refuses a format that does not exist or cannot be written here.

    Raises:
        StudyError: So it is.
    """
    if name not in FORMATS:
        raise StudyError(f"format {name!r:.60} is unknown; the formats are {choices(FORMATS)}")
    if name == "parquet":
        pyarrow()


def pyarrow(module: str = "pyarrow") -> Any:
    """Returns pyarrow or one of its modules.

    Raises:
        StudyError: It is not installed.
    """
    return import_extra(module, "Parquet", "tables", StudyError)


def csv_bytes(columns: Mapping[str, Sequence[Value | None]]) -> bytes:
    """Returns columns as CSV: text quoted, floats with all digits, missing values empty."""
    buffer = io.StringIO(newline="")
    # text is always quoted: otherwise a lone carriage return in it would end the row
    writer = csv.writer(buffer, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return buffer.getvalue().encode()


def parquet_bytes(
    columns: Mapping[str, Sequence[Value | None]], units: Mapping[str, str] | None = None
) -> bytes:
    """Returns columns as Parquet; a column of several types becomes text.

    Args:
        columns: Values by name.
        units: By name of a column, for its metadata.

    Raises:
        StudyError: pyarrow is not installed.
    """
    arrow, parquet = pyarrow(), pyarrow("pyarrow.parquet")
    arrays = {}
    for name, values in columns.items():
        if len({type(value) for value in values} - {type(None)}) > 1:
            arrays[name] = arrow.array([None if v is None else str(v) for v in values])
        else:
            arrays[name] = arrow.array(values, from_pandas=False)
    fields = [
        arrow.field(name, array.type, metadata={"unit": unit} if unit else None)
        for name, array in arrays.items()
        for unit in [(units or {}).get(name)]
    ]
    buffer = io.BytesIO()
    parquet.write_table(arrow.table(list(arrays.values()), schema=arrow.schema(fields)), buffer)
    return buffer.getvalue()


def _column(values: Sequence[Value | None]) -> NDArray[Any]:
    """Returns a column of one type: text if any value is, else the widest of the numbers."""
    types = {type(value) for value in values}
    if str in types:
        texts = ["" if value is None else str(value) for value in values]
        return np.array(texts, dtype=object)
    if float in types or type(None) in types:
        return np.array([math.nan if v is None else float(v) for v in values], dtype=np.float64)
    return np.array(values, dtype=np.int64 if int in types else np.bool_)


def _same(first: NDArray[Any], second: NDArray[Any]) -> bool:
    """Tells whether two columns have the same type and bits."""
    if first.dtype != second.dtype or first.shape != second.shape:
        return False
    if first.dtype == object:
        return bool(np.array_equal(first, second))
    return first.tobytes() == second.tobytes()
