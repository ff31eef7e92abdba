"""``hapticbridge check``."""

from __future__ import annotations

import math
import re
import shlex
import textwrap
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from rich.table import Table

from hapticbridge.arguments import option, shared
from hapticbridge.check.case import (
    DEFAULT_PERIOD,
    MAX_WORKSPACE,
    IntendedUse,
    SceneUnderCheck,
    open_case,
    refused_body,
)
from hapticbridge.check.cost import TICK_SHARE, Cost, Growth, draw_cost, measure_cost
from hapticbridge.check.findings import find_faults
from hapticbridge.check.inventory import MEETS_TOOL, TOOL, Inventory, take_inventory
from hapticbridge.check.lean import (
    MAY_GO,
    SAVES_NOTHING,
    Lean,
    VariantVerdict,
    checked_budget,
    find_lean,
)
from hapticbridge.check.lean_output import check_lean_target, lean_facts, write_lean
from hapticbridge.check.simplify import OTHER_MOTIONS
from hapticbridge.check.version import SceneVariant
from hapticbridge.cli.terminal import compiling, err, out, plain, print_json, progress, working
from hapticbridge.clock import period_of
from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import default_coupling
from hapticbridge.demand.methods import RIGID, Contact, RunCoupling, default_method
from hapticbridge.demand.pulse import Tap, tap_words
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import HapticBridgeError, SceneError
from hapticbridge.kernel.mujoco_c import quiet
from hapticbridge.plotting import check_ending, write_picture
from hapticbridge.run.hands import Grasp
from hapticbridge.run.options import BridgeOptions, Workspace
from hapticbridge.scene import plain_model, read_scene, settings_from
from hapticbridge.scene.fault import Fault, length, others, weight
from hapticbridge.units import format_number, format_si

_HEADINGS = ("alone", "cost", "JND", "tool force, RMS", "peak", "tool torque, RMS", "tool off by")
"""Headings of the table of trials. JND is the felt error in just noticeable differences."""

_ROUNDING = 1e-9  # N and N m; what is below is how the computer adds


def print_lean(lean: Lean) -> None:
    """Prints what could go, and how far it leads together."""
    judge = lean.judge
    tick = 1e6 * judge.seconds * judge.original.setting.period
    out.print(
        f"\n[bold]What could go[/] (felt up to {judge.budget:g} just noticeable differences; "
        f"the scene as it is: {format_number(tick, 3)} µs a tick)"
    )
    rows = [_numbers(trial) for trial in (*lean.alone, *lean.together)]
    ends = [_verdict(trial) for trial in lean.alone] + [plain(t.loses) for t in lean.together]
    widths = [max(map(len, column)) for column in zip(_HEADINGS, *rows, strict=True)]
    for number, (row, end) in enumerate(zip([_HEADINGS, *rows], ["", *ends], strict=True)):
        if number == len(lean.alone) + 1:
            out.print("  [bold]together, in order[/]")
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        cells[0] = row[0].ljust(widths[0])
        out.print(f"  {plain('  '.join(cells))}  {end}".rstrip())
    for trial in lean.alone:
        if trial.error is None:
            out.print(f"  {plain(trial.name)}: {plain(trial.sentence)}")
    if not lean.together:
        out.print("  [green]nothing may go: the scene is lean[/]")
        return
    if any(trial.loses == OTHER_MOTIONS for trial in lean.together):
        out.print(
            "  [yellow]another motion may miss what this one did not need[/]: judge it by one that "
            "does all that the hand will do"
        )
    setting = lean.draft.setting
    if setting != judge.original.setting:
        out.print(
            f"  at {format_number(1 / setting.period)} Hz, {setting.substeps} substep(s) a tick: "
            f"the device needs {format_number(lean.result.needed_damping, 3)} N s/m of damping"
        )
    cost = lean.result.percent
    out.print(
        f"  all together: {cost:.0f} % of the cost, {format_number(100 / cost, 2)} times as fast"
    )


