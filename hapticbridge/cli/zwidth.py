"""``hapticbridge zwidth`` and ``hapticbridge bound``."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from rich.table import Table

from hapticbridge.arguments import Arguments, option, shared
from hapticbridge.cli.terminal import err, notify, out, plain, print_json, progress, write_figure
from hapticbridge.clock import RealClock, SimulatedClock, period_of
from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import (
    IF_AT_ONCE,
    DampingCondition,
    conditions_of,
    default_coupling,
)
from hapticbridge.demand.loop_setting import IN_TIME, Lag, LoopSetting, delay_ticks, pulling_loop
from hapticbridge.demand.methods import RunCoupling, default_method
from hapticbridge.demand.plots import (
    Alternative,
    alternatives,
    draw_alternatives,
    draw_z_width,
    recommended,
    recommended_coupling,
)
from hapticbridge.device import AXES, Device, DeviceInfo, open_device
from hapticbridge.device.base import USUAL_FORCE_LIMIT, checked
from hapticbridge.errors import HapticBridgeError, choices
from hapticbridge.identify.z_width import SHARES, MeasuredWidth, measure_width, measured_points
from hapticbridge.kernel.parameters import whole_ticks
from hapticbridge.plotting import check_ending
from hapticbridge.run.options import BridgeOptions
from hapticbridge.signals import interrupting_on_signals
from hapticbridge.theory.bounds import (
    NEEDED_SHARE,
    STIFFNESS_MARGIN,
    largest_effective_damping,
    law_damping,
)
from hapticbridge.theory.transfer import MAX_DELAY
from hapticbridge.theory.z_width import ZWidth, z_width
from hapticbridge.units import format_count, format_number, format_si

_ARGUMENTS = Arguments(HapticBridgeError)


def next_command(stiffness: float, damping: float, rate: float | None) -> str:
    """Returns the command that runs a scene with this coupling, at the rate if one was chosen."""
    command = f"hapticbridge run SCENE --stiffness {stiffness:.6g} --damping {damping:.6g}"
    return command if rate is None else f"{command} --rate {rate:.6g}"


def rate_for(rate: float | None, info: DeviceInfo | None) -> float:
    """Returns the rate in Hz that was chosen, or the one at which a run has the device."""
    options = BridgeOptions(rate=rate)
    return (options if info is None else options.for_devices([info])).loop_rate


@dataclass(frozen=True, slots=True)
class Zwidth:
    """Compute the stiffness and damping that a device can show.

    Every limit is named, with the command that uses the recommended coupling. With --measure the
    limits are also tried on a device, and drawn beside the lines.

    Examples:
        hapticbridge zwidth --damping 2 --mass 0.1 --friction 0.05 --resolution 1e-5 --plot out.png
        hapticbridge zwidth --measure simulated:hand=none --plot out.png
    """

    damping: float | None = shared(DeviceInfo, "damping")
    """Physical damping b of the device in N s/m; with --measure by default what is known of it."""
    measure: str | None = None
    """Try walls of rising stiffness on this device, as 'run --device' takes it, until its swing no
    longer dies down. Hold it as in use, or not at all; it is pushed with up to half its force."""
    axis: str | None = None
    """Axis that --measure moves: x, y or z; by default x."""
    mass: float | None = shared(DeviceInfo, "mass")
    """Mass of the device in kg; with it the limit without a hand is drawn too."""
    friction: float | None = shared(DeviceInfo, "friction")
    """Coulomb friction of the device in N."""
    resolution: float | None = shared(DeviceInfo, "resolution")
    """Step of the device's position in m; by default exact."""
    rate: float | None = shared(BridgeOptions, "rate")
    delay: float = 0.0
    """Time in s from position to force, beyond the hold; it counts as whole ticks."""
    filter_time: float = option(0.0, unit="s", least=0.0)
    """Time constant in s of a first-order low-pass behind the coupling's damper."""
    plot: Path | None = None
    """Draw the region into this picture (.png, .svg or .pdf)."""
    as_json: bool = option(False, flag="json")
    """Print the lines, the limit and the corner as JSON."""

    def execute(self) -> int:
        """Computes and prints; returns the exit code."""
        check_ending(self.plot)
        if self.axis is not None and self.measure is None:
            raise HapticBridgeError("--axis goes with --measure DEVICE")
        axis = self.axis or "x"
        device = None if self.measure is None else self._opened(self.measure, axis)
        info = None if device is None else device.info
        try:
            with err.status("computing …"):
                z = self._computed(period_of(rate_for(self.rate, info)), info)
            measured = None
            if device is not None:
                clock = RealClock() if device.info.is_real else SimulatedClock()
                if device.info.is_real:
                    notify(
                        f"about 15 walls at each of {len(SHARES)} dampings are tried: 2 to 3 "
                        "minutes, longer at a slow swing"
                    )
                with interrupting_on_signals(), progress("measuring") as show:
                    measured = measure_width(device, clock, z, axis=axis, progress=show)
        finally:
            if device is not None:
                checked(device).close()
        # the run command has no low-pass to offer, and without it this corner is not passive
        coupling = recommended(z)
        command = next_command(coupling.stiffness, coupling.damping, self.rate)
        if self.measure is not None:
            command += f" --device {shlex.quote(self.measure)}"
        next_step = None if z.filter_time else command
        if self.as_json:
            print_json(_z_width_facts(z, next_step) | _measured_facts(measured))
        else:
            _print_z_width(z, next_step)
            if measured is not None:
                _print_measured(measured)
        if self.plot is not None:
            points = None if measured is None else measured_points(measured)
            write_figure(draw_z_width(z, points), self.plot)
        return 0

    def _opened(self, spec: str, axis: str) -> Device:
        if self.filter_time or self.delay:
            raise HapticBridgeError(
                "--measure tries walls without low-pass or further delay: leave --filter-time and "
                "--delay out"
            )
        device = open_device(spec, notify=notify)
        here = [name for name in AXES[:3] if name in device.info.axes]
        if device.info.is_prescribed or axis not in here:
            checked(device).close()
            if device.info.is_prescribed or not here:
                raise HapticBridgeError(
                    f"--measure {spec}: no force moves this device along x, y or z, so it has no "
                    "walls to try"
                )
            raise HapticBridgeError(
                f"--axis {axis}: the device moves by force along {choices(here)}"
            )
        return device

    def _computed(self, period: float, info: DeviceInfo | None) -> ZWidth:
        """Computes the lines from what was given, else from what is known of the device."""
        numbers = {
            name: getattr(self, name) for name in ("damping", "mass", "friction", "resolution")
        }
        delay = whole_ticks(
            _ARGUMENTS.number("--delay", self.delay, "s", least=0, most=MAX_DELAY * period), period
        )
        if delay:
            ticks = format_count(delay, "tick")
            notify(f"a delay of {format_si(self.delay, 's')} counts as {ticks}")
        if info is not None:
            numbers = {
                name: getattr(info, name) if value is None else value
                for name, value in numbers.items()
            }
            delay = delay_ticks(info, period) or 0
            if (count := Lag.of(info, period).ticks_per_sample) > 1:
                notify(
                    f"the lines hold for a sample in every tick; this device gives one in {count}: "
                    "--rate lowers the loop's, and 'hapticbridge bound --device' counts it"
                )
        if numbers["damping"] is None:
            missing = "the device's is unknown" if info else "it is missing"
            raise HapticBridgeError(
                f"zwidth needs --damping, and {missing}; 'hapticbridge identify' measures it"
            )
        return z_width(
            numbers["damping"],
            period,
            mass=numbers["mass"],
            friction=numbers["friction"],
            resolution=numbers["resolution"] or 0.0,
            delay=delay,
            filter_time=self.filter_time,
        )


