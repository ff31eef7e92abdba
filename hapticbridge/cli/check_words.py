"""How ``hapticbridge check`` says what it found."""

from __future__ import annotations

import math
import re
import textwrap
from collections import Counter

import numpy as np
from rich.table import Table

from hapticbridge.check.case import Case
from hapticbridge.check.cost import TICK_SHARE, Cost
from hapticbridge.check.faults import Fault, length
from hapticbridge.check.growth import Growth, Spread
from hapticbridge.check.inventory import MEETS_TOOL, Inventory
from hapticbridge.cli.terminal import out, plain

MOST_NAMED = 4
"""How many things of a kind are named before the rest is counted."""

_SHOWN = 0.01  # s/s; a stage that takes less of the tick is left out
_GLUE = "\x00"  # in place of a space at which a line is not to end
_WIDTH = 96  # letters of a line of text below a fault


def print_case(case: Case) -> None:
    """Prints what is checked, and how."""
    extent = 1e3 * np.ptp(case.motion.table[:, 1:4], axis=0)
    size = " x ".join(f"{edge:.3g}" for edge in extent)
    out.print(f"[bold]{plain(case.scene.name)}[/]  {plain(str(case.source.path))}")
    out.print(
        f"  motion: {plain(case.motion_name)}, {case.motion.duration:.3g} s, {size} mm; "
        f"coupling: {case.coupling.stiffness:.4g} N/m, {case.coupling.damping:.3g} N s/m felt, "
        f"{1 / case.period:.4g} Hz"
    )


def print_inventory(inventory: Inventory) -> None:
    """Prints what the scene models."""
    out.print("\n[bold]What it models[/]")
    mass = inventory.tool_mass
    uses = ", ".join(f"{count} {use}" for use, count in inventory.geoms.items() if count)
    lines = {
        "bodies": f"{inventory.bodies}, {inventory.moving_bodies} of them moving",
        "degrees of freedom": f"{inventory.degrees_of_freedom}, "
        f"{inventory.tool_degrees_of_freedom} of them the tool's "
        + (f"({mass:.3g} kg)" if mass >= 0.1 else f"({1e3 * mass:.3g} g)"),
        "geoms": ": ".join(filter(None, (str(sum(inventory.geoms.values())), uses))),
    }
    if inventory.triangles:
        lines["meshes that collide"] = f"{inventory.triangles} triangles of their hulls"
    met = "" if inventory.met_pairs is None else f", {inventory.met_pairs} did"
    lines["pairs that can touch"] = f"{inventory.possible_pairs}{met}"
    for kind, (largest, median) in (inventory.rows or {}).items():
        if largest:
            lines[f"{kind} rows"] = f"at most {largest} in a step, median {median:g}"
    if inventory.stiffness is not None:
        least, most = (f"{1e-3 * stiffness:.3g}" for stiffness in inventory.stiffness)
        lines["contact stiffness"] = (
            f"{least} to {most} kN/m at the tool, which sank in by {length(inventory.deepest)}"
        )
    is_met = inventory.rows is None or inventory.geoms[MEETS_TOOL] > 0
    if inventory.possible_pairs and not inventory.flexes and not is_met:
        lines["contact"] = (
            "the tool touches nothing in this motion, so what contact costs is unknown;\n"
            f"{'':23}lead it to where it does: --motion hand.csv (t,x,y,z in s and m)"
        )
    for kind in ("actuators", "equalities", "tendons", "flexes"):
        if count := getattr(inventory, kind):
            lines[kind] = str(count)
    for name, words in lines.items():
        out.print(f"  {name:<21}{words}")
    reasons: dict[str, list[str]] = {}
    for idle in inventory.idle:
        reasons.setdefault(idle.reason, []).append(idle.place.element)
    if reasons:
        out.print("  cannot be felt")
    for reason, names in reasons.items():
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        out.print(f"    {reason}: {plain(', '.join(names[:MOST_NAMED]))}{more}")


def print_cost(cost: Cost | None) -> None:
    """Prints what the scene costs on this machine."""
    out.print("\n[bold]What it costs[/] (µs on this machine, now)")
    if cost is None:
        out.print("  not measured: the motion did not end")
        return
    table = Table("", "out of contact", "in contact", box=None, pad_edge=False, padding=(0, 2))
    for column in table.columns[1:]:
        column.justify = "right"
    table.add_row("  whole tick, median", _micro(cost.free.median), _micro(cost.contact.median))
    table.add_row("  99 of 100 below", _micro(cost.free.p99), _micro(cost.contact.p99))
    for name, times in cost.stages.items():
        if any(t >= _SHOWN * whole for t, whole in zip(times, _medians(cost), strict=True)):
            table.add_row(f"    {name}", *map(_micro, times))
    out.print(table)
    for unit, growth in (("contact", cost.by_contacts), ("constraint row", cost.by_rows)):
        if sentence := _growth(growth, unit):
            out.print(f"  {sentence}")
    out.print(
        f"  highest rate: {cost.highest_rate:,.0f} Hz, where 99 of 100 ticks leave "
        f"{100 * (1 - TICK_SHARE):g} % of the period to the device and to late wake-ups"
    )


def print_faults(faults: tuple[Fault, ...]) -> None:
    """Prints each fault with its place and the change that mends it."""
    if not faults:
        out.print("\n[bold]What is wrong[/]\n  [green]nothing found[/]")
        return
    out.print(f"\n[bold]What is wrong[/]: [yellow]{len(faults)} found[/]")
    seen: Counter[str] = Counter()
    for number, fault in enumerate(faults, 1):
        seen[fault.kind] += 1
        if seen[fault.kind] > MOST_NAMED:
            continue
        out.print(
            f"  {number:>2} [yellow]{plain(fault.kind)}[/]  {plain(str(fault.place))}",
        )
        # what stands in quotes is to be copied: it stays on one line
        whole = re.sub(r'"[^"]*"', lambda quoted: quoted[0].replace(" ", _GLUE), fault.sentence)
        for line in textwrap.wrap(whole, _WIDTH):
            out.print(f"     {plain(line.replace(_GLUE, ' '))}")
        out.print(f"     [green]write:[/] {plain(fault.change)}")
    for kind, count in seen.items():
        if count > MOST_NAMED:
            out.print(f"  and {count - MOST_NAMED} more of '{plain(kind)}': --json lists all")


def _medians(cost: Cost) -> tuple[float, float]:
    return tuple(_known(spread) for spread in (cost.free, cost.contact))  # type: ignore[return-value] # two


def _known(spread: Spread) -> float:
    return spread.median if spread.ticks else math.inf


def _micro(seconds: float) -> str:
    return f"{1e6 * seconds:.2f}" if math.isfinite(seconds) else "-"


def _growth(growth: Growth, unit: str) -> str:
    if growth.base is None or growth.per_one is None:
        return ""
    most = growth.steps[-1]
    return (
        f"grows by {1e6 * growth.per_one:.2g} µs per {unit}: {1e6 * growth.base:.3g} µs with none, "
        f"{1e6 * most[2]:.3g} µs with {most[0]}"
    )
