"""How ``hapticbridge run`` says what it will do, and what it did."""

from __future__ import annotations

import math
import shlex

from rich.markup import escape
from rich.table import Table

from hapticbridge.bridge import Bridge
from hapticbridge.certificate import device_conditions
from hapticbridge.cli.terminal import err, out
from hapticbridge.coupling import Coupling
from hapticbridge.felt import coupling_sentences, is_always_held
from hapticbridge.quantity import quantity
from hapticbridge.rendering import default_method, method_named
from hapticbridge.summary import Summary


def announce(
    bridge: Bridge, scales: tuple[float, float], substeps: int, *, is_method_asked: bool
) -> None:
    """Says what will be rendered, and whether the device bears it, before any force is on.

    Args:
        bridge: Not yet open.
        scales: Handle motion per device motion, force on the device per force on the tool.
        substeps: MuJoCo steps per tick.
        is_method_asked: Whether the user chose the method.
    """
    coupling, method = bridge.coupling, bridge.method
    scene, device = escape(bridge.scene.name), escape(bridge.device.info.name)
    err.print(f"[bold]{scene}[/bold] on {device}, {1 / bridge.period:g} Hz, method {method.name}")
    held = is_always_held(bridge.scene.model, bridge.scene.grip)
    for sentence in coupling_sentences(
        bridge.used, method, bridge.period, substeps, is_always_held=held
    ):
        err.print(f"  {sentence}")
    if not method.has_law:
        err.print(
            f"  asked for: K = {coupling.stiffness:g} N/m, B = {coupling.damping:g} N s/m, "
            f"K_r = {coupling.rotational_stiffness:g} N m/rad, "
            f"B_r = {coupling.rotational_damping:g} N m s/rad"
        )
    usual = default_method()
    if is_method_asked and method != usual:
        err.print(f"  {method.name}: {escape(method.about)}")
    elif method != usual:
        err.print(
            f"  {method.name}, because {usual.name} takes one MuJoCo step a tick, and {substeps} "
            "are asked for"
        )
    if method.hazard:
        err.print(f"[yellow]warning:[/yellow] {escape(method.hazard)}")
    least = bridge.rendered
    if not (
        math.isclose(least.damping, coupling.damping)
        and math.isclose(least.rotational_damping, coupling.rotational_damping)
    ):
        err.print(
            f"[yellow]warning:[/yellow] asked for B = {coupling.damping:g} N s/m, B_r = "
            f"{coupling.rotational_damping:g} N m s/rad: less than method {method.name} can show "
            "at this stiffness and rate; lower the stiffness or raise the rate"
        )
    if bridge.reach < math.inf:
        err.print(
            f"  {quantity(bridge.reach, 'm')} from its middle the device is at the end of its "
            "reach: beyond, it moves without the handle and without force"
        )
    if not method.has_law:
        return  # told when the scene is prepared and the weld measured: ``announce_measured``
    conditions = device_conditions(
        bridge.device.info, bridge.used, bridge.period, *scales, bridge.laws, method
    )
    for condition in conditions:
        if not condition.holds:
            err.print(f"[yellow]warning:[/yellow] {condition.sentence()}")


def announce_measured(bridge: Bridge) -> None:
    """Says what the device must bear where no coupling law tells it, before any force is on."""
    if bridge.method.has_law:
        return
    felt = bridge.parameters.felt
    if felt is not None:
        err.print(_true_weld(felt, bridge.coupling))
    for sentence in bridge.conditions():
        err.print(f"[yellow]warning:[/yellow] {escape(sentence)}")


def _true_weld(felt: Coupling, asked: Coupling) -> str:
    return (
        f"the weld is {felt.stiffness:.4g} N/m, {felt.damping:.4g} N s/m, "
        f"{felt.rotational_stiffness:.4g} N m/rad, {felt.rotational_damping:.4g} N m s/rad in its "
        f"stiffest directions at the start; asked for: {asked.stiffness:.4g}, {asked.damping:.4g}, "
        f"{asked.rotational_stiffness:.4g}, {asked.rotational_damping:.4g}"
    )


def print_summary(summary: Summary, laws: int, *, is_felt: bool = True) -> None:
    """Prints what a run was, whether the device bears it, and what to do next.

    Args:
        summary: Of the run.
        laws: How often per tick the wrench was computed.
        is_felt: Whether the device moves by force at all.
    """
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_row("ran", f"{summary.duration:.3f} s, {summary.ticks} ticks ({summary.stopped_by})")
    skipped = f" ({summary.skipped} deadlines skipped)" if summary.skipped else ""
    table.add_row("overruns", f"{summary.overruns}{skipped}, records dropped {summary.dropped}")
    table.add_row(
        "peak", f"{quantity(summary.peak_force, 'N')}, {quantity(summary.peak_torque, 'N m')}"
    )
    if summary.reach is not None:
        table.add_row("reach", f"{quantity(summary.reach, 'm')}; beyond, no handle and no force")
    for name, joules in summary.energies.items():
        if joules:  # a scene without motors or springs has no news of them
            table.add_row(name.replace("_", " "), quantity(joules, "J"))
    out.print(table)
    used = f", {summary.slack_share:.0%} of the slack used" if summary.slack_share else ""
    out.print(f"environment [bold]{summary.verdict}[/bold] ({summary.environment}{used})")
    if summary.fault is not None:
        tick, port = summary.fault
        out.print(f"from tick {tick} on, at port {port}")
    if summary.method != default_method().name:
        out.print(f"method {escape(summary.method)}: {escape(summary.about)}")
    if summary.felt is not None:
        out.print(_true_weld(summary.felt, summary.coupling))
    if summary.is_certified is None and summary.conditions:
        for sentence in summary.conditions:
            out.print(escape(sentence))
        out.print("nothing proves that the device bears this")
    else:
        for sentence in summary.rendered[:1]:
            out.print(sentence)
        bound = "KT/2 + B'" if laws == 1 else f"what {laws} substeps need"
        certified = {
            True: f"device certified: b >= {bound}",
            False: f"device not certified: b < {bound}",
            None: f"device unknown: b >= {bound} not checked",
        }
        unfelt = "the device feels no force: there is nothing to certify"
        out.print(certified[summary.is_certified] if is_felt else unfelt)
    if summary.is_certified is False and method_named(summary.method).has_law and laws == 1:
        judge = "the audit judges" if summary.recording else "with --record FILE the audit judges"
        out.print(f"the device's port is not proven, nor metered while it runs: {judge} it")
    if summary.recording is not None:
        out.print(f"next: hapticbridge audit {escape(shlex.quote(str(summary.recording)))}")