def _z_width_facts(z: ZWidth, command: str | None) -> dict[str, object]:
    return {
        "lines": [
            {
                "name": line.name,
                "reason": line.reason,
                "required": line.is_required,
                "largest_damping": line.largest_damping,
                "stiffness": line.stiffness.tolist(),
            }
            for line in z.lines
        ],
        "damping": z.damping.tolist(),
        "limit": z.limit.tolist(),
        "limited_by": list(z.limited_by),
        "corner": {
            **asdict(recommended_coupling(z)),
            "method": default_method().name,
            "limited_by": z.corner_limited_by,
        },
        "notes": list(z.notes),
        "next": command,
    }


def _print_z_width(z: ZWidth, command: str | None) -> None:
    table = Table("line", "K at B_law = 0", "B_law at K = 0", "because", box=None, pad_edge=False)
    for line in z.lines:
        stiffness = f"{line.stiffness[0]:.5g} N/m"
        reason = line.reason if line.is_required else f"not kept: {line.reason}"
        table.add_row(line.name, stiffness, f"{line.largest_damping:.4g} N s/m", reason)
    out.print(table)
    reasons = {line.name: line.reason for line in z.lines}
    out.print(f"limited by: {z.corner_limited_by} ({reasons[z.corner_limited_by]})")
    for note in z.notes:
        out.print(f"note: {note}")
    (sentence,) = recommended_coupling(z).sentences()
    at, safe = z.corner.damping, z.corner.stiffness / STIFFNESS_MARGIN
    of = f": 80 % of the {format_number(safe)} N/m that are safe at B_law = {at:.3g} N s/m"
    if z.delay:
        of = f": it needs at most {NEEDED_SHARE:.0%} of b, in every scene"
    out.print(f"use {sentence}{of}")
    own_loop = f"--device-damping {z.device_damping:g} --loop-rate HZ --loop-delay SECONDS"
    out.print(
        f"a faster loop on the device's own board bears more: 'hapticbridge bound {own_loop}'"
    )
    if command is None:
        out.print(
            "'hapticbridge run' has no low-pass: leave --filter-time out for a run's coupling"
        )
    else:
        out.print(f"next: {plain(command)}")