def print_written(lean: Lean, written: VariantVerdict, path: Path, command: str) -> None:
    """Prints what the written scene is like, read back, and the command that runs it, if any."""
    err.print(
        f"wrote {plain(str(path))}: read back, {written.percent:.0f} % of the cost, felt "
        f"{format_number(written.jnd, 2)} JND"
    )
    if not command:
        return
    period = lean.draft.setting.period
    rate = "" if period == lean.judge.original.setting.period else f" --rate {1 / period:g}"
    out.print(f"next: {plain(command + rate)}")


def _verdict(trial: VariantVerdict) -> str:
    colour = "green" if trial.verdict == MAY_GO else "bright_black"
    loses = f" {plain(trial.loses)}" if trial.verdict == MAY_GO and trial.loses else ""
    return f"[{colour}]{trial.verdict}{loses}[/]"


def _numbers(trial: VariantVerdict) -> list[str]:
    error = trial.error
    if error is None or trial.cost is None:
        return [trial.name, *["-"] * 6]
    return [
        trial.name,
        f"{100 * trial.cost:.0f} %",
        f"{error.jnd:.3f}",
        *(
            format_si(0.0 if value < _ROUNDING else value, unit)
            for value, unit in (
                (error.force_rms, "N"),
                (error.force_peak, "N"),
                (error.torque_rms, "N m"),
            )
        ),
        f"{1e6 * error.position_peak:.0f} µm",
    ]


MAX_NAMED = 4
"""Number of things of a kind that are named; the rest is counted."""

_ALL_NAMED = {"changed"}
"""Kinds of findings that are all printed: one change of a run is not like another."""

_SHOWN = 0.01  # s/s; a stage that takes less of the tick is left out
_GLUE = "\x00"  # in place of a space at which a line is not to end
_WIDTH = 96  # letters of a line of text below a fault


def print_case(case: SceneUnderCheck) -> None:
    """Prints what is checked, and how."""
    extent = 1e3 * np.ptp(case.motion.table[:, 1:4], axis=0)
    size = " x ".join(format_number(edge, 3) for edge in extent)
    sentence, *_ = RunCoupling.of(default_method(), case.period, case.coupling).sentences()
    out.print(f"[bold]{plain(case.scene.name)}[/]  {plain(str(case.source.path))}")
    out.print(
        f"  motion: {plain(case.motion_name)}, {format_number(case.motion.duration, 3)} s, {size} "
        f"mm; coupling: {sentence}, {format_number(1 / case.period)} Hz, {case.contact} contacts"
    )


_CONTACTS = {
    "rigid": "rigid contacts; solref and solimp of the scene give no softness",
    "scene": "contacts of the scene, by its solref and solimp",
}
"""Source of a contact's stiffness, by the kind of contacts."""

_BOUNCES = {"rigid": "as rigid impacts", "scene": "by MuJoCo's springs, as in the file"}
"""Cause of a bounce, by the kind of contacts."""


def _blow_lines(inventory: Inventory, contact: str, tapped: str) -> dict[str, str]:
    """Returns what a blow does in the scene and on the device, by the head of its line."""
    lines = {}
    if inventory.bounces:
        e = max(one.e for one in inventory.bounces)
        back = (
            f"1 m/s comes back as {format_number(e, 2)} m/s, a fall of 100 mm rebounds to "
            f"{format_number(100.0 * e * e, 2)} mm"
            if contact == RIGID
            else "how far depends on the time step, too"
        )
        each = "; ".join(map(str, inventory.bounces))
        lines["bounces"] = f"{each} ({_BOUNCES[contact]}):\n{'':23}{back}"
    if contact == RIGID and inventory.geoms[TOOL]:
        lines["impact pulses"] = f"{tapped} (--impact-pulses 1)"
    return lines


def _tap_of(case: SceneUnderCheck) -> tuple[Tap | None, str]:
    """Returns the tap of the tool and its words; none where the scene names no valid pulse."""
    try:
        tap = case.tap
    except HapticBridgeError as error:
        return None, f"none can be given: {error}"
    return tap, tap_words(tap)


