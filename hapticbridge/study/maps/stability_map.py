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
from hapticbridge.picture import write_picture
from hapticbridge.study.sweep import sweep
from hapticbridge.study.table import Table

Point = dict[str, float | int | str | bool]


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
        points: About how many, >= 4; None for the map's own number.
        form: Of table and parts: ``csv`` or ``parquet`` (needs the extra ``tables``).
        executor: Where points are computed; by default a pool of processes.
        scheduler: Address of a dask.distributed cluster instead.
        progress: Called with the points done and all points.

    Raises:
        StudyError: The folder, the workers or the number cannot be used, or every point failed.
    """
    if points is not None and points < 4:
        raise StudyError(f"points is {points}; a map needs 4 or more")
    name = stability_map.name
    table = sweep(
        stability_map.evaluate,
        stability_map.points(points or stability_map.default_points),
        folder=folder / f"{name}.parts",
        format=form,
        executor=executor,
        scheduler=scheduler,
        progress=progress,
    )
    failed = int(table.failed.sum())
    if failed == len(table):
        raise StudyError(f"map '{name}': no point could be computed; first: {table['error'][0]}")
    finding = stability_map.read(table.select(~table.failed))
    files = MapFiles(
        picture=folder / f"{name}.png",
        table=folder / f"{name}.{form}",
        boundary=folder / f"{name}.json",
        finding=finding,
        failed=failed,
    )
    write_picture(finding.figure, files.picture)
    table.write(files.table)
    said = {
        "map": name,
        "about": stability_map.about,
        "points": len(table),
        "failed": failed,
        "paragraph": finding.paragraph,
        "boundary": finding.boundary,
    }
    try:
        files.boundary.write_text(json.dumps(said, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise StudyError(f"cannot write '{files.boundary}': {error.strerror}") from None
    return files
