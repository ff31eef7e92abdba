"""Limits of the wrench and of the run."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hapticbridge.device import DeviceInfo
from hapticbridge.errors import DeviceError

LONGEST_RAMP = 60.0
"""Longest ramp in s. A larger number is taken for a mistake in the unit."""

USUAL_RISE = 2e-3
"""Shortest time in s from zero wrench to its limit. A coupling of 2400 N/m produces 10 N in 2 ms at
2 m/s, faster than a hand taps. A longer time delays true contacts, and delay creates energy; a
shorter one passes a jump of the scene as a blow."""

USUAL_STRETCH = 0.2
"""Stretch limit in m of the device's motion; no hand at a desk goes that far from its tool. A
smaller limit stops users who pull on a stuck tool; a larger one misses a lost tool."""

USUAL_ANGLE = 2.8
"""Angle limit in rad. At π the coupling's torque changes sign; 160 degrees leave room for one
tick."""

USUAL_ENERGY = 0.04
"""Energy limit in J, given to the device beyond the hand's own work: 10 N over 4 mm, a nudge and no
blow. Detection takes one tick; with the work of 10 N at 1 m/s in it, the sum stays below 0.05 J.
Scenes whose motors push the hand need more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits of the wrench, applied in this order after scale and controller, and of the run.

    Attributes:
        force: Largest norm of the force in N, > 0; a larger force keeps its direction.
        torque: Largest norm of the torque in N m, > 0.
        rise: Shortest time in s from zero to the limits, >= 0; 0 allows steps.
        ramp: Time in s of the linear rise at the start, 0 to 60. It takes longer if the coupling
            stores much energy meanwhile (``kernel.ramp``).
        stretch: Largest distance between handle and grip divided by the scale, in m, > 0. Beyond
            this and the next two limits the run is stopped.
        angle: Largest angle between handle and grip in rad, > 0 and < π, or inf.
        energy: Largest energy in J given to the device beyond the hand's own work, > 0.
        reach: Largest distance in m of the device from the origin of its frame, the middle of its
            workspace, > 0. inf means no limit, None the device's own if known. Beyond it the device
            moves without handle and force, as with a clutch; the run goes on.

    Raises:
        DeviceError: A value is not finite or out of range.
    """

    force: float
    torque: float
    rise: float = USUAL_RISE
    ramp: float = 0.5
    stretch: float = USUAL_STRETCH
    angle: float = USUAL_ANGLE
    energy: float = USUAL_ENERGY
    reach: float | None = None

    def __post_init__(self) -> None:
        for name, unit in (("force", "N"), ("torque", "N m")):
            value = getattr(self, name)
            if not math.isfinite(value) or value <= 0:
                raise DeviceError(f"{name} limit is {value!r} {unit}; it must be finite and > 0")
        if not 0 <= self.ramp <= LONGEST_RAMP:
            raise DeviceError(f"start ramp is {self.ramp!r} s; it must be 0 to {LONGEST_RAMP:g}")
        if not 0 <= self.rise <= LONGEST_RAMP:
            raise DeviceError(f"rise is {self.rise!r} s; it must be 0 to {LONGEST_RAMP:g}")
        for name, unit in (("stretch", "m"), ("energy", "J"), ("reach", "m")):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise DeviceError(f"{name} limit is {value!r} {unit}; it must be > 0, inf for none")
        if not (0 < self.angle < math.pi or self.angle == math.inf):
            raise DeviceError(
                f"angle limit is {self.angle!r} rad; it must be > 0 and < pi, inf for none"
            )

    def reach_of(self, info: DeviceInfo) -> float:
        """Returns the reach in m: the requested one, else the device's own, else inf."""
        own = math.inf if info.reach is None else info.reach
        return own if self.reach is None else self.reach

    def ramp_ticks(self, period: float) -> int:
        """Returns the length of the ramp in ticks of ``period`` seconds."""
        return round(self.ramp / period)

    def rises(self, period: float) -> tuple[float, float]:
        """Returns the largest change of force (N) and torque (N m) per tick."""
        if self.rise == 0:
            return math.inf, math.inf
        return self.force * period / self.rise, self.torque * period / self.rise


UNLIMITED = Limits(
    force=1e30,
    torque=1e30,
    rise=0.0,
    ramp=0.0,
    stretch=math.inf,
    angle=math.inf,
    energy=math.inf,
)
"""No limits, for simulations without a device; no finite force comes near."""


def limits_for(info: DeviceInfo, limits: Limits | None) -> Limits:
    """Returns the requested limits of a run, or else the device's own.

    Raises:
        DeviceError: A requested limit exceeds the device's. Any limit is accepted for a prescribed
            motion, which has no hand.
    """
    if limits is None:
        return Limits(force=info.force_limit, torque=info.torque_limit)
    own = {"force": (info.force_limit, "N"), "torque": (info.torque_limit, "N m")}
    for name, (most, unit) in own.items():
        requested = getattr(limits, name)
        if requested > most and not info.is_prescribed:
            raise DeviceError(
                f"{name} limit is {requested:g} {unit}; the device '{info.name}' bears "
                f"{most:g} {unit}"
            )
    return limits
