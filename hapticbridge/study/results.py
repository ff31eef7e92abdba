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
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hapticbridge.errors import StudyError
from hapticbridge.study.points import Point, Value, kind_of, of_kind
from hapticbridge.study.table import Outcome, csv_bytes, parquet_bytes, pyarrow

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