def _measured_facts(measured: MeasuredWidth | None) -> dict[str, object]:
    if measured is None:
        return {}
    return {
        "measured": [
            {
                "damping": limit.damping,
                "borne": limit.borne,
                "not_borne": limit.not_borne,
                "predicted": predicted,
                "trials": [asdict(trial) for trial in limit.trials],
            }
            for limit, predicted in zip(measured.limits, measured.predicted, strict=True)
        ]
    }


def _print_measured(measured: MeasuredWidth) -> None:
    """Prints what was borne beside what theory says."""
    headings = ["B_law", "borne to K", "not borne from K", "safe by theory"]
    table = Table(*headings, "without a hand", box=None, pad_edge=False)
    unheld = measured.unheld or (None,) * len(measured.limits)
    for limit, safe, free in zip(measured.limits, measured.predicted, unheld, strict=True):
        table.add_row(
            f"{limit.damping:.3g} N s/m",
            f"{format_number(limit.borne)} N/m",
            "not found" if limit.not_borne is None else f"{format_number(limit.not_borne)} N/m",
            f"{format_number(safe)} N/m",
            "mass unknown" if free is None else f"{format_number(free)} N/m",
        )
    out.print("measured on the device, as it was held:")
    out.print(table)
    low = [
        limit.damping
        for limit, safe in zip(measured.limits, measured.predicted, strict=True)
        if limit.not_borne is not None and limit.not_borne < safe
    ]
    if low:
        out.print(
            f"[yellow]at B_law = {low[0]:.3g} N s/m it bears less than theory allows:[/yellow] its "
            "damping is less than was given, or it answers later; run 'hapticbridge identify'"
        )


_COUNTED = "--friction with --resolution counts them"


