"""``hapticbridge chart``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from hapticbridge.cli.terminal import err, out, plain, print_json, progress
from hapticbridge.errors import StudyError
from hapticbridge.lab.chart.chart import MIN_REPEATS, REPEATS, Extent, measure_chart, open_workload
from hapticbridge.lab.chart.engine_run import peer_settings
from hapticbridge.lab.chart.output import ChartFiles, prepared_files, write_chart
from hapticbridge.lab.chart.setting import chosen_methods, chosen_periods, settings_for
from hapticbridge.lab.chart.work import (
    WORK_ENDINGS,
    measure_scene_rates,
    measure_work,
    write_scene_rates,
    write_work,
)
from hapticbridge.lab.engines.base import available_engines, caught_prints, open_engine
from hapticbridge.scene import load_scene

ALL = "all"

WORK = "work"
QUICK_SIZE = 30
"""Largest scene of a quick chart of work."""


@dataclass(frozen=True, slots=True)
class Chart:
    """Chart the cost of ways to simulate a scene against their error.

    The scene is point_mass, peg_in_hole, rod_impact, sliding_block or spinning_body, which have
    references of their own, or any scene with a hand path beside it, which is compared with finer
    steps. 'work' in place of a scene charts what a tick costs as a scene grows. Writes SCENE.png,
    .svg, .csv and .json into the folder.

    Example:
        hapticbridge chart peg_in_hole --out charts
    """

    scene: tyro.conf.Positional[str]
    """A workload's or scene's name, or an MJCF file."""
    methods: tuple[str, ...] | None = None
    """Rendering methods; by default all of them."""
    steps: tuple[float, ...] | None = None
    """Time steps in ms, all of which divide the longest; by default 4, 2, 1, 0.5, 0.25, 0.125."""
    engines: tuple[str, ...] = ()
    """Other engines on the same work (extra 'peers'), or 'all' that are installed."""
    out: Path = Path("chart")
    """Folder to write to."""
    quick: bool = False
    """Three time steps and three rounds of timing: half a minute."""
    scene_rates: bool = False
    """Chart felt error and cost against the rate of a scene that steps slower than the loop."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print what the chart says as JSON."""

    def execute(self) -> int:
        """Measures the chart; returns the exit code."""
        if self.scene_rates:
            return self._execute_scene_rates()
        if self.scene == WORK:
            if self.methods is not None or self.steps is not None or self.engines:
                raise StudyError(
                    f"'{WORK}' has scenes and settings of its own; it takes neither --methods nor "
                    "--steps nor --engines"
                )
            return self._execute_work()
        periods = chosen_periods(self.steps, is_quick=self.quick)
        methods = chosen_methods(self.methods)
        with err.status("preparing references …"):
            workload = open_workload(self.scene, Extent(periods[0], periods[-1]))
        paths = prepared_files(self.out, workload.name)
        settings = settings_for(methods, periods, has_contact=workload.has_contact)
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
        return 0

    def _execute_work(self) -> int:
        paths = prepared_files(self.out, WORK, WORK_ENDINGS)
        with progress(f"chart {WORK}") as show:
            chart = measure_work(most=QUICK_SIZE if self.quick else None, progress=show)
        facts = write_work(chart, paths)
        if self.as_json:
            print_json(facts)
        else:
            out.print(plain(facts["paragraph"]))
        err.print("wrote " + ", ".join(plain(str(path)) for path in paths.values()))
        return 0

    def _execute_scene_rates(self) -> int:
        if self.methods is not None or self.steps is not None or self.engines or self.quick:
            raise StudyError(
                "--scene-rates has settings of its own; it takes neither --methods nor --steps nor "
                "--engines nor --quick"
            )
        scene = load_scene(self.scene)
        paths = prepared_files(self.out, f"{scene.path.stem}_rates", WORK_ENDINGS)
        with err.status("running every rate …"):
            facts = write_scene_rates(scene.path.stem, measure_scene_rates(scene), paths)
        if self.as_json:
            print_json(facts)
        else:
            for point in facts["points"]:
                out.print(
                    f"{point['rate']:4.0f} Hz: {point['jnd']:.2g} JND, a step costs "
                    f"{1e3 * point['step']:.3g} ms, {plain(point['environment'])}"
                )
        err.print("wrote " + ", ".join(plain(str(path)) for path in paths.values()))
        return 0

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
        out.print("  on the front, by cost:" if panel["front"] else "  nothing is on the front")
        for point in panel["front"]:
            out.print(
                f"    {point['cost']:.2g} s per s, {point['error']:.3g} JND: "
                f"{plain(point['setting'])}"
            )
    for note in files.facts["notes"]:
        out.print(f"  {plain(note)}")
    for name, reason in files.facts["skipped"].items():
        out.print(f"  not simulated: {plain(name)} ({plain(reason)})")
    err.print("wrote " + ", ".join(plain(str(path)) for path in files.paths.values()))
