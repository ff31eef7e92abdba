"""``hapticbridge check``."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from hapticbridge.certificate import default_coupling
from hapticbridge.check.case import DEFAULT_PERIOD, LARGEST_WORKSPACE, Case, open_case
from hapticbridge.check.cost import Cost, measure_cost
from hapticbridge.check.drawing import draw_cost
from hapticbridge.check.faults import Fault
from hapticbridge.check.inventory import Inventory, take_inventory
from hapticbridge.check.lean import Lean, checked_budget
from hapticbridge.check.lean_file import check_target, write_lean
from hapticbridge.check.lean_picture import draw_lean
from hapticbridge.check.lean_table import check_table, lean_facts, write_table
from hapticbridge.check.observation import quiet
from hapticbridge.check.rules import find_faults
from hapticbridge.check.trial import MAY_GO, SAVES_NOTHING, Trial
from hapticbridge.cli.check_lean import look_for_lean, print_lean, print_written
from hapticbridge.cli.check_words import print_case, print_cost, print_faults, print_inventory
from hapticbridge.cli.terminal import err, plain, print_json, progress
from hapticbridge.clock import period_of
from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import SceneError
from hapticbridge.picture import check_ending, write_picture
from hapticbridge.scene import read_scene, settings_from

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class Check:
    """Find what is wrong with a scene, and what a tick of it costs.

    Leads the scene through its hand's motion and names every fault with the line to change. Exit
    code 0 if nothing is wrong, 1 if something is, 2 if the scene cannot be read.

    Example:
        hapticbridge check my_tool.xml --lean --plot lean.png --write lean.xml
    """

    FIRST_OPTIONS: ClassVar = (
        "scene",
        "settings",
        "grip",
        "motion",
        "workspace",
        "plot",
        "lean",
        "budget",
        "write",
        "as_json",
    )

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
    """An MJCF file, or a scene's name (see 'hapticbridge scenes')."""
    settings: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="set", metavar="NAME=VALUE")
    ] = ()
    """Set a parameter of the scene, as often as wanted: --set clearance=0.1e-3."""
    grip: str = "grip"
    """Site on the tool that the hand holds."""
    motion: Path | None = None
    """Motion of the handle (CSV or recording); by default NAME.csv beside the scene, or else the
    simulated hand's own: slow, 1 cm."""
    rate: float | None = None
    """Ticks per second; by default 1000, and then a scene with another time step is told so."""
    stiffness: float | None = None
    """Coupling stiffness K in N/m; by default the stiffest that is safe on the simulated device."""
    damping: float | None = None
    """Coupling damping B in N s/m that is to be felt."""
    scale: float = 1.0
    """Handle motion per device motion."""
    workspace: float = LARGEST_WORKSPACE
    """Edge in m of the cube that your device reaches; by default that of the largest table-top
    devices."""
    plot: Path | None = None
    """Draw what the scene costs into this picture (.png, .svg or .pdf); with --lean instead cost
    against felt error of everything that was tried."""
    lean: bool = False
    """Try what could go without being felt: each simplification alone, then greedily together."""
    budget: float | None = None
    """Felt error in just noticeable differences that --lean allows; by default 1."""
    write: Path | None = None
    """Write the leanest scene to this file (.xml), read it back, judge it again; implies --lean."""
    table: Path | None = None
    """Write all that --lean tried as a table (.csv); implies --lean."""
    overwrite: bool = False
    """Replace the scene of --write if the file exists."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print everything as JSON."""

    def execute(self) -> int:
        """Checks and prints; returns the exit code."""
        if self.plot is not None:
            check_ending(self.plot)
        is_lean_asked = self.lean or self.write is not None or self.table is not None
        if self.budget is not None and not is_lean_asked:
            raise SceneError("--budget goes with --lean")
        if self.overwrite and self.write is None:
            raise SceneError("--overwrite goes with --write FILE; nothing else is replaced")
        budget = checked_budget(1.0 if self.budget is None else self.budget)
        source = read_scene(self.scene, **settings_from(self.settings))
        if self.write is not None:
            check_target(source, self.write, overwrite=self.overwrite)
        if self.table is not None:
            check_table(
                self.table, [path for path in (source.path, self.write) if path is not None]
            )
        period = None if self.rate is None else period_of(self.rate)
        with progress("leading it through its motion") as show:
            case = open_case(
                source,
                self.grip,
                coupling=self._coupling(period or DEFAULT_PERIOD),
                period=period,
                scale=self.scale,
                workspace=self.workspace,
                motion=self.motion,
                progress=show,
            )
        inventory = take_inventory(case.model, self.grip, case.places, case.observation)
        faults, cost = find_faults(case), None
        if case.observation is not None:
            with progress("timing it") as show, quiet():
                cost = measure_cost(
                    case.scene, case.samples, case.coupling, case.period, progress=show
                )
        if not self.as_json:
            print_case(case)
            print_inventory(inventory)
            print_cost(cost)
            print_faults(faults)
        lean = self._looked_for(case, budget) if is_lean_asked else None
        written = None if lean is None else self._told(lean)
        if self.as_json:
            facts = _facts(case, inventory, faults, cost)
            print_json(facts if lean is None else facts | {"lean": lean_facts(lean, written)})
        if self.plot is not None:
            figure = _picture(case, cost, lean)
            if figure is not None:
                write_picture(figure, self.plot)
            told = "wrote" if figure is not None else "there is nothing to draw in"
            err.print(f"{told} {plain(str(self.plot))}")
        is_worse = written is not None and written.verdict not in (MAY_GO, SAVES_NOTHING)
        return 1 if faults or is_worse or (is_lean_asked and lean is None) else 0

    def _looked_for(self, case: Case, budget: float) -> Lean | None:
        """Looks for what could go; None, and a sentence, where the scene must be mended first."""
        try:
            return look_for_lean(case, budget)
        except SceneError as error:
            err.print(f"what could go cannot be said: {plain(str(error))}")
            return None

    def _told(self, lean: Lean) -> Trial | None:
        """Prints and writes what was found; returns the written scene's trial."""
        if not self.as_json:
            print_lean(lean)
        if self.table is not None:
            write_table(lean, self.table)
            err.print(f"wrote {plain(str(self.table))}")
        if self.write is None:
            return None
        if not lean.together:
            err.print(f"nothing may go: {plain(str(self.write))} is not written")
            return None
        written = write_lean(lean, self.write, overwrite=self.overwrite)
        print_written(lean, written, self.write, is_quiet=self.as_json)
        return written

    def _coupling(self, period: float) -> Coupling:
        info = SimulatedDevice().info
        coupling = default_coupling(info, period, self.scale, self.scale)
        if self.stiffness is not None:
            coupling = replace(coupling, stiffness=self.stiffness)
        if self.damping is not None:
            coupling = replace(coupling, damping=self.damping)
        return coupling


def _picture(case: Case, cost: Cost | None, lean: Lean | None) -> Figure | None:
    if lean is not None:
        return draw_lean(lean, case.scene.name)
    return None if cost is None else draw_cost(cost, f"{case.scene.name}: what a tick costs")


def _facts(
    case: Case, inventory: Inventory, faults: tuple[Fault, ...], cost: Cost | None
) -> dict[str, object]:
    return {
        "scene": str(case.source.path),
        "parameters": case.source.parameters,
        "motion": {"name": case.motion_name, "seconds": case.motion.duration},
        "coupling": asdict(case.coupling),
        "period_s": case.period,
        "inventory": asdict(inventory),
        "faults": [asdict(fault) for fault in faults],
        "cost": None if cost is None else asdict(cost),
    }
