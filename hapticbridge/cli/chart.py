"""``hapticbridge chart`` and ``hapticbridge stability``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from hapticbridge.arguments import option
from hapticbridge.cli.terminal import err, out, plain, print_json, progress, write_figure
from hapticbridge.errors import StudyError, choices
from hapticbridge.lab.chart.chart import MIN_REPEATS, REPEATS, Extent, measure_chart, open_workload
from hapticbridge.lab.chart.engine_run import peer_settings
from hapticbridge.lab.chart.output import ChartFiles, draw_chart, prepared_files, write_chart
from hapticbridge.lab.chart.scene_run import SceneRates, Workload
from hapticbridge.lab.chart.setting import (
    Setting,
    chosen_methods,
    chosen_periods,
    rate_settings,
    settings_for,
)
from hapticbridge.lab.engines.base import available_engines, caught_prints, open_engine
from hapticbridge.lab.maps import MAPS, MapFiles, StabilityMap, run_map
from hapticbridge.plotting import check_ending

ALL = "all"

SLOW_SCENE = "slow_scene"


@dataclass(frozen=True, slots=True)
class Chart:
    """Chart the cost of ways to simulate a scene against their error.

    The scene is point_mass, spinning_body, spring_arm, tap, rod_impact, sliding_block, stack, jam,
    hex_socket or peg_in_hole, which have references of their own, or any scene with a hand path
    beside it, which is compared with finer steps. slow_scene is 'beads' with --scene-rates. Writes
    SCENE.png, .svg, .csv and .json into the folder.

    Example:
        hapticbridge chart peg_in_hole --out charts
    """

    scene: str = option(metavar="SCENE", is_positional=True)
    """A workload's or scene's name, or an MJCF file."""
    methods: tuple[str, ...] | None = None
    """Rendering methods; by default all of them."""
    steps: tuple[float, ...] | None = None
    """Time steps in ms, all of which divide the longest; by default 4, 2, 1, 0.5, 0.25, 0.125."""
    engines: tuple[str, ...] = ()
    """Other engines on the same work (extra 'peers'), or 'all' that are installed."""
    out: Path = Path("chart")
    """Folder to write to."""
    plot: Path | None = None
    """Draw the chart into this picture (.png, .svg or .pdf) too."""
    quick: bool = False
    """Three time steps and three rounds of timing: about a minute."""
    scene_rates: bool = False
    """Chart a scene that steps less often than the loop, beside a loop that is as slow."""
    as_json: bool = option(False, flag="json")
    """Print what the chart says as JSON."""

    def execute(self) -> int:
        """Measures the chart; returns the exit code."""
        check_ending(self.plot)
        is_rates = self.scene_rates or self.scene == SLOW_SCENE
        if is_rates and (self.methods is not None or self.steps is not None or self.engines):
            name = "--scene-rates" if self.scene_rates else f"'{self.scene}'"
            raise StudyError(
                f"{name} has settings of its own; it takes neither --methods nor --steps nor "
                "--engines"
            )
        with err.status("preparing references …"):
            workload, settings, periods = self._rates() if is_rates else self._usual()
        paths = prepared_files(self.out, workload.name)
        with caught_prints(_print_dim), progress(f"chart {workload.name}") as show:
            settings += peer_settings(self._peers(), periods)
            chart = measure_chart(
                workload, settings, repeats=MIN_REPEATS if self.quick else REPEATS, progress=show
            )
        files = write_chart(chart, paths)
        if self.as_json:
            print_json(files.facts)
        else:
            _print(files)
        if self.plot is not None:
            write_figure(draw_chart(chart), self.plot)
        return 0

    def _usual(self) -> tuple[Workload, list[Setting], list[float]]:
        periods = chosen_periods(self.steps, is_quick=self.quick)
        methods = chosen_methods(self.methods)
        workload = open_workload(self.scene, Extent(periods[0], periods[-1]))
        return workload, settings_for(methods, periods, has_contact=workload.has_contact), periods

    def _rates(self) -> tuple[Workload, list[Setting], list[float]]:
        is_named = self.scene == SLOW_SCENE
        scene = "beads" if is_named else self.scene
        workload = SceneRates(scene, SLOW_SCENE if is_named else f"{Path(scene).stem}_rates")
        return workload, rate_settings(), []

    def _peers(self) -> list[str]:
        """Returns the requested engines that are installed; prints which are not."""
        if self.engines == (ALL,):
            found = available_engines()
            for reason in dict.fromkeys(found.missing.values()):
                err.print(plain(reason))
            return list(found.available)
        if ALL in self.engines:
            raise StudyError(f"--engines {ALL} names every engine; give it alone")
        for name in self.engines:
            open_engine(name)
        return list(self.engines)


def _print_dim(line: str) -> None:
    err.print(f"[dim]{plain(line)}[/]")


def _print(files: ChartFiles) -> None:
    for panel in files.facts["panels"]:
        out.print(f"[bold]{plain(panel['title'])}[/], against {plain(panel['reference'])}")
        out.print(f"  {plain(panel['recommendation'])}")
        if panel["standing"]:
            out.print(f"  {plain(panel['standing'])}")
        out.print("  on the front, by cost:" if panel["front"] else "  nothing is on the front")
        for point in panel["front"]:
            hazard = f" ({point['hazard']})" if point["hazard"] else ""
            out.print(
                f"    {point['cost']:.2g} s per s, {point['error']:.3g} JND: "
                f"{plain(point['setting'] + hazard)}"
            )
    for note in files.facts["notes"]:
        out.print(f"  {plain(note)}")
    for name, reason in files.facts["skipped"].items():
        out.print(f"  not simulated: {plain(name)} ({plain(reason)})")
    err.print("wrote " + ", ".join(plain(str(path)) for path in files.paths.values()))


@dataclass(frozen=True, slots=True)
class Stability:
    """Map where ways to render a tool lose passivity or stability.

    Theory is drawn on top of measurement. Writes NAME.png, NAME.csv and NAME.json into the folder,
    and two recordings for 'audit', 'view' and 'compare': NAME.fails.mcap fails in the way that the
    map is about; NAME.safe.mcap differs in one named value and holds. What is done stays in
    NAME.parts: begun again after a stop, a map goes on from there. After a change of hapticbridge
    or MuJoCo the old file is refused: give another folder or delete them.

    Example:
        hapticbridge stability coupling --out maps
    """

    name: str = option(metavar="NAME", is_positional=True)
    """A map's name, or 'all': coupling, rate, device, tool_mass, contact, geometry, rotation,
    restitution."""
    out: Path = Path("stability")
    """Folder to write to."""
    plot: Path | None = None
    """Draw the map into this picture (.png, .svg or .pdf; one map only) too."""
    points: int | None = None
    """About how many runs or points; by default the map's own number, for about a minute."""
    form: Literal["csv", "parquet"] = option("csv", flag="format")
    """Format of the table; parquet needs the extra 'tables'."""
    scheduler: str | None = None
    """Address of a dask.distributed scheduler to compute on (extra 'cluster')."""
    as_json: bool = option(False, flag="json")
    """Print what each map found as a JSON list."""

    def execute(self) -> int:
        """Computes the maps; returns the exit code."""
        if self.name != ALL and self.name not in MAPS:
            listed = "; ".join(f"{name}: {each.about}" for name, each in MAPS.items())
            raise StudyError(
                f"no map is called '{self.name}'; maps: {choices([*MAPS, ALL])} ({listed})"
            )
        check_ending(self.plot)
        if self.plot is not None and self.name == ALL:
            raise StudyError("--plot is the picture of one map; name it in place of 'all'")
        chosen = MAPS.values() if self.name == ALL else (MAPS[self.name],)
        facts = []
        for each in chosen:
            files = self._computed(each)
            facts.append(json.loads(files.boundary.read_text(encoding="utf-8")))
            if not self.as_json:
                _print_map(each, files)
            if self.plot is not None:
                write_figure(files.finding.figure, self.plot)
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
                workers=self.scheduler,
                progress=show,
            )


def _print_map(each: StabilityMap, files: MapFiles) -> None:
    out.print(f"[bold]{each.name}[/]: {plain(files.finding.paragraph)}")
    if files.failed:
        out.print(f"  [yellow]{files.failed} points could not be computed[/]; see {files.table}")
    fails, safe = (report.path for report in files.twins.reports)
    out.print(f"  recorded twins: {plain(files.twins.sentence)}")
    others = (files.table, files.boundary, fails, safe)
    err.print(f"wrote {plain(str(files.picture))}, {', '.join(path.name for path in others)}")
