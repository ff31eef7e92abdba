"""``hapticbridge check``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from hapticbridge.certificate import default_coupling
from hapticbridge.check.case import DEFAULT_PERIOD, LARGEST_WORKSPACE, Case, open_case
from hapticbridge.check.cost import Cost, measure_cost
from hapticbridge.check.drawing import draw_cost
from hapticbridge.check.faults import Fault
from hapticbridge.check.inventory import Inventory, take_inventory
from hapticbridge.check.observation import quiet
from hapticbridge.check.rules import find_faults
from hapticbridge.cli.check_words import print_case, print_cost, print_faults, print_inventory
from hapticbridge.cli.terminal import err, plain, print_json
from hapticbridge.clock import period_of
from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.picture import check_ending, write_picture
from hapticbridge.scene import read_scene, settings_from


@dataclass(frozen=True, slots=True)
class Check:
    """What a scene models, what is wrong with it, and what it costs.

    Leads the scene through its hand's motion and names every fault with the line to change. Exit
    code 0 if nothing is wrong, 1 if something is, 2 if the scene cannot be read. Example:

        hapticbridge check peg_in_hole --plot check.png
    """

    scene: tyro.conf.Positional[str]
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
    """Coupling damping B in N s/m."""
    scale: float = 1.0
    """Handle motion per device motion."""
    workspace: float = LARGEST_WORKSPACE
    """Edge in m of the cube that your device reaches; by default that of the largest table-top
    devices."""
    plot: Path | None = None
    """Draw what the scene costs into this picture (.png, .svg or .pdf)."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print everything as JSON."""

    def execute(self) -> int:
        """Checks and prints; returns the exit code."""
        if self.plot is not None:
            check_ending(self.plot)
        source = read_scene(self.scene, **settings_from(self.settings))
        period = None if self.rate is None else period_of(self.rate)
        with _progress("leading it through its motion") as show:
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
            with _progress("timing it") as show, quiet():
                cost = measure_cost(
                    case.scene, case.samples, case.coupling, case.period, progress=show
                )
        if self.as_json:
            print_json(_facts(case, inventory, faults, cost))
        else:
            print_case(case)
            print_inventory(inventory)
            print_cost(cost)
            print_faults(faults)
        if self.plot is not None and cost is not None:
            write_picture(draw_cost(cost, f"{case.scene.name}: what a tick costs"), self.plot)
            err.print(f"wrote {plain(str(self.plot))}")
        return 1 if faults else 0

    def _coupling(self, period: float) -> Coupling:
        info = SimulatedDevice().info
        coupling = default_coupling(info, period, self.scale, self.scale)
        if self.stiffness is not None:
            coupling = replace(coupling, stiffness=self.stiffness)
        if self.damping is not None:
            coupling = replace(coupling, damping=self.damping)
        return coupling


@contextmanager
def _progress(words: str) -> Iterator[Callable[[int, int], None]]:
    columns = TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task(words, total=None)

        def show(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        yield show


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