@dataclass(frozen=True, slots=True)
class Bound:
    """Compute the device damping that a coupling needs.

    Without --stiffness it is the coupling that 'run' chooses for the device, or for the numbers in
    its place. Alternative laws are listed beside it. K and B are the requested ones; the law of the
    default method uses B - KT/2, at least 0. Exit code 1 if --device or --device-damping does not
    suffice, 0 if it does, or if it cannot be judged because the device's delay is unknown.

    Examples:
        hapticbridge bound --stiffness 2000 --damping 1 --rate 1000
        hapticbridge bound --stiffness 2000 --damping 1 --device simulated:damping=3
        hapticbridge bound --device-damping 2 --friction 0.1 --resolution 1e-5
        hapticbridge bound --device-damping 2 --loop-rate 1e4 --loop-delay 1e-5
    """

    stiffness: float | None = shared(Coupling, "stiffness", None)
    """Coupling stiffness K in N/m; by default what 'run' chooses for the device."""
    damping: float = shared(Coupling, "damping", 0.0)
    """Requested damping B of the coupling in N s/m."""
    rate: float | None = shared(BridgeOptions, "rate")
    filter_time: float | None = option(None, unit="s", least=0.0)
    """Time constant in s of the low-pass among the alternatives; by default one period."""
    device: str | None = None
    """Device, as 'run --device' takes it: do its damping, delay and rate suffice? They come from
    its driver or its profile ('hapticbridge identify' writes one). It is opened, and not moved."""
    device_damping: float | None = option(None, unit="N s/m", least=0.0, is_open=True)
    """Physical damping b in N s/m of a device without delay, in place of --device."""
    friction: float | None = shared(DeviceInfo, "friction")
    """Coulomb friction in N of a device with --device-damping; it holds the encoder's steps."""
    resolution: float | None = shared(DeviceInfo, "resolution")
    """Step in m of that device's position; 0 if it has none, by default not counted."""
    loop_rate: float | None = option(None, unit="Hz", least=0.0, is_open=True)
    """Rate of a loop on the device's own board, which then renders the coupling."""
    loop_delay: float | None = option(None, unit="s", least=0.0, is_open=True)
    """Time in s in that loop from reading a position to its force."""
    plot: Path | None = None
    """Draw the damping needed over frequency into this picture (.png, .svg or .pdf)."""
    as_json: bool = option(False, flag="json")
    """Print it as JSON; null where no damping suffices."""

    def execute(self) -> int:
        """Computes and prints; returns the exit code."""
        check_ending(self.plot)
        info = self._info()
        rate = rate_for(self.rate, info)
        period = period_of(rate)
        coupling = self._coupling(info, period)
        if info is not None and info.loop_period is not None:
            return self._judge_own_loop(info, coupling, period)
        filter_time = period if self.filter_time is None else self.filter_time
        ways = alternatives(coupling, period, filter_time)
        shown = RunCoupling.of(default_method(), period, coupling)
        condition = None
        if info is not None and not self._has_open_steps:
            condition = _condition(info, coupling, period)
        b = info.damping if info is not None and _is_prompt(info, period) else None
        holds = None if b is None else b >= ways[0].needed
        if condition is not None:
            holds = condition.holds
        if self.as_json:
            facts = _facts(shown, ways, condition, info)
            largest = _largest_stiffness(b, coupling, period)
            print_json(facts | {"holds": holds, "largest_stiffness": largest})
        else:
            self._print(ways, coupling, period, b, info, condition)
            if condition is not None and (b is None or condition.steps is not None):
                out.print(plain(condition.sentence()))
        if self.plot is not None:
            gains = f"K = {coupling.stiffness:g} N/m, B = {coupling.damping:g} N s/m"
            title = f"{gains} at {rate:g} Hz"
            write_figure(draw_alternatives(ways, title, b), self.plot)
        return 1 if holds is False else 0

    def _judge_own_loop(self, info: DeviceInfo, coupling: Coupling, period: float) -> int:
        """Prints the condition in a loop of the device's own, with T of the run in s."""
        if self.plot is not None or self.filter_time is not None:
            raise HapticBridgeError(
                "--plot and --filter-time are for a loop on the computer: leave them out with a "
                "loop of the device's own"
            )
        shown = RunCoupling.of(default_method(), period, coupling)
        shown = shown.felt_at("", 1.0, 1.0, is_apart=True)
        condition = _condition(info, coupling, period)
        if self.as_json:
            facts = _facts(shown, (), condition, info)
            print_json(facts | {"holds": condition.holds, "largest_stiffness": None})
        else:
            (sentence,) = shown.sentences()
            out.print(sentence)
            out.print(plain(condition.sentence()))
            if self._has_open_steps:
                out.print(f"not judged are the encoder's steps: {_COUNTED}")
        return 1 if condition.holds is False else 0

    def _coupling(self, info: DeviceInfo | None, period: float) -> Coupling:
        """Returns the given coupling, or the one that a run chooses for the device.

        Raises:
            HapticBridgeError: Neither a stiffness nor a device is given, or a damping alone.
        """
        if self.stiffness is not None:
            return Coupling(self.stiffness, self.damping, 0.0, 0.0)
        if info is None or self.damping:
            raise HapticBridgeError(
                "bound needs --stiffness, or --device or --device-damping without --damping for "
                "the stiffest coupling that a device bears"
            )
        chosen = default_coupling(info, period)
        if not self.as_json:
            out.print("as 'hapticbridge run' chooses it:")
        return replace(chosen, rotational_stiffness=0.0, rotational_damping=0.0)

    @property
    def _has_open_steps(self) -> bool:
        """True if the numbers of a device leave out what its encoder's steps need."""
        is_open = self.resolution is None or (self.friction is None and self.resolution > 0.0)
        return self.device_damping is not None and is_open

    def _info(self) -> DeviceInfo | None:
        """Returns the device's data sheet, with its profile and its loop; None if none is named.

        Raises:
            HapticBridgeError: Options exclude each other, or a number that is needed is missing.
        """
        info = self._known_info()
        if self.loop_rate is None:
            if self.loop_delay is not None:
                raise HapticBridgeError("--loop-delay without --loop-rate HZ has no effect")
            return info
        if self.loop_delay is None:
            raise HapticBridgeError(
                "--loop-rate needs --loop-delay, the time in s from reading a position to its force"
            )
        if info is None:
            raise HapticBridgeError("--loop-rate goes with --device or --device-damping")
        if info.loop_period is not None:
            raise HapticBridgeError(
                f"--device {self.device} has a loop of its own: leave --loop-rate out"
            )
        return replace(info, loop_period=1.0 / self.loop_rate, loop_delay=self.loop_delay)

    def _known_info(self) -> DeviceInfo | None:
        """Returns the data sheet of the opened device, or of the numbers in its place."""
        if self.device_damping is None:
            if (self.friction, self.resolution) != (None, None):
                raise HapticBridgeError("--friction and --resolution go with --device-damping")
        elif self.device is not None:
            raise HapticBridgeError("--device has a damping of its own: leave --device-damping out")
        else:
            return DeviceInfo(
                name="device",
                axes=AXES[:1],
                damping=self.device_damping,
                friction=self.friction,
                resolution=self.resolution,
                force_limit=USUAL_FORCE_LIMIT,
                delay=0.0,
                is_delay_measured=True,
            )
        if self.device is None:
            return None
        device = open_device(self.device, notify=notify)
        checked(device).close()
        info = device.info
        if info.is_prescribed or not info.moves:
            raise HapticBridgeError(
                f"--device {self.device}: no force moves it along x, y or z, so it needs no damping"
            )
        if info.damping is None:
            raise HapticBridgeError(
                f"--device {self.device}: its damping is unknown; 'hapticbridge identify' measures "
                "it, or give --device-damping"
            )
        return info

    def _print(
        self,
        ways: tuple[Alternative, ...],
        coupling: Coupling,
        period: float,
        b: float | None,
        info: DeviceInfo | None,
        condition: DampingCondition | None,
    ) -> None:
        method = default_method()
        (sentence,) = RunCoupling.of(method, period, coupling).sentences()
        needs = "" if b is None and self.device else "; the device needs b >= KT/2 + B_law"
        out.print(f"{sentence}{needs}")
        table = Table("", "damping needed", "most at", box=None, pad_edge=False)
        if b is not None:
            table.add_column("holds")
        for way in ways:
            amount = f"{way.needed:.4g} N s/m" if math.isfinite(way.needed) else "none suffices"
            verdict = [] if b is None else ["yes" if b >= way.needed else "no"]
            table.add_row(way.name, amount, _where(way), *verdict)
        out.print(table)
        least = method.compensated_share * coupling.stiffness * period
        if self.device is None:
            out.print(
                "a delay of the device is not in it: --device counts it, and 'zwidth --delay' has "
                "the couplings that it allows"
            )
        if coupling.damping < least:
            out.print(
                f"method {method.name} cannot show less than B = {least:.4g} N s/m at this "
                "stiffness and rate"
            )
        if b is None:
            return
        needed = ways[0].needed
        if b >= needed:
            limit = "" if condition is None else condition.clause
            if self._has_open_steps:
                limit += f", if its friction holds the encoder's steps: {_COUNTED}"
            if has_steps := condition is not None and condition.holds is False:
                limit += " but for its encoder's steps"
            out.print(f"device damping {b:g} >= {needed:g} N s/m: passive in any hand{limit}")
            if has_steps:
                return
            at_once = f"{IF_AT_ONCE}, " if condition is not None and condition.clause else ""
            out.print(
                f"{at_once}method {method.name} needs the larger of KT/2 and B: any K up to "
                f"{2 * b / period:g} N/m beside any B up to {b:g} N s/m"
            )
            command = next_command(coupling.stiffness, max(coupling.damping, least), self.rate)
            if self.device is not None:
                command += f" --device {shlex.quote(self.device)}"
            out.print(f"next: {plain(command)}")
            return
        out.print(f"device damping {b:g} < {needed:g} N s/m: [red]not passive in any hand[/]")
        _print_remedies(coupling, b, needed, period, (info and info.rate) or math.inf)


