"""``hapticbridge identify``."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from hapticbridge.arguments import option, shared
from hapticbridge.cli.terminal import notify, out, plain, print_json, progress, write_figure
from hapticbridge.cli.zwidth import next_command, rate_for
from hapticbridge.clock import RealClock, SimulatedClock, period_of
from hapticbridge.demand.certificate import default_coupling
from hapticbridge.demand.loop_setting import Lag, delay_ticks
from hapticbridge.demand.methods import RunCoupling, default_method
from hapticbridge.demand.plots import draw_z_width
from hapticbridge.device import AXES, DeviceInfo, open_device
from hapticbridge.device.base import checked
from hapticbridge.device.profile import Profile, own_folder
from hapticbridge.errors import HapticBridgeError, choices
from hapticbridge.files import NO_HOME, writing
from hapticbridge.identify import Identification, identify
from hapticbridge.identify.fit import CONFIDENCE
from hapticbridge.identify.identify import (
    FORCE_SHARE,
    TRAVEL,
    UNHELD,
    delay_of,
    draw_identification,
    duration_at,
    measured_profile,
)
from hapticbridge.kernel.parameters import whole_ticks
from hapticbridge.plotting import check_ending
from hapticbridge.run.options import BridgeOptions
from hapticbridge.signals import interrupting_on_signals
from hapticbridge.theory.z_width import ZWidth, z_width
from hapticbridge.units import format_count, format_number, format_si

REPLACED = {"mass", "damping", "friction", "rotational_inertia", "rotational_damping", "delay"}
"""Numbers of a data sheet in whose place a measurement goes."""


def safe_width(result: Identification) -> ZWidth | None:
    """Returns the couplings that are safe with the lower ends of what was measured."""
    damping = result.of_all("damping", turns=False)
    mass = result.of_all("mass", turns=False)
    friction = result.of_all("friction", turns=False)
    delay = result.of_all("delay", turns=False, most=True)
    if damping is None or mass is None or friction is None or delay is None:
        return None
    if damping.least <= 0.0:
        return None
    period = nominal_period(result)
    return z_width(
        damping.least,
        period,
        mass=mass.least,
        friction=max(friction.least, 0.0),
        resolution=result.resolution or 0.0,
        delay=whole_ticks(delay_of(delay, period), period),
    )


def nominal_period(result: Identification) -> float:
    """Returns T in s of the loop that measured, which its deadlines kept on average."""
    return next(iter(result.runs.values())).period


def measured_sheet(result: Identification, profile: Profile) -> DeviceInfo:
    """Returns the data sheet that a run uses with the profile of what was measured.

    What was measured before, or stated, gives way to it.
    """
    measured: dict[str, Any] = dict.fromkeys({*profile.quantities} & REPLACED)
    return profile.fill(replace(result.info, **measured))


def coupling_of_run(
    result: Identification, profile: Profile, rate: float | None = None
) -> RunCoupling:
    """Returns the coupling that a run chooses by itself with the profile of what was measured."""
    info = measured_sheet(result, profile)
    period = period_of(rate_for(rate, info))
    return RunCoupling.of(default_method(), period, default_coupling(info, period))


def print_result(
    result: Identification,
    z: ZWidth | None,
    coupling: RunCoupling,
    device: str,
    info: DeviceInfo,
    rate: float | None = None,
) -> None:
    """Prints what was measured, how surely, and the coupling to use.

    Args:
        result: What ``identify`` returned.
        z: What ``safe_width`` made of it.
        coupling: What ``coupling_of_run`` returned.
        device: The device as the user named it.
        info: What ``measured_sheet`` returned.
        rate: Rate in Hz that the user chose for the loop; None for the run's own choice.
    """
    for turns, units in ((False, ("kg", "N s/m", "N")), (True, ("kg m²", "N m s/rad", "N m"))):
        names = zip(("mass", "damping", "friction"), units, strict=True)
        headings = [f"{name} ({unit})" for name, unit in names]
        table = Table("axis", *headings, "delay (ms)", box=None, pad_edge=False)
        for axis, fit in result.fits.items():
            if (len(axis) == 2) == turns:
                table.add_row(
                    axis,
                    fit.mass.as_text(),
                    fit.damping.as_text(),
                    fit.friction.as_text(),
                    f"{1e3 * fit.delay.value:.2f} ± {1e3 * fit.delay.half_width:.2f}",
                )
        if table.row_count:
            out.print(table)
    out.print(
        f"period {1e3 * result.period:.4g} ms, spread {format_si(result.period_spread, 's')}, "
        f"one in a thousand longer than {1e3 * result.period_most:.4g} ms"
    )
    if result.resolution is not None:
        step = format_si(result.resolution, "m") if result.resolution else "none seen"
        out.print(f"resolution {step}")
    out.print(f"the interval holds the true value with {CONFIDENCE:.0%}; {UNHELD}")
    for axis, fit in result.fits.items():
        if fit.drag.is_seen:
            unit = "N m s²/rad²" if len(axis) == 2 else "N s²/m²"
            at = f"{fit.drag_speed:.2g} {'rad/s' if len(axis) == 2 else 'm/s'}"
            out.print(
                f"{axis}: resistance also changes with speed squared, {fit.drag.as_text()} {unit}; "
                f"damping is that at {at if fit.drag_speed else 'small speeds'}, the least seen"
            )
    if left := [axis for axis in result.info.axes if axis not in result.fits]:
        out.print(f"not measured: {', '.join(left)}; a profile takes axes of a kind for alike")
    out.print(_sheet_words(info, nominal_period(result)))
    if z is None:
        out.print(why_none(result))
        return
    out.print(
        f"with the lower ends (b = {z.device_damping:.4g} N s/m) the largest safe stiffness "
        f"is {format_number(z.limit[0])} N/m at B_law = 0 "
        f"({z.corner_limited_by}){_with_more_damping(z)}{_if_in_time(info, z.period)}"
    )
    out.print(f"use {coupling.sentences()[0]}")
    requested = coupling.requested
    if requested is not None:
        command = next_command(requested.stiffness, requested.damping, rate)
        out.print(f"next: {plain(f'{command} --device {shlex.quote(device)}')}")


_SHEET = (
    *("mass", "damping", "rotational_inertia", "rotational_damping"),
    *("friction", "resolution", "delay"),
)
"""Numbers of a data sheet that ``identify`` measures."""


def _sheet_words(info: DeviceInfo, period: float) -> str:
    """Returns what a device class states of it, and as how many ticks its delay counts."""
    known = {name: getattr(info, name) for name in _SHEET}
    listed = [f"{name}={each:.6g}" for name, each in known.items() if each is not None]
    listed += ["is_delay_measured=True"] * info.is_delay_measured
    late = delay_ticks(info, period)
    ticks = "" if late is None else f"; the delay counts as {format_count(late, 'tick')}"
    return f"in a class of your own: DeviceInfo({', '.join(listed)}){ticks}"


def _if_in_time(info: DeviceInfo, period: float) -> str:
    """Returns a clause for a device that gives fewer samples than the loop that measured."""
    count = Lag.of(info, period).ticks_per_sample
    return f", if it gave a sample in every tick, not one in {count}" if count > 1 else ""


def _with_more_damping(z: ZWidth) -> str:
    """Returns the largest safe stiffness where the coupling's damper raises it; or nothing.

    Behind a delay the damper lowers what is needed at low frequencies.
    """
    at = int(np.argmax(z.limit))
    if z.limit[at] < 1.01 * z.limit[0]:
        return ""
    return f"; {format_number(z.limit[at])} N/m at B_law = {z.damping[at]:.3g} N s/m"


def why_none(result: Identification) -> str:
    """Returns the reason why no coupling is recommended."""
    if result.of_all("damping", turns=False) is None:
        return "none of x, y, z was measured: the stiffness that the device can show is not known"
    return "damping may be zero: no coupling is safe for any hand"


def facts(
    result: Identification, z: ZWidth | None, coupling: RunCoupling, path: Path | None
) -> dict[str, object]:
    """Returns the facts that ``print_result`` prints, for ``--json``."""
    return {
        "device": result.info.name,
        "axes": {axis: asdict(fit) for axis, fit in result.fits.items()},
        "resolution": result.resolution,
        "period": result.period,
        "period_spread": result.period_spread,
        "period_most": result.period_most,
        "confidence": CONFIDENCE,
        "assumed": UNHELD,
        "largest_stiffness": None if z is None else float(z.limit[0]),
        "coupling": None if z is None else asdict(coupling),
        "profile": None if path is None else str(path),
    }


@dataclass(frozen=True, slots=True)
class Identify:
    """Measure a device's mass, damping, friction, resolution and delay.

    Let go of the device first. Each axis moves by itself for some seconds, with little force and
    travel; Ctrl-C leaves no force. A hand that moves or holds is refused; one that only damps
    cannot be told from the device, and makes its damping too large. The result is a profile, which
    'run' takes by itself for the same unit.

    Example:
        hapticbridge identify simulated:hand=none,damping=1.5,friction=0.1 --plot fit.png
    """

    device: str = option(metavar="DEVICE", is_positional=True)
    """As 'run --device' takes it."""
    axes: tuple[str, ...] = ()
    """Axes to move (x y z rx ry rz); by default all that the device has."""
    duration: float | None = option(None, unit="s", least=2.0, most=600.0)
    """Seconds per axis; by default 12, more below 333 Hz."""
    travel: float = option(TRAVEL[0], unit="m", least=1e-4, most=1.0)
    """Travel to each side in m."""
    turn: float = option(TRAVEL[1], unit="rad", least=1e-3, most=3.0)
    """Turn to each side in rad."""
    force_share: float = option(FORCE_SHARE, least=1e-3, most=1.0)
    """Share of the device's force limit that may be used."""
    rate: float | None = shared(BridgeOptions, "rate")
    """Ticks per second while measuring, by default 1000, and of the loop that is advised."""
    save: Path | None = None
    """Write the profile to this file; by default into the folder of your own profiles, for a real
    device only."""
    plot: Path | None = None
    """Draw the fit into this picture (.png, .svg or .pdf)."""
    zwidth: Path | None = None
    """Draw the stiffness and damping that the device can show into this picture."""
    as_json: bool = option(False, flag="json")
    """Print the result as JSON."""

    def _unheld(self) -> str:
        """Returns the device's specification; the hand of a simulated one lets go, as it must."""
        name, _, rest = self.device.partition(":")
        if name != "simulated" or "hand" in rest:
            return self.device
        notify("the simulated hand lets go of the device, as a person has to (hand=none)")
        return f"simulated:{','.join(filter(None, (rest, 'hand=none')))}"

    def execute(self) -> int:
        """Measures and prints; returns the exit code."""
        check_ending(self.plot)
        check_ending(self.zwidth)
        period = period_of(rate_for(self.rate, None))
        duration = duration_at(period) if self.duration is None else self.duration
        if self.plot is not None and self.plot == self.zwidth:
            raise HapticBridgeError(f"--plot and --zwidth both name '{self.plot}'")
        device = open_device(self._unheld(), notify=notify)
        try:
            axes = self._axes(device.info.axes)
            clock = RealClock() if device.info.is_real else SimulatedClock()
            with interrupting_on_signals(), progress("identifying") as show:
                result = identify(
                    device,
                    clock,
                    period=period,
                    axes=axes,
                    duration=duration,
                    travel=(self.travel, self.turn),
                    force_share=self.force_share,
                    progress=lambda axis, share: show(
                        axes.index(axis) + share, len(axes), f"axis {axis}"
                    ),
                )
        finally:
            checked(device).close()
        z = safe_width(result)
        profile = measured_profile(
            result,
            device=self.device.partition(":")[0],
            serial=device.info.serial,
            date=date.today().isoformat(),
            duration=duration,
            workspace=getattr(device, "workspace", None),
        )
        coupling = coupling_of_run(result, profile, self.rate)
        path = self._place(profile, is_real=device.info.is_real)
        # first, so that a file that cannot be written costs nothing that was measured
        if self.as_json:
            print_json(facts(result, z, coupling, path))
        else:
            sheet = measured_sheet(result, profile)
            print_result(result, z, coupling, self.device, sheet, self.rate)
        if path is not None:
            kept = _write(profile, path)
            notify(f"wrote {path}{kept and f'; the profile that was there is now {kept}'}")
        if self.plot is not None:
            write_figure(draw_identification(result), self.plot)
        if self.zwidth is not None and z is not None:
            write_figure(draw_z_width(z), self.zwidth)
        elif self.zwidth is not None:
            notify(f"'{self.zwidth}' is not drawn: {why_none(result)}")
        return 0

    def _axes(self, present: tuple[str, ...]) -> tuple[str, ...]:
        for axis in self.axes:
            if axis not in present:
                raise HapticBridgeError(f"--axes {axis}: the device has {choices(present)}")
        return tuple(axis for axis in AXES if axis in (self.axes or present))

    def _place(self, profile: Profile, *, is_real: bool) -> Path | None:
        """Returns where the profile goes; None where it is not kept."""
        if self.save is not None or not is_real:
            return self.save
        if (folder := own_folder()) is None:
            notify(f"the profile is not kept: {NO_HOME}, or name a file with --save")
            return None
        return folder / f"{'-'.join(filter(None, (profile.device, profile.serial)))}.toml"


def _write(profile: Profile, path: Path) -> str:
    """Writes a profile; returns where the file that it replaces was moved to, or nothing."""
    former = ""
    with writing(path, HapticBridgeError):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            former = str(path.replace(path.with_name(f"{path.name}.old")))
        path.write_text(profile.to_toml(), encoding="utf-8")
    return former
