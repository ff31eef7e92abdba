"""Couplings that may be selected during a run on a given device."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hapticbridge.certificate import assumed_damping, delay_ticks, required_axis_damping
from hapticbridge.commands.command import Couple
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import CommandError, CouplingError
from hapticbridge.guard import Limits
from hapticbridge.rendering import Method

# Largest stiffness and damping that a device tolerates, for translation or rotation

SOFTEST = 0.05
"""Smallest selectable stiffness as a share of the largest, without unit. A softer coupling no
longer shows the hand where the tool is. A run that began softer may stay so."""

UNITS = {"translation": ("N/m", "N s/m"), "rotation": ("N m/rad", "N m s/rad")}
"""Units of stiffness and damping by kind of axis."""

_PREFIX = {"translation": "", "rotation": "rotational "}

_HALVINGS = 60
"""Number of bisections of a limit; more exceed the 53 bits of a double."""

_POINTS, _HIGHEST = 40, 1e3
"""Number of points, and largest ratio B'/(K T), of the table of required damping."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AxisCouplingLimits:
    """Limits of stiffness and damping along one kind of axis.

    They follow from the device condition b >= s (K T/2 + B'), with s = s_h s_f for translation and
    s_f/s_h for rotation. B' is the damping of the law. With a delay or several laws per tick the
    requirement is larger and has no closed form (``certificate.required_damping``).

    Attributes:
        axis: ``translation`` or ``rotation``.
        run: Limits of the run in both kinds of axis. Unknown damping of its device is replaced by
            ``certificate.assumed_damping``.
    """

    axis: Literal["translation", "rotation"]
    run: CouplingLimits

    @property
    def names(self) -> tuple[str, str]:
        """Names of stiffness and damping in ``Coupling``."""
        prefix = _PREFIX[self.axis].replace(" ", "_")
        return f"{prefix}stiffness", f"{prefix}damping"

    @property
    def leverage(self) -> float:
        """Factor s from the tool's to the device's coupling."""
        if self.axis == "translation":
            return self.run.scale * self.run.force_scale
        return self.run.force_scale / self.run.scale

    @property
    def damping(self) -> float:
        """Device damping b in N s/m or N m s/rad, or the assumed one."""
        return assumed_damping(self.run.info)[self.axis == "rotation"]

    def gains(self, coupling: Coupling) -> tuple[float, float]:
        """Returns the stiffness and damping of a coupling along these axes."""
        stiffness, damping = (float(getattr(coupling, name)) for name in self.names)
        return stiffness, damping

    def put(self, coupling: Coupling, stiffness: float, damping: float) -> Coupling:
        """Returns a coupling with other stiffness and damping along these axes."""
        return replace(coupling, **dict(zip(self.names, (stiffness, damping), strict=True)))

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Ratios B'/K in s, and the required damping for K = 1 at each.

        The requirement is convex and homogeneous in (K, B'), so linear interpolation never
        underestimates it.
        """
        run, (linear, angular) = self.run, assumed_damping(self.run.info)
        known = replace(run.info, damping=linear, rotational_damping=angular)
        is_linear = run.law_evaluations == 1 and not delay_ticks(known, run.period)
        inner = () if is_linear else np.geomspace(0.02, 50.0, _POINTS)
        ratios = run.period * np.array([0.0, *inner, _HIGHEST])
        needs = []
        for ratio in ratios.tolist():
            requested = self.put(run.start, 1.0, ratio)
            scales = run.scale, run.force_scale
            try:
                need = required_axis_damping(
                    known, requested, run.period, *scales, run.law_evaluations, run.method
                )
                needs.append(need[self.axis == "rotation"])
            except CouplingError:  # no damping compensates this delay
                needs.append(math.inf)
        return ratios, np.array(needs)

    def needed(self, stiffness: float, damping: float) -> float:
        """Returns the device damping b in N s/m or N m s/rad that requested gains need.

        It takes microseconds after the first call, because a refusal must not slow the loop.
        """
        requested = self.put(self.run.start, stiffness, damping)
        stiffness, damping = self.gains(self.run.law(requested))
        ratios, needs = self._table
        highest = float(ratios[-1])
        ratio = min(damping / stiffness, highest) if stiffness > 0.0 else highest
        more = damping - ratio * stiffness  # B' beyond the table
        return (
            stiffness * float(np.interp(ratio, ratios, needs)) + float(needs[-1]) / highest * more
        )

    def max_stiffness(self, damping: float) -> float:
        """Returns the largest stiffness for a damping; 0 if there is none."""
        most = 4.0 * self.damping / (self.run.period * self.leverage)
        return _largest(most, lambda stiffness: self.needed(stiffness, damping), self.damping)

    def max_damping(self, stiffness: float) -> float:
        """Returns the largest damping for a stiffness; 0 if there is none."""
        most = 4.0 * self.damping / self.leverage
        return _largest(most, lambda damping: self.needed(stiffness, damping), self.damping)

    @cached_property
    def min_stiffness(self) -> float:
        """Smallest selectable stiffness, at most that of the run's start.

        K >= F/(s · reach), because the guard stops a run whose coupling is too long before its
        force is full; and K >= ``SOFTEST`` of the largest. If it exceeded the start's stiffness, a
        change of the damping alone would stiffen the coupling.
        """
        limits = self.run.limits
        is_linear = self.axis == "translation"
        effort = limits.force if is_linear else limits.torque
        reach = self.leverage * (limits.stretch if is_linear else limits.angle)
        stiffest = self.max_stiffness(0.0)
        softest = min(max(SOFTEST * stiffest, effort / reach), stiffest)
        return min(softest, self.gains(self.run.start)[0])

    def check(self, stiffness: float, damping: float) -> None:
        """Refuses gains that the device does not allow.

        Raises:
            CommandError: The message names the excessive value and the bound.
        """
        (unit, damper), prefix = UNITS[self.axis], _PREFIX[self.axis]
        least = self.min_stiffness
        if stiffness < least * (1.0 - 1e-9):
            raise CommandError(
                f"{prefix}stiffness is {stiffness:g} {unit}; below {least:.4g} {unit} a hand no "
                "longer feels where the tool is, or the run stops before the force is full"
            )
        needed = self.needed(stiffness, damping)
        if not needed <= self.damping * (1.0 + 1e-9):
            raise CommandError(
                f"{prefix}stiffness {stiffness:g} {unit} with {prefix}damping {damping:g} {damper} "
                f"needs a device of {needed:.4g} {damper}, and this one has {self.damping:.4g}"
            )


def _largest(most: float, needed: Callable[[float], float], limit: float) -> float:
    """Returns the largest argument in [0, most] whose requirement stays below a limit."""
    low, high = 0.0, most
    if not needed(low + 1e-9 * most) <= limit:
        return 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if needed(middle) <= limit else (low, middle)
    return low


@dataclass(frozen=True, kw_only=True)
class CouplingLimits:
    """Limits of stiffness and damping on a device, in translation and rotation.

    Attributes:
        info: The device.
        method: The rendering method.
        start: Requested coupling at the start of the run.
        period: T in s.
        scale: s_h, handle motion per device motion.
        force_scale: s_f, force on the device per force on the tool.
        timestep: MuJoCo's h in s.
        law_evaluations: Evaluations of the law per tick.
        limits: Limits of the run.
    """

    info: DeviceInfo
    method: Method
    start: Coupling
    period: float
    scale: float
    force_scale: float
    timestep: float
    law_evaluations: int
    limits: Limits

    @cached_property
    def translation(self) -> AxisCouplingLimits:
        """Limits in translation."""
        return AxisCouplingLimits("translation", self)

    @cached_property
    def rotation(self) -> AxisCouplingLimits | None:
        """Limits in rotation; None for a device without torque."""
        return AxisCouplingLimits("rotation", self) if self.info.turns else None

    @property
    def spans(self) -> tuple[AxisCouplingLimits, ...]:
        """Limits of the available kinds of axis."""
        return (self.translation, *(() if self.rotation is None else (self.rotation,)))

    def requested(self, command: Couple, now: Coupling) -> Coupling:
        """Returns the requested coupling after a command; omitted gains keep their values."""
        requested = self.translation.put(now, command.stiffness, command.damping)
        stiffness, damping = command.rotational_stiffness, command.rotational_damping
        if self.rotation is None or stiffness is None or damping is None:
            return requested
        return self.rotation.put(requested, stiffness, damping)

    def law(self, requested: Coupling) -> Coupling:
        """Returns the law's coupling for a requested one."""
        return self.method.law_coupling(requested, self.timestep)

    def reason(self) -> str:
        """Returns the reason of the slider limits, in a sentence."""
        is_known = self.info.damping and (self.info.rotational_damping or not self.info.turns)
        known = "" if is_known else " (assumed; it is unknown)"
        dampings = " and ".join(f"{span.damping:.3g} {UNITS[span.axis][1]}" for span in self.spans)
        if self.info.is_prescribed:
            return f"They end where a device with a damping of {dampings} would just suffice."
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