def _largest_stiffness(b: float | None, coupling: Coupling, period: float) -> float | None:
    """Returns the largest K that a device bears; None without a device, 0 if none."""
    if b is None:
        return None
    return 2 * b / period if coupling.damping <= b else 0.0


def _print_remedies(
    coupling: Coupling, b: float, needed: float, period: float, max_rate: float
) -> None:
    lag, changes, damper = default_method().compensated_share, [], ""
    b *= NEEDED_SHARE
    needed /= NEEDED_SHARE
    if law_damping(coupling.stiffness, coupling.damping, period, lag) > 0:
        stiffness = min(coupling.stiffness, 2 * b / period)
        most = largest_effective_damping(b, stiffness, period, lag)
        damper = f"lower the damping to {most:.4g} N s/m"
    if coupling.stiffness * period > 2 * b:
        changes.append(f"lower the stiffness to {format_number(2 * b / period)} N/m")
        if (rate := coupling.stiffness / (2 * b)) <= max_rate:
            changes.append(f"raise the rate to {format_number(rate)} Hz")
    out.print("with 15 % in reserve:")
    if damper and changes:
        out.print(f"  {damper}, and {' or '.join(changes)}, or")
    else:
        for change in filter(None, (damper, *changes)):
            out.print(f"  {change}, or")
    out.print(f"  take a device with {needed:.4g} N s/m")


