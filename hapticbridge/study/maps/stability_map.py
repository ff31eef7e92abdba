"""What a stability map is: points, what happens at each, and what it all says."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from hapticbridge.errors import StudyError
from hapticbridge.files import finite_or_null
from hapticbridge.plotting import write_picture
from hapticbridge.study.sweep import sweep
from hapticbridge.study.table import Table

Point = dict[str, float | int | str | bool]

LEAST_POINTS, MOST_POINTS = 4, 1_000_000
"""Fewest and most points of a map: with fewer there is no grid, and a million take hours to days
and a gigabyte."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What a map shows.

    Attributes:
        figure: The picture, legible at 800 pixels.
        paragraph: What it says, in a few sentences with its numbers.
        boundary: Where methods fail, measured beside predicted; for JSON.
    """

    figure: Figure
    paragraph: str
    boundary: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class StabilityMap:
    """A map: which points, what is run at each, how it is read.

    Attributes:
        name: What the command line calls it.
        about: One sentence.
        default_points: How many points there are about if nobody chooses.
        points: Returns about that many points, in a fixed order.
        evaluate: What happens at a point; at the top level of a module, so that other processes
            find it.
        read: What the table says.
    """

    name: str
    about: str
    default_points: int
    points: Callable[[int], Sequence[Point]]
    evaluate: Callable[[Point], Mapping[str, float | int | str | bool]]
    read: Callable[[Table], Finding]


@dataclass(frozen=True, slots=True)
class MapFiles:
    """What a map left in its folder.

    Attributes:
        picture: PNG.
        table: CSV or Parquet, a row a point.
        boundary: JSON: ``about``, ``paragraph``, ``points``, ``failed`` and ``boundary``.
        finding: What it shows.
        failed: Points that could not be computed; their reasons are in the table.
    """

    picture: Path
    table: Path
    boundary: Path
    finding: Finding
    failed: int


def computed(table: Table, name: str) -> Table:
    """Returns the rows of a map's table at which something was computed.

    Args:
        table: All rows; where a point failed, ``error`` says why.
        name: The map's.

    Raises:
        StudyError: There is no such row.
    """
    if not len(table):
        raise StudyError(f"map '{name}': the table has no rows, so there is nothing to read")
    if table.failed.all():
        raise StudyError(f"map '{name}': no point could be computed; first: {table['error'][0]}")
    return table.select(~table.failed)


def run_map(
    stability_map: StabilityMap,
    folder: Path,
    *,
    points: int | None = None,
    form: str = "csv",
    executor: Executor | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> MapFiles:
    """Computes a map and writes its picture, table and boundary.

    What is done is kept in ``folder/NAME.parts``; the same map, begun again after a kill, goes on
    from there.

    Args:
        stability_map: Which.
        folder: Made if missing.
        points: About how many, 4 to 1 000 000; None for the map's own number.
        form: Of table and parts: ``csv`` or ``parquet`` (needs the extra ``tables``).
        executor: Where points are computed; by default a pool of processes.
        scheduler: Address of a dask.distributed cluster instead.
        progress: Called with the points done and all points.

    Raises:
        StudyError: The folder, the workers or the number cannot be used, or every point failed.
    """
    if points is not None and not LEAST_POINTS <= points <= MOST_POINTS:
        raise StudyError(
            f"points is {points}; a map needs {LEAST_POINTS} or more, and {MOST_POINTS} at most"
        )
    name = stability_map.name
    files = {end: folder / f"{name}.{end}" for end in ("png", form, "json")}
    for path in files.values():
        _check_writable(path)
    table = sweep(
        stability_map.evaluate,
        stability_map.points(points or stability_map.default_points),
        folder=folder / f"{name}.parts",
        format=form,
        executor=executor,
        scheduler=scheduler,
        progress=progress,
    )
    table.write(files[form])  # first: it is what cost the time
    failed = int(table.failed.sum())
    finding = stability_map.read(computed(table, name))
    write_picture(finding.figure, files["png"])
    said = {
        "map": name,
        "about": stability_map.about,
        "points": len(table),
        "failed": failed,
        "paragraph": finding.paragraph,
        "boundary": finding.boundary,
    }
    text = json.dumps(finite_or_null(said), indent=2, allow_nan=False)
    try:
        files["json"].write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise StudyError(f"cannot write '{files['json']}': {error.strerror}") from None
    return MapFiles(files["png"], files[form], files["json"], finding, failed)


def _check_writable(path: Path) -> None:
    """Refuses a file that could not be written, before the sweep; leaves the disk as it was.

    A folder that is missing or none is the sweep's to make or refuse.
    """
    if not path.parent.is_dir():
        return
    is_new = not path.exists()
    try:
        with path.open("ab"):
            pass
        if is_new:
            path.unlink()
    except OSError as error:
        raise StudyError(f"cannot write '{path}': {error.strerror}") from None
