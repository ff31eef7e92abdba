"""The folder in which a sweep keeps its results, so that it can go on after a kill.

A folder holds the manifest ``sweep.json`` and parts ``part-DIGEST.csv`` or ``part-DIGEST.parquet``.
A part holds rows: ``point`` (the point's key), the parameters, the results, ``kinds`` (a letter for
each result's type, ``-`` where it is missing) and ``error``.

DIGEST is a digest of the file's bytes, keyed with the function, the package's
version and sources, and MuJoCo's version. A part is believed only if it matches.
So a file that was cut, changed, or computed by another function is
passed over, whatever its name, and nothing depends on the order in which a disk writes.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import math
import os
import re
import tempfile
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import StudyError, choices
from hapticbridge.files import import_extra
from hapticbridge.sweep.points import Point, Value, kind_of, of_kind


def prepared_folder(folder: Path, names: Collection[str] = ()) -> Path:
    """Makes a folder, if there is none, and proves that it and its files can be written.

    Args:
        folder: To write into.
        names: Of files in it that will be written, of which those that exist stay as they are; none
            named, any file must be possible.

    Raises:
        StudyError: The path is a file, or the folder or a file in it cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not names:
            tempfile.TemporaryFile(dir=folder).close()
        for path in (folder / name for name in names):
            is_new = not path.exists()
            with path.open("ab"):
                pass
            if is_new:
                path.unlink()
    except FileExistsError:
        raise StudyError(f"'{folder}' is a file; name a folder to write into") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise StudyError(f"cannot write into '{folder}': {reason}") from None
    return folder


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


MANIFEST = "sweep.json"
_LAYOUT = 1
"""Version of the folder's layout: results of another are refused."""
_DRAFT = ".draft-"
_PART = re.compile(r"part-([0-9a-f]{32})\.(csv|parquet)")


