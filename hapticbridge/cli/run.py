"""``hapticbridge run``."""

from __future__ import annotations

import json
import math
import shlex
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from hapticbridge.bridge import Bridge
from hapticbridge.certificate import default_coupling, device_conditions
from hapticbridge.cli.terminal import err, out, quantity, tell
from hapticbridge.clock import RealClock, SimulatedClock, period_of
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo, device_for
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.guard import Limits
from hapticbridge.rendering import IMPLICIT, method_named
from hapticbridge.scene import load_scene, settings_from
from hapticbridge.summary import Summary


@dataclass(frozen=True, slots=True)
class Run:
    """Put a scene behind a haptic device and feel it.

    Ctrl-C stops cleanly: zero force first, then the recording is closed. Example:

        hapticbridge run peg_in_hole --duration 8 --record run.mcap
    """

    scene: tyro.conf.Positional[str]
    """An MJCF file, or a scene's name (see 'hapticbridge scenes')."""
    settings: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="set", metavar="NAME=VALUE")
    ] = ()
    """Set a parameter of the scene, as often as wanted: --set clearance=0.1e-3. What there is, with
    unit and range: 'hapticbridge scenes NAME'."""
    grip: str = "grip"
    """Site on the tool that the hand holds."""
    device: str = "simulated"
    """'simulated' (in the hand that the scene asks for), 'simulated:damping=5,hand_mass=1',
    'trajectory:FILE' (CSV or recording), or one that 'hapticbridge devices' lists."""
    duration: float | None = None
    """Seconds to run; by default until the device's motion ends, or until Ctrl-C."""
    record: Path | None = None
    """File to record to (.mcap)."""
    overwrite: bool = False
    """Replace the recording if the file exists."""
    method: str = IMPLICIT.name
    """How the tool is rendered: 'implicit' (the coupling inside MuJoCo's implicit step),
    'compensated' (the same, with the damping that the step adds taken off the coupling's),
    'lossless' (half inside the step, half carried over: second order away from contact),
    'implicitfast' or 'implicitfast:compensated' (the same actuators under that integrator, with K T
    more damping), 'explicit', 'explicit:implicitfast' or 'explicit:rk4' (applied as a force and
    held, under Euler or the integrator named), 'weld' (MuJoCo's weld constraint), 'direct' (a tool
    without mass, no coupling). All but the first three exist to be compared."""
    contact_stiffness: float | None = None
    """Stiffness per contact in N/m of method 'direct'; by default that of the coupling."""
    i_know: bool = False
    """Accept a method that may kick on a real device; the first three need no such word."""
    rate: float = 1000.0
    """Ticks per second."""
    substeps: int = 1
    """MuJoCo steps per tick; with more than one the mean of their wrenches is sent."""
    fast: bool = False
    """Simulated time: as fast as it goes, and the same in every run."""
    stiffness: float | None = None
    """Coupling stiffness K in N/m; by default the stiffest that is safe on the device."""
    damping: float | None = None
    """Coupling damping B in N s/m."""
    rotational_stiffness: float | None = None
    """Rotational coupling stiffness in N m/rad."""
    rotational_damping: float | None = None
    """Rotational coupling damping in N m s/rad."""
    scale: float = 1.0
    """Handle motion per device motion."""
    force_scale: float | None = None
    """Force on the device per force on the tool; by default equal to scale."""
    axes: tuple[float, float, float, float, float, float, float, float, float] | None = None
    """Rotation from the device's axes to the scene's: 9 numbers, row by row."""
    absolute: bool = False
    """Take the device's poses as poses in the scene instead of relative to its start."""
    force_limit: float | None = None
    """Largest force on the device in N; by default the device's own."""
    torque_limit: float | None = None
    """Largest torque on the device in N m; by default the device's own."""
    ramp: float = 0.5
    """Seconds over which the force rises at the start."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the summary as JSON."""

    def execute(self) -> int:
        """Runs the bridge; returns the exit code."""
        if self.duration is not None and not 0 < self.duration < math.inf:
            raise HapticBridgeError(f"duration is {self.duration!r} s; it must be finite and > 0")
        if self.record is not None and self.record.exists() and not self.overwrite:
            raise RecordingError(f"'{self.record}' exists; choose another file or add --overwrite")
        scene = load_scene(self.scene, self.grip, **settings_from(self.settings))
        device = device_for(scene, self.device, tell)
        scales = self.scale, self.scale if self.force_scale is None else self.force_scale
        bridge = Bridge(
            scene,
            device,
            self._coupling(device.info, scales),
            rate=self.rate,
            substeps=self.substeps,
            method=self.method,
            contact_stiffness=self.contact_stiffness,
            i_know=self.i_know,
            recording=self.record,
            clock=SimulatedClock() if self.fast else RealClock(),
            scale=scales[0],
            force_scale=scales[1],
            axes=self.axes,
            absolute=self.absolute,
            limits=Limits(
                force=device.info.force_limit if self.force_limit is None else self.force_limit,
                torque=(
                    device.info.torque_limit if self.torque_limit is None else self.torque_limit
                ),
                ramp=self.ramp,
            ),
            live=not self.as_json,
        )
        if not self.as_json:
            _announce(bridge, scales)
        with ExitStack() as stack:
            with err.status("preparing (the first run on a machine compiles for about 20 s) …"):
                stack.enter_context(bridge)
            if not self.as_json:
                _announce_measured(bridge)
            summary = bridge.run(self.duration)
        if self.as_json:
            values = asdict(summary) | {"verdict": summary.verdict}
            out.print_json(json.dumps(values | {"recording": str(self.record or "") or None}))
        else:
            _print_summary(summary, bridge)
        is_good = summary.verdict == "passive" and summary.is_certified is not False
        return 0 if is_good else 1

    def _coupling(self, info: DeviceInfo, scales: tuple[float, float]) -> Coupling:
        """Returns the default coupling with what the user asked for put in its place."""
        asked = {field.name: getattr(self, field.name) for field in fields(Coupling)}
        given = {name: value for name, value in asked.items() if value is not None}
        method = method_named(self.method)
        laws = method.laws(self.substeps)
        default = default_coupling(info, period_of(self.rate), *scales, laws, method)
        return replace(default, **given)


