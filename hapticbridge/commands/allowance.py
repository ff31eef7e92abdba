"""Which couplings a device allows while it is felt."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from hapticbridge.commands.command import Couple
from hapticbridge.commands.span import UNITS, Span
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import CommandError
from hapticbridge.guard import Limits
from hapticbridge.rendering import Method


@dataclass(frozen=True, kw_only=True)
class Allowance:
    """What of stiffness and damping the device allows, in translation and where it turns.

    Attributes:
        info: The device.
        method: How the tool is rendered.
        start: The coupling that the run began with, as asked for.
        period: T in s.
        scale: s_h, handle motion per device motion.
        force_scale: s_f, force on the device per force on the tool.
        substeps: MuJoCo steps per tick.
        limits: Of the run.
    """

    info: DeviceInfo
    method: Method
    start: Coupling
    period: float
    scale: float
    force_scale: float
    substeps: int
    limits: Limits

    @cached_property
    def translation(self) -> Span:
        """How stiff and damped it may be along the axes."""
        limits = self.limits
        return Span(axis="translation", effort=limits.force, reach=limits.stretch, **self._common)

    @cached_property
    def rotation(self) -> Span | None:
        """Likewise about them; None where the device feels no torque."""
        if not self.info.turns:
            return None
        limits = self.limits
        return Span(axis="rotation", effort=limits.torque, reach=limits.angle, **self._common)

    @property
    def _common(self) -> dict[str, Any]:
        names = ("info", "method", "start", "period", "scale", "force_scale", "substeps")
        return {name: getattr(self, name) for name in names}

    @property
    def spans(self) -> tuple[Span, ...]:
        """Those that there are."""
        return (self.translation, *(() if self.rotation is None else (self.rotation,)))

    def felt(self, command: Couple, now: Coupling) -> Coupling:
        """Returns the coupling that is to be felt after a command; what it leaves out stays."""
        felt = self.translation.put(now, command.stiffness, command.damping)
        stiffness, damping = command.rotational_stiffness, command.rotational_damping
        if self.rotation is None or stiffness is None or damping is None:
            return felt
        return self.rotation.put(felt, stiffness, damping)

    def used(self, felt: Coupling) -> Coupling:
        """Returns the coupling of the law for one that is to be felt."""
        return self.method.used(felt, self.period / self.substeps)

    def reason(self) -> str:
        """Returns why the sliders end where they do, in a sentence."""
        is_known = self.info.damping and (self.info.rotational_damping or not self.info.turns)
        known = "" if is_known else " (taken for it, it is not known)"
        dampings = " and ".join(f"{span.damping:.3g} {UNITS[span.axis][1]}" for span in self.spans)
        return (
            f"They end where the device's damping of {dampings}{known} just bears what is felt "
            "between two samples; beyond, a hand could feel the coupling push by itself."
        )

    def check(self, command: Couple) -> None:
        """Refuses what the device does not allow.

        Raises:
            CommandError: Says what is too much, and the bound.
        """
        if not self.method.has_law:
            raise CommandError(
                f"method '{self.method.name}' has no coupling law that could be changed in mid-run"
            )
        self.translation.check(command.stiffness, command.damping)
        stiffness, damping = command.rotational_stiffness, command.rotational_damping
        if stiffness is None or damping is None:
            return
        if self.rotation is None:
            raise CommandError(
                f"device '{self.info.name}' feels no torque; its coupling's rotation stays as it is"
            )
        self.rotation.check(stiffness, damping)