class ResultFolder:
    """The parts of one sweep on disk.

    Raises:
        StudyError: The folder cannot be made or written, or holds another sweep.
    """

    def __init__(self, path: str | os.PathLike[str], function: str, form: str) -> None:
        self.path = Path(path)
        self._form = form
        self._identity = {
            "layout": _LAYOUT,
            "function": function,
            "hapticbridge": version("hapticbridge"),
            "mujoco": version("mujoco"),
            "sources": _sources(),
        }
        self._secret = hashlib.sha256(json.dumps(self._identity).encode()).digest()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise StudyError(f"{self.path}: is not a folder; results need one") from None
        except OSError as error:
            raise StudyError(f"{self.path}: cannot be made ({error.strerror})") from None
        self._refuse_others()
        self._remove_drafts()

    def describe(self, parameters: Sequence[str], results: Sequence[str], count: int) -> None:
        """Writes the manifest.

        Args:
            parameters: Names of the points' values.
            results: Names of the results, empty while they are not known.
            count: Points of the sweep.

        Raises:
            StudyError: It cannot be written.
        """
        columns = {"parameters": list(parameters), "results": list(results), "count": count}
        text = json.dumps(self._identity | columns, indent=2)
        self._write(MANIFEST, (text + "\n").encode())

    def read(self, wanted: Iterable[str]) -> dict[str, Outcome]:
        """Returns what is known of some points, by their keys.

        Raises:
            StudyError: The folder cannot be read, or a part needs pyarrow, which is missing.
        """
        wanted = set(wanted)
        found: dict[str, Outcome] = {}
        try:
            # sorted, so that two parts with the same point give the same answer on every disk
            for path in sorted(self.path.iterdir()):
                match = _PART.fullmatch(path.name)
                if not match or not path.is_file():
                    continue
                data = path.read_bytes()
                if self._digest(data) != match[1]:
                    continue
                for key, outcome in _rows(data, match[2]):
                    if key in wanted:
                        found.setdefault(key, outcome)
        except OSError as error:
            raise StudyError(f"{self.path}: cannot be read ({error.strerror})") from None
        return found

    def add(self, points: Mapping[str, Point], outcomes: Sequence[Outcome]) -> None:
        """Writes one part, whole or not at all.

        Args:
            points: The points by their keys.
            outcomes: What became of each.

        Raises:
            StudyError: It cannot be written.
        """
        names = dict.fromkeys(name for outcome in outcomes for name in outcome.results)
        columns: dict[str, list[Any]] = {"point": list(points)}
        for name in next(iter(points.values())):
            columns[name] = [point[name] for point in points.values()]
        for name in names:
            columns[name] = [outcome.results.get(name) for outcome in outcomes]
        columns["kinds"] = [
            "".join(kind_of(o.results[name]) if name in o.results else "-" for name in names)
            for o in outcomes
        ]
        columns["error"] = [outcome.error for outcome in outcomes]
        data = csv_bytes(columns) if self._form == "csv" else parquet_bytes(columns)
        self._write(f"part-{self._digest(data)}.{self._form}", data)

    def _digest(self, data: bytes) -> str:
        return hashlib.blake2b(data, digest_size=16, key=self._secret).hexdigest()

    def _refuse_others(self) -> None:
        """Raises if the folder's manifest is of another function or version."""
        path = self.path / MANIFEST
        anew = "give another folder, or delete this one to start anew"
        try:
            found = json.loads(path.read_bytes())
            others = {name: found[name] for name in self._identity}
        except FileNotFoundError:
            return
        except OSError as error:
            raise StudyError(f"{path}: cannot be read ({error.strerror})") from None
        except (ValueError, TypeError, KeyError, RecursionError):
            raise StudyError(f"{path}: is not the manifest of a sweep; {anew}") from None
        if others != self._identity:
            raise StudyError(
                f"{self.path}: holds a sweep of {others['function']!s:.200} by hapticbridge "
                f"{others['hapticbridge']!s:.40}, not of {self._identity['function']!s:.200} by "
                f"{self._identity['hapticbridge']}, or by other sources or another MuJoCo than "
                f"now; {anew}"
            )

    def _remove_drafts(self) -> None:
        """Removes what a sweep that was killed was about to write."""
        for path in self.path.glob(f"{_DRAFT}*"):
            with contextlib.suppress(OSError):  # it only takes room
                path.unlink()

    def _write(self, name: str, data: bytes) -> None:
        """Writes a file under its name only when all of it is on the disk."""
        try:
            draft = self.path / f"{_DRAFT}{os.getpid()}-{name}"
            with draft.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            draft.replace(self.path / name)
        except OSError as error:
            raise StudyError(f"{self.path}: cannot be written ({error.strerror})") from None


@cache
def _sources() -> str:
    """Returns a digest of the package's sources and shipped scenes: what decides the results."""
    digest = hashlib.blake2b(digest_size=16)
    package = Path(__file__).parents[1]
    for path in sorted(package.rglob("*")):
        if path.suffix in {".py", ".xml"}:
            digest.update(str(path.relative_to(package)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _rows(data: bytes, form: str) -> list[tuple[str, Outcome]]:
    """Returns the points' keys and outcomes of a part; none where it is not one."""
    try:
        if form == "csv":
            rows = list(csv.reader(io.StringIO(data.decode(), newline=""), strict=True))
        else:
            columns = pyarrow("pyarrow.parquet").read_table(io.BytesIO(data)).to_pydict()
            rows = [list(columns), *map(list, zip(*columns.values(), strict=True))]
        return [_row(dict(zip(rows[0], row, strict=True))) for row in rows[1:]]
    except (ValueError, KeyError, csv.Error):  # pyarrow's errors are ValueErrors
        return []


def _row(cells: dict[str, Any]) -> tuple[str, Outcome]:
    """Returns the key and outcome of one row."""
    kinds = str(cells["kinds"])
    names = list(cells)[-2 - len(kinds) : -2]
    results: dict[str, Value] = {
        name: of_kind(kind, cells[name])
        for name, kind in zip(names, kinds, strict=True)
        if kind != "-"
    }
    return str(cells["point"]), Outcome(results, str(cells["error"]))
