"""Which couplings a device allows while it is felt: where the sliders end, and why."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hapticbridge.certificate import assumed_damping, needed_on_axes
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.device.lateness import delay_ticks
from hapticbridge.errors import CommandError, CouplingError
from hapticbridge.guard import Limits
from hapticbridge.rendering import Method

SOFTEST = 0.05
"""Least stiffness that can be asked for, as a share of the largest; no unit. Softer, a hand no
longer feels where the tool is; but a run that began softer may stay so."""

_HALVINGS = 60

_POINTS, _HIGHEST = 40, 1e3
"""Of the table of needs: points, and the largest ratio B'/(K T)."""

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Allowance:
    """What of stiffness and damping the device allows, in translation.

    The condition is b >= s_h s_f (K T/2 + B'), B' what the method uses of the B asked for, more
    where the device answers late or several laws are computed in a tick
    (``certificate.needed_damping``). Rotation stays as the run began.

    Attributes:
        info: The device; an unknown damping is taken for the one that the default coupling takes
            (``certificate.assumed_damping``).
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

    @property
    def damping(self) -> float:
        """The device's damping b in N s/m that is counted on."""
        return assumed_damping(self.info)[0]

    def felt(self, stiffness: float, damping: float) -> Coupling:
        """Returns the coupling with this stiffness and damping, rotation as the run began."""
        return replace(self.start, stiffness=stiffness, damping=damping)

    def used(self, felt: Coupling) -> Coupling:
        """Returns the coupling of the law for one that is to be felt."""
        return self.method.used(felt, self.period / self.substeps)

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Ratios B'/K in s, and what a device needs for K = 1 N/m at each, in N s/m.

        The need is convex and homogeneous in K and B', so that a line between two points of it lies
        above: what is read off in between is never too little.
        """
        laws, known = self.method.laws(self.substeps), replace(self.info, damping=self.damping)
        is_linear = laws == 1 and not delay_ticks(known, self.period)
        inner = () if is_linear else np.geomspace(0.02, 50.0, _POINTS)
        ratios = self.period * np.array([0.0, *inner, _HIGHEST])
        needs = []
        for ratio in ratios.tolist():
            asked = replace(self.start, stiffness=1.0, damping=ratio)
            scales = self.scale, self.force_scale
            try:
                need = needed_on_axes(known, asked, self.period, *scales, laws, self.method)[0]
            except CouplingError:  # a delay that no damping makes up for
                need = math.inf
            needs.append(need)
        return ratios, np.array(needs)

    def needed(self, stiffness: float, damping: float) -> float:
        """Returns the damping b in N s/m that a device needs for what is asked.

        In some microseconds, once it was asked before: a refusal must not take the loop's time.
        """
        used = self.used(self.felt(stiffness, damping))
        ratios, needs = self._table
        ratio = min(used.damping / used.stiffness, float(ratios[-1]))
        more = used.damping - ratio * used.stiffness  # B' beyond the table adds to the need
        per_damping = float(needs[-1] / ratios[-1])
        return used.stiffness * float(np.interp(ratio, ratios, needs)) + per_damping * more

    def most_stiffness(self, damping: float) -> float:
        """Returns the largest K in N/m that goes with a B in N s/m; 0 where none does."""
        most = 4.0 * self.damping / (self.period * self.scale * self.force_scale)
        return _largest(most, lambda stiffness: self.needed(stiffness, damping), self.damping)

    def most_damping(self, stiffness: float) -> float:
        """Returns the largest B in N s/m that goes with a K in N/m; 0 where none does."""
        most = 4.0 * self.damping / (self.scale * self.force_scale)
        return _largest(most, lambda damping: self.needed(stiffness, damping), self.damping)

    @cached_property
    def least_stiffness(self) -> float:
        """The least K in N/m: that which the run began with, or less.

        K >= F/(s_f s_h stretch limit), for the guard stops a run whose coupling is too long before
        its force is full; and no less than ``SOFTEST`` of the largest. Were it more than what the
        run began with, a touch of the damping alone would make the coupling stiffer.
        """
        reach = self.scale * self.force_scale * self.limits.stretch
        softest = SOFTEST * self.most_stiffness(0.0)
        if math.isfinite(reach):
            softest = min(max(softest, self.limits.force / reach), self.most_stiffness(0.0))
        return min(softest, self.start.stiffness)

    def reason(self) -> str:
        """Returns why the sliders end where they do, in a sentence."""
        known = "" if self.info.damping else " (taken for it, it is not known)"
        return (
            f"They end where the device's damping of {self.damping:.3g} N s/m{known} just bears "
            "what is felt between two samples; beyond, a hand could feel the coupling push by "
            "itself."
        )

    def check(self, stiffness: float, damping: float) -> None:
        """Refuses what the device does not allow.

        Raises:
            CommandError: Says what is too much, and the bound.
        """
        if not self.method.has_law:
            raise CommandError(
                f"method '{self.method.name}' has no coupling law that could be changed in mid-run"
            )
        least = self.least_stiffness
        if stiffness < least * (1.0 - 1e-9):
            raise CommandError(
                f"stiffness is {stiffness:g} N/m; below {least:.4g} N/m a hand no longer feels "
                "where the tool is, or the run stops before the force is full"
            )
        needed = self.needed(stiffness, damping)
        if not needed <= self.damping * (1.0 + 1e-9):
            raise CommandError(
                f"stiffness {stiffness:g} N/m with damping {damping:g} N s/m needs a device of "
                f"{needed:.4g} N s/m, and this one has {self.damping:.4g}"
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