def _condition(info: DeviceInfo, coupling: Coupling, period: float) -> DampingCondition:
    """Returns the condition for translation that a run with scale 1 would print."""
    method = default_method()
    law = method.law_coupling(coupling, period)
    own, own_period = pulling_loop(info, period)
    loop = LoopSetting(info=own, law=law, period=own_period, method=method, timestep=period)
    conditions = conditions_of(loop)
    return next(condition for condition in conditions if condition.axis == "translation")


def _is_prompt(info: DeviceInfo, period: float) -> bool:
    """Returns True if neither a delay nor a rate of its own makes a device need more damping."""
    return bool(info.damping and info.delay is not None and Lag.of(info, period) == IN_TIME)


def _facts(
    shown: RunCoupling,
    ways: Sequence[Alternative],
    condition: DampingCondition | None,
    info: DeviceInfo | None,
) -> dict[str, object]:
    """Returns what is printed as JSON of a coupling and its alternatives."""
    return {
        "needed": ways[0].needed if condition is None else condition.needed,
        "frequency_hz": _hertz(ways[0]) if ways else None,
        "method": default_method().name,
        "coupling": asdict(shown),
        "device": None if info is None else _device_facts(info, condition),
        "alternatives": [
            {"name": way.name, "needed": way.needed, "frequency_hz": _hertz(way)} for way in ways
        ],
    }


def _device_facts(info: DeviceInfo, condition: DampingCondition | None) -> dict[str, object]:
    needed = None if condition is None else condition.needed
    names = "damping", "mass", "delay", "rate", "loop_period", "loop_delay"
    numbers = {name: getattr(info, name) for name in names}
    return {"name": info.name, **numbers, "needed": needed}


def _hertz(way: Alternative) -> float | None:
    return None if way.frequency is None else way.frequency / (2 * math.pi)


def _where(way: Alternative) -> str:
    if (hertz := _hertz(way)) is None:
        return "every frequency" if math.isfinite(way.needed) else "-"
    return f"{format_number(hertz)} Hz" if hertz else "low frequency"