def _announce(bridge: Bridge, scales: tuple[float, float]) -> None:
    """Says what will be rendered, and whether the device bears it, before any force is on."""
    coupling = bridge.coupling
    err.print(
        f"[bold]{escape(bridge.scene.name)}[/bold] on {escape(bridge.device.info.name)}: "
        f"K = {coupling.stiffness:g} N/m, B = {coupling.damping:g} N s/m, "
        f"K_r = {coupling.rotational_stiffness:g} N m/rad, "
        f"B_r = {coupling.rotational_damping:g} N m s/rad, {1 / bridge.period:g} Hz"
    )
    if bridge.method != IMPLICIT:
        err.print(f"method {bridge.method.name}: {escape(bridge.method.about)}")
        if bridge.method.hazard:
            err.print(f"[yellow]warning:[/yellow] {escape(bridge.method.hazard)}")
    felt = bridge.rendered
    if not (
        math.isclose(felt.damping, coupling.damping)
        and math.isclose(felt.rotational_damping, coupling.rotational_damping)
    ):
        err.print(
            f"[yellow]warning:[/yellow] what is felt is B = {felt.damping:g} N s/m, "
            f"B_r = {felt.rotational_damping:g} N m s/rad: method {bridge.method.name} cannot show "
            "less damping at this stiffness and rate; lower the stiffness or raise the rate"
        )
    if not bridge.method.has_law:
        return  # told when the scene is prepared and the weld measured: ``_announce_measured``
    conditions = device_conditions(
        bridge.device.info, bridge.used, bridge.period, *scales, bridge.laws
    )
    for condition in conditions:
        if not condition.holds:
            err.print(f"[yellow]warning:[/yellow] {condition.sentence()}")


def _announce_measured(bridge: Bridge) -> None:
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


def _print_summary(summary: Summary, bridge: Bridge) -> None:
    laws, is_prescribed = bridge.laws, bridge.device.info.is_prescribed
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_row("ran", f"{summary.duration:.3f} s, {summary.ticks} ticks ({summary.stopped_by})")
    skipped = f" ({summary.skipped} deadlines skipped)" if summary.skipped else ""
    table.add_row("overruns", f"{summary.overruns}{skipped}, records dropped {summary.dropped}")
    table.add_row(
        "peak", f"{quantity(summary.peak_force, 'N')}, {quantity(summary.peak_torque, 'N m')}"
    )
    for name, joules in summary.energies.items():
        if joules:  # a scene without motors or springs has no news of them
            table.add_row(name.replace("_", " "), quantity(joules, "J"))
    out.print(table)
    used = f", {summary.slack_share:.0%} of the slack used" if summary.slack_share else ""
    out.print(f"environment [bold]{summary.verdict}[/bold] ({summary.environment}{used})")
    if summary.fault is not None:
        tick, port = summary.fault
        out.print(f"from tick {tick} on, at port {port}")
    if summary.method != IMPLICIT.name:
        out.print(f"method {escape(summary.method)}: {escape(summary.about)}")
    if summary.felt is not None:
        out.print(_true_weld(summary.felt, summary.coupling))
    if summary.is_certified is None and summary.conditions:
        for sentence in summary.conditions:
            out.print(escape(sentence))
        out.print("nothing proves that the device bears this")
    else:
        bound = "KT/2 + B" if laws == 1 else f"what {laws} substeps need"
        certified = {
            True: f"device certified: b >= {bound}",
            False: f"device not certified: b < {bound}",
            None: f"device unknown: b >= {bound} not checked",
        }
        unfelt = "the device feels no force: there is nothing to certify"
        out.print(unfelt if is_prescribed else certified[summary.is_certified])
    if summary.is_certified is False and method_named(summary.method).has_law and laws == 1:
        judge = "the audit judges" if summary.recording else "with --record FILE the audit judges"
        out.print(f"the device's port is not proven, nor metered while it runs: {judge} it")
    if summary.recording is not None:
        out.print(f"next: hapticbridge audit {escape(shlex.quote(str(summary.recording)))}")
