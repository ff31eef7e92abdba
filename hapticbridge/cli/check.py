"""``hapticbridge check``."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from hapticbridge.check.case import Case, open_case
from hapticbridge.check.inventory import Inventory, take_inventory
from hapticbridge.cli.terminal import err, out, plain
from hapticbridge.clock import period_of
from hapticbridge.scene import read_scene, settings_from

MOST_NAMED = 4
"""How many idle things are named per reason before the rest is counted."""


@dataclass(frozen=True, slots=True)
class Check:
    """What a scene models, what is wrong with it, and what it costs.

    Exit code 0 if nothing is wrong, 1 if something is, 2 if there is no such scene. Example:

        hapticbridge check peg_in_hole
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
    """Motion of the hand (CSV or recording); by default NAME.csv beside the scene, or else the
    simulated hand's own: slow, 1 cm."""
    rate: float | None = None
    """Ticks per second; by default 1000, and then a time step that differs is a fault."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print everything as JSON."""

    def execute(self) -> int:
        """Checks and prints; returns the exit code."""
        source = read_scene(self.scene, **settings_from(self.settings))
        period = period_of(1000.0 if self.rate is None else self.rate)
        columns = TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
        with Progress(*columns, console=err, transient=True) as bar:
            task = bar.add_task("leading it through its motion", total=None)

            def show(done: int, total: int) -> None:
                bar.update(task, completed=done, total=total)

            case = open_case(source, self.grip, period=period, motion=self.motion, progress=show)
        inventory = take_inventory(case.model, self.grip, case.places, case.observation)
        if self.as_json:
            out.print_json(json.dumps({"inventory": asdict(inventory)}))
        else:
            _print_case(case)
            _print_inventory(inventory)
        return 0


def _print_case(case: Case) -> None:
    extent = 1e3 * (case.motion.table[:, 1:4].max(axis=0) - case.motion.table[:, 1:4].min(axis=0))
    out.print(f"[bold]{plain(case.scene.name)}[/] under {plain(case.motion_name)}")
    out.print(
        f"  {case.motion.duration:.3g} s, {' x '.join(f'{e:.3g}' for e in extent)} mm; "
        f"K = {case.coupling.stiffness:.4g} N/m, B = {case.coupling.damping:.3g} N s/m, "
        f"{1 / case.period:.4g} Hz"
    )


def _print_inventory(inventory: Inventory) -> None:
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_row("bodies", f"{inventory.bodies}, {inventory.moving_bodies} of them moving")
    table.add_row(
        "degrees of freedom",
        f"{inventory.degrees_of_freedom}, {inventory.tool_degrees_of_freedom} of them the tool's "
        f"({inventory.tool_mass:.3g} kg)",
    )
    used = [f"{count} {use}" for use, count in inventory.geoms.items() if count]
    table.add_row("geoms", f"{sum(inventory.geoms.values())}: {', '.join(used)}")
    if inventory.triangles:
        table.add_row("meshes that collide", f"{inventory.triangles} triangles of their hulls")
    met = "" if inventory.met_pairs is None else f", {inventory.met_pairs} did"
    table.add_row("pairs that can touch", f"{inventory.possible_pairs}{met}")
    for kind, (largest, median) in (inventory.rows or {}).items():
        if largest:
            table.add_row(f"{kind} rows", f"at most {largest}, median {median:g}")
    for kind in ("actuators", "equalities", "tendons"):
        if count := getattr(inventory, kind):
            table.add_row(kind, str(count))
    for reason, names in _by_reason(inventory).items():
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        table.add_row("cannot be felt", f"{reason}: {', '.join(names[:MOST_NAMED])}{more}")
    out.print("[bold]What it models[/]")
    out.print(table)


def _by_reason(inventory: Inventory) -> dict[str, list[str]]:
    names: dict[str, list[str]] = {}
    for idle in inventory.idle:
        names.setdefault(idle.reason, []).append(plain(idle.place.element))
    return names
