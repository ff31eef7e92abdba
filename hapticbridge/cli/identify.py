"""``hapticbridge identify``."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated

import tyro

from hapticbridge.cli.identify_words import facts, print_result, safe_width, why_none
from hapticbridge.cli.terminal import (
    print_json,
    progress,
    tell,
    write_figure,
)
from hapticbridge.clock import RealClock, SimulatedClock, period_of
from hapticbridge.device import AXES, open_device
from hapticbridge.device.profile import Profile
from hapticbridge.device.profile_search import own_folder
from hapticbridge.errors import HapticBridgeError, choices
from hapticbridge.identify import identify
from hapticbridge.identify.identification import (
    FORCE_SHARE,
    TRAVEL,
    duration_at,
)
from hapticbridge.identify.measured_profile import measured_profile
from hapticbridge.identify.picture import draw_identification
from hapticbridge.picture import check_ending
from hapticbridge.signals import interrupting_on_signals
from hapticbridge.theory_plots import draw_z_width


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

    device: tyro.conf.Positional[str]
    """As 'run --device' takes it."""
    axes: tuple[str, ...] = ()
    """Which axes (x y z rx ry rz); by default all that the device has."""
    duration: float | None = None
    """Seconds per axis; by default 12, more below 333 Hz."""
    travel: float = TRAVEL[0]
    """Travel to each side in m."""
    turn: float = TRAVEL[1]
    """Turn to each side in rad."""
    force_share: float = FORCE_SHARE
    """Share of the device's force limit that may be used, 0 to 1."""
    rate: float = 1000.0
    """Ticks per second."""
    save: Path | None = None
    """Write the profile to this file; by default into the folder of your own profiles, for a real
    device only."""
    plot: Path | None = None
    """Draw the fit into this picture (.png, .svg or .pdf)."""
    zwidth: Path | None = None
    """Draw the stiffness and damping that the device can show into this picture."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the result as JSON."""

    def execute(self) -> int:
        """Measures and prints; returns the exit code."""
        for path in (self.plot, self.zwidth):
            if path is not None:
                check_ending(path)
        period = period_of(self.rate)
        duration = duration_at(period) if self.duration is None else self.duration
        self._check(duration)
        if self.plot is not None and self.plot == self.zwidth:
            raise HapticBridgeError(f"--plot and --zwidth both name '{self.plot}'")
        device = open_device(self.device, tell=tell)
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
            device.close()
        z = safe_width(result)
        profile = measured_profile(
            result,
            device=self.device.partition(":")[0],
            serial=device.info.serial,
            date=date.today().isoformat(),
            duration=duration,
            workspace=getattr(device, "workspace", None),
        )
        path = self._place(profile, is_real=device.info.is_real)
        # first, so that a file that cannot be written costs nothing that was measured
        if self.as_json:
            print_json(facts(result, z, path))
        else:
            print_result(result, z)
        if path is not None:
            _write(profile, path)
            tell(f"wrote {path}")
        for target, figure in (
            (self.plot, draw_identification(result) if self.plot else None),
            (self.zwidth, draw_z_width(z) if self.zwidth and z else None),
        ):
            if target is not None and figure is not None:
                write_figure(figure, target)
        if self.zwidth is not None and z is None:
            tell(f"'{self.zwidth}' is not drawn: {why_none(result)}")
        return 0

    def _check(self, duration: float) -> None:
        for name, value, least, most, unit in (
            ("duration", duration, 2.0, 600.0, "s"),
            ("travel", self.travel, 1e-4, 1.0, "m"),
            ("turn", self.turn, 1e-3, 3.0, "rad"),
            ("force_share", self.force_share, 1e-3, 1.0, ""),
        ):
            if not least <= value <= most:
                told = name.replace("_", "-")
                raise HapticBridgeError(
                    f"--{told} is {value!r} {unit}".rstrip() + f"; it must be {least:g} to {most:g}"
                )

    def _axes(self, present: tuple[str, ...]) -> tuple[str, ...]:
        for axis in self.axes:
            if axis not in present:
                raise HapticBridgeError(f"--axes {axis}: the device has {choices(present)}")
        return tuple(axis for axis in AXES if axis in (self.axes or present))

    def _place(self, profile: Profile, *, is_real: bool) -> Path | None:
        """Returns where the profile goes; None where it is not kept."""
        if self.save is not None or not is_real:
            return self.save
        return own_folder() / f"{'-'.join(filter(None, (profile.device, profile.serial)))}.toml"


def _write(profile: Profile, path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(profile.to_toml(), encoding="utf-8")
    except OSError as error:
        raise HapticBridgeError(f"cannot write '{path}': {error.strerror}") from None
