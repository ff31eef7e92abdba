"""Couplings that may be selected during a run on a given device."""

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
    """Limits of stiffness and damping on a device, in translation and rotation.

    Attributes:
        info: The device.
        method: The rendering method.
        start: Requested coupling at the start of the run.
        period: T in s.
        scale: s_h, handle motion per device motion.
        force_scale: s_f, force on the device per force on the tool.
        substeps: MuJoCo steps per tick.
        limits: Limits of the run.
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
        """Limits in translation."""
        limits = self.limits
        return Span(axis="translation", effort=limits.force, reach=limits.stretch, **self._common)

    @cached_property
    def rotation(self) -> Span | None:
        """Limits in rotation; None for a device without torque."""
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
        """Limits of the available kinds of axis."""
        return (self.translation, *(() if self.rotation is None else (self.rotation,)))

    def felt(self, command: Couple, now: Coupling) -> Coupling:
        """Returns the requested coupling after a command; omitted gains keep their values."""
        felt = self.translation.put(now, command.stiffness, command.damping)
        stiffness, damping = command.rotational_stiffness, command.rotational_damping
        if self.rotation is None or stiffness is None or damping is None:
            return felt
        return self.rotation.put(felt, stiffness, damping)

    def used(self, felt: Coupling) -> Coupling:
        """Returns the law's coupling for a requested one."""
        return self.method.used(felt, self.period / self.substeps)

    def reason(self) -> str:
        """Returns the reason of the slider limits, in a sentence."""
        is_known = self.info.damping and (self.info.rotational_damping or not self.info.turns)
        known = "" if is_known else " (assumed; it is unknown)"
        dampings = " and ".join(f"{span.damping:.3g} {UNITS[span.axis][1]}" for span in self.spans)
        return (
            f"They end where the device's damping of {dampings}{known} just suffices. Beyond, the "
            "coupling could push the hand by itself."
        )

    def check(self, command: Couple) -> None:
        """Refuses gains that the device does not allow.

        Raises:
            CommandError: The message names the excessive value and the bound.
        """
        if not self.method.has_law:
            raise CommandError(
                f"method '{self.method.name}' has no coupling law to change during a run"
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