def print_inventory(inventory: Inventory, contact: str, tapped: str) -> None:
    """Prints what the scene models, with the stiffness of the contacts that a run takes.

    ``tapped`` says what a run with pulses answers a tap of the tool with.
    """
    out.print("\n[bold]What it models[/]")
    uses = ", ".join(f"{count} {use}" for use, count in inventory.geoms.items() if count)
    lines = {
        "bodies": f"{inventory.bodies}, {inventory.moving_bodies} of them moving",
        "degrees of freedom": f"{inventory.degrees_of_freedom}, "
        f"{inventory.tool_degrees_of_freedom} of them the tool's ({weight(inventory.tool_mass)})",
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
        least, most = (f"{float(f'{1e-3 * each:.3g}'):,.15g}" for each in inventory.stiffness)
        depth = length(abs(inventory.deepest))
        sank = f"sank in by {depth}" if inventory.deepest >= 0.0 else f"a margin kept {depth} away"
        lines["contact stiffness"] = (
            f"{least} to {most} kN/m at the tool, which {sank} ({_CONTACTS[contact]})"
        )
    lines |= _blow_lines(inventory, contact, tapped)
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
        more = others(len(names) - MAX_NAMED)
        out.print(f"    {reason}: {plain(', '.join(names[:MAX_NAMED]))}{more}")


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
    medians = cost.free.median, cost.contact.median
    for name, times in cost.stages.items():
        # without a tick of the kind both are nan
        if any(t >= _SHOWN * whole for t, whole in zip(times, medians, strict=True)):
            table.add_row(f"    {name}", *map(_micro, times))
    out.print(table)
    for unit, growth in (("contact", cost.by_contacts), ("constraint row", cost.by_rows)):
        if sentence := _growth(growth, unit):
            out.print(f"  {sentence}")
    out.print(
        f"  highest rate: {cost.highest_rate:,.0f} Hz by arithmetic: 99 of 100 ticks leave "
        f"{100 * (1 - TICK_SHARE):g} % of the period to the device and to late wake-ups; what the "
        "machine keeps, 'hapticbridge doctor' measures"
    )


_IN_URDF = (
    "this is a URDF: in it <option> and <compiler> go into <mujoco> in <robot>, mass and inertia "
    "into <inertial> in <link>, and MuJoCo reads other attributes in MJCF alone, which "
    "mujoco.MjSpec.from_file(FILE).to_xml() makes of a URDF that compiles"
)
"""Way to make the changes of a scene that is not written in MJCF."""


def print_faults(findings: tuple[Fault, ...], *, is_urdf: bool) -> None:
    """Prints each fault with its place and the change that mends it, then what is a note."""
    faults = [each for each in findings if not each.is_note]
    notes = [each for each in findings if each.is_note]
    if faults:
        out.print(f"\n[bold]What is wrong[/]: [yellow]{len(faults)} found[/]")
        _print_findings(faults, "write")
    else:
        out.print("\n[bold]What is wrong[/]\n  [green]nothing found[/]")
    if notes:
        out.print("\n[bold]Worth knowing[/]")
        _print_findings(notes, "to change it")
    if findings and is_urdf:
        out.print(plain(_IN_URDF))


def _print_findings(faults: list[Fault], lead: str) -> None:
    """Prints each finding; the lead goes before what to write."""
    seen: Counter[str] = Counter()
    for number, fault in enumerate(faults, 1):
        seen[fault.kind] += 1
        if seen[fault.kind] > MAX_NAMED and fault.kind not in _ALL_NAMED:
            continue
        out.print(f"  {number:>2} [yellow]{plain(fault.kind)}[/]  {plain(str(fault.place))}")
        # what stands in quotes is to be copied: it stays on one line
        whole = re.sub(r'"[^"]*"', lambda quoted: quoted[0].replace(" ", _GLUE), fault.sentence)
        for line in textwrap.wrap(whole, _WIDTH):
            out.print(f"     {plain(line.replace(_GLUE, ' '))}")
        out.print(f"     [green]{lead}:[/] {plain(fault.change)}")
    for kind, count in seen.items():
        if count > MAX_NAMED and kind not in _ALL_NAMED:
            out.print(f"  and {count - MAX_NAMED} more of '{plain(kind)}': --json lists all")


def _micro(seconds: float) -> str:
    return f"{1e6 * seconds:.2f}" if math.isfinite(seconds) else "-"


def _growth(growth: Growth, unit: str) -> str:
    if growth.base is None or growth.per_one is None:
        return ""
    most = growth.steps[-1]
    if not growth.is_measurable:
        return f"does not grow measurably up to {most[0]} {unit}s"
    none = f"{format_si(growth.base, 's')} with none, " if growth.base > 0 else ""  # not a line
    return (
        f"grows by {format_si(growth.per_one, 's')} per {unit}: {none}"
        f"{format_si(most[2], 's')} with {most[0]}"
    )


@dataclass(frozen=True, slots=True)
class Check:
    """Find what is wrong with a scene, and what a tick of it costs.

    Leads the scene through its hand's motion and names every fault with the line to change. Exit
    code 1 if it finds what would let a run fail, 2 if the scene cannot be read, else 0. It does not
    run the scene with its force, so a run may trip where nothing was found. Notes, such as a mass
    that MuJoCo chose or a change that a run makes by itself, do not affect the exit code.

    Example:
        hapticbridge check my_tool.xml --lean --write lean.xml
    """

    FIRST_OPTIONS: ClassVar = (
        "scene",
        "set",
        "grip",
        "motion",
        "contact",
        "plot",
        "lean",
        "budget",
        "write",
        "json",
    )

    scene: str = option(metavar="SCENE", is_positional=True)
    """An MJCF file, or a scene's name (see 'hapticbridge scenes')."""
    settings: tuple[str, ...] = option((), flag="set", metavar="NAME=VALUE", is_repeated=True)
    """Set a parameter of the scene, as often as wanted: --set clearance=0.1e-3."""
    grip: str = shared(Grasp, "grip", "grip")
    motion: Path | None = None
    """Motion of the handle (CSV, recording or bag of poses); by default NAME.csv beside the
    scene, or else the simulated hand's own: slow, 1 cm."""
    rate: float | None = shared(BridgeOptions, "rate", None)
    """Ticks per second; by default 1000, and then a scene with another time step is told so."""
    stiffness: float | None = shared(Coupling, "stiffness", None)
    """Coupling stiffness K in N/m; by default the stiffest that is safe on the simulated device."""
    damping: float | None = shared(Coupling, "damping", None)
    """Coupling damping B in N s/m at the hand."""
    contact: Contact = shared(BridgeOptions, "contact", RIGID)
    """Contacts of the run that the scene is checked for. 'rigid', the default of 'run': settings of
    contacts, limits and equality constraints do not matter. 'scene': those of the MJCF."""
    scale: float = shared(Workspace, "scale")
    workspace: float = option(MAX_WORKSPACE, unit="m", least=0.0, is_open=True)
    """Edge in m of the cube that your device reaches; by default that of the largest table-top
    devices."""
    plot: Path | None = None
    """Draw what the scene costs into this picture (.png, .svg or .pdf)."""
    lean: bool = False
    """Try what could go without being felt: each simplification alone, then greedily together."""
    budget: float | None = None
    """Felt error in just noticeable differences that --lean allows; by default 1."""
    write: Path | None = None
    """Write the leanest scene to this file (.xml), read it back, judge it again; implies --lean."""
    overwrite: bool = False
    """Replace the scene of --write if the file exists."""
    as_json: bool = option(False, flag="json")
    """Print everything as JSON."""

    def execute(self) -> int:
        """Checks and prints; returns the exit code."""
        check_ending(self.plot)
        wants_lean = self.lean or self.write is not None
        if self.budget is not None and not wants_lean:
            raise SceneError("--budget goes with --lean")
        if self.overwrite and self.write is None:
            raise SceneError("--overwrite goes with --write FILE; nothing else is replaced")
        budget = checked_budget(1.0 if self.budget is None else self.budget)
        with compiling(self.scene):
            source = read_scene(self.scene, **settings_from(self.settings))
            try:
                plain_model(source)
            except SceneError as error:
                if refused_body(error) is None:  # else it gets a stand-in
                    raise
        if self.write is not None:
            check_lean_target(source, self.write, overwrite=self.overwrite)
        period = None if self.rate is None else period_of(self.rate)
        with progress("leading it through its motion") as show:
            case = open_case(
                source,
                self.grip,
                IntendedUse(
                    coupling=self._coupling(period or DEFAULT_PERIOD),
                    period=period,
                    scale=self.scale,
                    workspace=self.workspace,
                    contact=self.contact,
                ),
                motion=self.motion,
                progress=show,
            )
        inventory = take_inventory(case.model, self.grip, case.places, case.observation)
        with working("looking for what is wrong"):
            faults, cost = find_faults(case), None
        if case.observation is not None:
            with progress("timing it") as show, quiet():
                cost = measure_cost(case.scene, case.samples, case.setting, progress=show)
            slow = cost.fault(case)
            faults = faults if slow is None else (*faults, slow)
        is_sound = all(fault.is_note for fault in faults)
        if not self.as_json:
            print_case(case)
            print_inventory(inventory, case.contact, _tap_of(case)[1])
            print_cost(cost)
            print_faults(faults, is_urdf=b"<robot" in source.sources[0].data)
            if is_sound:
                out.print(f"next: {plain(self._running(self.scene, self.grip))}")
        lean = self._looked_for(case, budget) if wants_lean else None
        written = None if lean is None else self._print_lean(lean)
        if self.as_json:
            facts = _facts(case, inventory, faults, cost)
            print_json(facts if lean is None else facts | {"lean": lean_facts(lean, written)})
        if self.plot is not None:
            if cost is not None:
                title = f"{case.scene.name}: what a tick costs"
                write_picture(draw_cost(cost, title), self.plot)
            outcome = "wrote" if cost is not None else "there is nothing to draw in"
            err.print(f"{outcome} {plain(str(self.plot))}")
        is_worse = written is not None and written.verdict not in (MAY_GO, SAVES_NOTHING)
        return 1 if not is_sound or is_worse or (wants_lean and lean is None) else 0

    def _running(self, scene: str, grip: str) -> str:
        """Returns the command that runs a scene, with the same motion."""
        grip = "" if grip == "grip" else f" --grip {shlex.quote(grip)}"
        is_table = self.motion is not None and self.motion.suffix == ".csv"
        led = f"{'simulated:path=' if is_table else 'trajectory:'}{self.motion or ''}"
        device = f" --device {shlex.quote(led)}" if self.motion else ""
        return f"hapticbridge run {shlex.quote(scene)}{grip}{device}"

    def _looked_for(self, case: SceneUnderCheck, budget: float) -> Lean | None:
        """Looks for what could go; None, and a sentence, where the scene must be mended first."""
        try:
            with progress("leaner") as show:
                return find_lean(
                    SceneVariant(case.source, case.scene.grip, case.setting),
                    case.motion,
                    budget=budget,
                    device_damping=(case.info.damping or 0.0) / case.scale**2,
                    progress=show,
                )
        except SceneError as error:
            err.print(f"what could go cannot be said: {plain(str(error))}")
            return None

    def _print_lean(self, lean: Lean) -> VariantVerdict | None:
        """Prints and writes what was found; returns the written scene's trial."""
        if not self.as_json:
            print_lean(lean)
        if self.write is None:
            return None
        if not lean.together:
            err.print(f"nothing may go: {plain(str(self.write))} is not written")
            return None
        written = write_lean(lean, self.write, overwrite=self.overwrite)
        command = "" if self.as_json else self._running(str(self.write), lean.draft.grip)
        print_written(lean, written, self.write, command)
        return written

    def _coupling(self, period: float) -> Coupling:
        info = SimulatedDevice().info
        asked = {"stiffness": self.stiffness, "damping": self.damping}
        gains = {name: gain for name, gain in asked.items() if gain is not None}
        return replace(default_coupling(info, period, self.scale, self.scale), **gains)


def _facts(
    case: SceneUnderCheck, inventory: Inventory, faults: tuple[Fault, ...], cost: Cost | None
) -> dict[str, object]:
    return {
        "scene": str(case.source.path),
        "parameters": case.source.parameters,
        "motion": {"name": case.motion_name, "seconds": case.motion.duration},
        "coupling": asdict(case.coupling),
        "period_s": case.period,
        "contact": case.contact,
        "inventory": asdict(inventory),
        "tap": (tap := _tap_of(case)[0]) and asdict(tap),
        "faults": [asdict(fault) | {"is_note": fault.is_note} for fault in faults],
        "cost": None if cost is None else asdict(cost),
    }
