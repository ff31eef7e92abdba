"""``hapticbridge stability``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from hapticbridge.cli.terminal import err, out, plain, print_json, progress
from hapticbridge.errors import StudyError, choices
from hapticbridge.lab.maps import MAPS, MapFiles, StabilityMap, run_map

ALL = "all"


@dataclass(frozen=True, slots=True)
class Stability:
    """Map where ways to render a tool lose passivity or stability.

    Theory is drawn on top of measurement. Writes NAME.png, NAME.csv and NAME.json into the folder.
    What is done stays in NAME.parts: begun again after a stop, a map goes on from there. After a
    change of hapticbridge or MuJoCo the old file is refused: give another folder or delete them.

    Example:
        hapticbridge stability coupling --out maps
    """

    name: tyro.conf.Positional[str]
    """A map's name, or 'all': coupling, rate, device, tool_mass, contact, geometry, rotation,
    restitution."""
    out: Path = Path("stability")
    """Folder to write to."""
    points: int | None = None
    """About how many runs or points; by default the map's own number, for about a minute."""
    form: Annotated[Literal["csv", "parquet"], tyro.conf.arg(name="format")] = "csv"
    """Format of the table; parquet needs the extra 'tables'."""
    scheduler: str | None = None
    """Address of a dask.distributed scheduler to compute on (extra 'cluster')."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print what each map found as a JSON list."""

    def execute(self) -> int:
        """Computes the maps; returns the exit code."""
        if self.name != ALL and self.name not in MAPS:
            listed = "; ".join(f"{name}: {each.about}" for name, each in MAPS.items())
            raise StudyError(
                f"no map is called '{self.name}'; maps: {choices([*MAPS, ALL])} ({listed})"
            )
        chosen = MAPS.values() if self.name == ALL else (MAPS[self.name],)
        facts = []
        for each in chosen:
            files = self._computed(each)
            facts.append(json.loads(files.boundary.read_text(encoding="utf-8")))
            if not self.as_json:
                _print(each, files)
        if self.as_json:
            print_json(facts)
        return 0

    def _computed(self, each: StabilityMap) -> MapFiles:
        with progress(f"map {each.name}", is_counted=True) as show:
            return run_map(
                each,
                self.out,
                points=self.points,
                form=self.form,
                scheduler=self.scheduler,
                progress=show,
            )


def _print(each: StabilityMap, files: MapFiles) -> None:
    out.print(f"[bold]{each.name}[/]: {plain(files.finding.paragraph)}")
    if files.failed:
        out.print(f"  [yellow]{files.failed} points could not be computed[/]; see {files.table}")
    err.print(f"wrote {plain(str(files.picture))}, {files.table.name}, {files.boundary.name}")
