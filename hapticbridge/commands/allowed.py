"""Which couplings a device allows while it is felt."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hapticbridge.certificate import assumed_damping, delay_ticks, required_axis_damping
from hapticbridge.commands.command import Couple
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import CommandError, CouplingError
from hapticbridge.guard import Limits
from hapticbridge.rendering import Method

# How stiff and damped a coupling may be along one kind of axis: where sliders end, and why.

SOFTEST = 0.05
"""Least stiffness that can be asked for, as a share of the largest; no unit. Softer, a hand no
longer feels where the tool is; but a run that began softer may stay so."""

UNITS = {
    "translation": ("N/m", "N s/m"),
    "rotation": ("N m/rad", "N m s/rad"),
}
"""Of stiffness and damping."""

_PREFIX = {"translation": "", "rotation": "rotational "}

_HALVINGS = 60
"""Of a search for a limit: beyond the 53 bits of a double there is nothing left to halve."""

_POINTS, _HIGHEST = 40, 1e3
"""Of the table of needs: points, and the largest ratio B'/(K T)."""

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class AxisCouplingLimits:
    """What of stiffness and damping the device allows, along one kind of axis.

    The condition is b >= s (K T/2 + B'), s = s_h s_f in translation and s_f/s_h in rotation, B'
    what the method uses of the B asked for, more where the device answers late or several laws are
    computed in a tick (``certificate.required_damping``).

    Attributes:
        axis: ``translation`` or ``rotation``.
        info: The device; an unknown damping is taken for the one that the default coupling takes
            (``certificate.assumed_damping``).
        method: How the tool is rendered.
        start: The coupling that the run began with, as asked for.
        period: T in s.
        scale: s_h, handle motion per device motion.
        force_scale: s_f, force on the device per force on the tool.
        substeps: MuJoCo steps per tick.
        effort: The run's limit of force in N or of torque in N m.
        reach: How far the device may be from the tool before the run is stopped, in m or rad.
    """

    axis: Literal["translation", "rotation"]
    info: DeviceInfo
    method: Method
    start: Coupling
    period: float
    scale: float
    force_scale: float
    substeps: int
    effort: float
    reach: float

    @property
    def names(self) -> tuple[str, str]:
        """Of the coupling's stiffness and damping, as its fields."""
        prefix = _PREFIX[self.axis].replace(" ", "_")
        return f"{prefix}stiffness", f"{prefix}damping"

    @property
    def leverage(self) -> float:
        """How much stiffer the coupling is for the device than for the tool."""
        if self.axis == "translation":
            return self.scale * self.force_scale
        return self.force_scale / self.scale

    @property
    def damping(self) -> float:
        """The device's damping b in N s/m or N m s/rad that is counted on."""
        return assumed_damping(self.info)[self.axis == "rotation"]

    def gains(self, coupling: Coupling) -> tuple[float, float]:
        """Returns the stiffness and damping of a coupling along these axes."""
        stiffness, damping = (float(getattr(coupling, name)) for name in self.names)
        return stiffness, damping

    def put(self, coupling: Coupling, stiffness: float, damping: float) -> Coupling:
        """Returns a coupling with another stiffness and damping along these axes."""
        return replace(coupling, **dict(zip(self.names, (stiffness, damping), strict=True)))

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Ratios B'/K in s, and what a device needs for K = 1 at each.

        The need is convex and homogeneous in K and B', so that a line between two points of it lies
        above: what is read off in between is never too little.
        """
        linear, angular = assumed_damping(self.info)
        known = replace(self.info, damping=linear, rotational_damping=angular)
        laws = self.method.laws(self.substeps)
        is_linear = laws == 1 and not delay_ticks(known, self.period)
        inner = () if is_linear else np.geomspace(0.02, 50.0, _POINTS)
        ratios = self.period * np.array([0.0, *inner, _HIGHEST])
        needs = []
        for ratio in ratios.tolist():
            asked = self.put(self.start, 1.0, ratio)
            scales = self.scale, self.force_scale
            try:
                need = required_axis_damping(known, asked, self.period, *scales, laws, self.method)
                needs.append(need[self.axis == "rotation"])
            except CouplingError:  # a delay that no damping makes up for
                needs.append(math.inf)
        return ratios, np.array(needs)

    def needed(self, stiffness: float, damping: float) -> float:
        """Returns the damping b in N s/m or N m s/rad that a device needs for what is asked.

        In some microseconds, once it was asked before: a refusal must not take the loop's time.
        """
        asked = self.put(self.start, stiffness, damping)
        stiffness, damping = self.gains(self.method.used(asked, self.period / self.substeps))
        ratios, needs = self._table
        highest = float(ratios[-1])
        ratio = min(damping / stiffness, highest) if stiffness > 0.0 else highest
        more = damping - ratio * stiffness  # B' beyond the table adds to the need
        return (
            stiffness * float(np.interp(ratio, ratios, needs)) + float(needs[-1]) / highest * more
        )

    def most_stiffness(self, damping: float) -> float:
        """Returns the largest stiffness that goes with a damping; 0 where none does."""
        most = 4.0 * self.damping / (self.period * self.leverage)
        return _largest(most, lambda stiffness: self.needed(stiffness, damping), self.damping)

    def most_damping(self, stiffness: float) -> float:
        """Returns the largest damping that goes with a stiffness; 0 where none does."""
        most = 4.0 * self.damping / self.leverage
        return _largest(most, lambda damping: self.needed(stiffness, damping), self.damping)

    @cached_property
    def least_stiffness(self) -> float:
        """The least stiffness: that which the run began with, or less.

        K >= F/(s · reach), for the guard stops a run whose coupling is too long before its force is
        full; and no less than ``SOFTEST`` of the largest. Were it more than what the run began
        with, a touch of the damping alone would make the coupling stiffer.
        """
        reach = self.leverage * self.reach
        softest = SOFTEST * self.most_stiffness(0.0)
        if math.isfinite(reach):
            softest = min(max(softest, self.effort / reach), self.most_stiffness(0.0))
        return min(softest, self.gains(self.start)[0])

    def check(self, stiffness: float, damping: float) -> None:
        """Refuses what the device does not allow.

        Raises:
            CommandError: Says what is too much, and the bound.
        """
        (unit, damper), prefix = UNITS[self.axis], _PREFIX[self.axis]
        least = self.least_stiffness
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
    """Returns the largest argument in [0, most] at which what is needed stays below a limit."""
    low, high = 0.0, most
    if not needed(low + 1e-9 * most) <= limit:
        return 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if needed(middle) <= limit else (low, middle)
    return low


@dataclass(frozen=True, kw_only=True)
class CouplingLimits:
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
    def translation(self) -> AxisCouplingLimits:
        """How stiff and damped it may be along the axes."""
        limits = self.limits
        return AxisCouplingLimits(
            axis="translation", effort=limits.force, reach=limits.stretch, **self._common
        )

    @cached_property
    def rotation(self) -> AxisCouplingLimits | None:
        """Likewise about them; None where the device feels no torque."""
        if not self.info.turns:
            return None
        limits = self.limits
        return AxisCouplingLimits(
            axis="rotation", effort=limits.torque, reach=limits.angle, **self._common
        )

    @property
    def _common(self) -> dict[str, Any]:
        names = ("info", "method", "start", "period", "scale", "force_scale", "substeps")
        return {name: getattr(self, name) for name in names}

    @property
    def spans(self) -> tuple[AxisCouplingLimits, ...]:
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
