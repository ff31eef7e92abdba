"""Limits on the wrench that is sent, and on what a run may be before it is stopped."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hapticbridge.device import DeviceInfo
from hapticbridge.errors import DeviceError

LONGEST_RAMP = 60.0
"""In s. Nobody waits longer for a force to come up; a larger number is a mistake in the unit."""

USUAL_RISE = 2e-3
"""In s: the shortest time in which the wrench may go from zero to its limit. 10 N in 2 ms is what a
coupling of 2400 N/m does at 2 m/s, faster than a hand taps; a longer time delays honest contacts,
and a delay creates energy; a shorter one lets a jump of the scene through as a blow."""

USUAL_STRETCH = 0.2
"""In m, of the device's motion: no hand goes that far from its tool on a desk. Shorter stops
whoever pulls on a stuck tool, longer lets a lost tool go unnoticed."""

USUAL_ANGLE = 2.8
"""In rad. At π the torque of the coupling changes sides; 160 degrees leave room for one tick."""

USUAL_ENERGY = 0.04
"""In J, given to the device beyond what the hand put in: 10 N over 4 mm, a nudge and no blow. It is
seen a tick later; with what 10 N do in that at 1 m/s, the sum stays below 0.05 J. Motors of a scene
that are meant to push the hand need more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits on the wrench that is sent, in this order after scale and controller, and on the run.

    Attributes:
        force: Largest norm of the force in N, > 0; a longer one keeps its direction.
        torque: Largest norm of the torque in N m, > 0.
        rise: Shortest time in s in which force and torque go from zero to their limits, >= 0; 0
            lets them step.
        ramp: Time in s over which the wrench rises linearly at the start, 0 to 60; it takes longer
            where the coupling holds much energy meanwhile (``kernel.ramp``).
        stretch: Largest distance between handle and grip in m, over the scale, > 0; beyond it the
            run is stopped. So it is beyond the others:
        angle: Largest angle between them in rad, > 0 and < π, or inf.
        energy: Most energy in J that the device may be given beyond what the hand put in, > 0.
        reach: Farthest in m that the device may be from the middle of its workspace, the origin of
            its frame, > 0; inf: no limit; None: the device's own, where it knows it. It is not
            stopped there: beyond, it moves without the handle and without force, as with a clutch.

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
        """Returns the reach in m: the one asked for, else the device's own, else inf."""
        own = math.inf if info.reach is None else info.reach
        return own if self.reach is None else self.reach

    def ramp_ticks(self, period: float) -> int:
        """Returns the length of the ramp in ticks of ``period`` seconds."""
        return round(self.ramp / period)

    def rises(self, period: float) -> tuple[float, float]:
        """Returns by how much force (N) and torque (N m) may change in a tick."""
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
"""Of runs that nobody feels: no force of a simulation that is still finite comes near."""


def limits_for(info: DeviceInfo, limits: Limits | None) -> Limits:
    """Returns the limits of a run: those asked for, or the device's own.

    Raises:
        DeviceError: More is asked for than the device bears. One whose motion is prescribed feels
            nothing, so any limit is accepted for it.
    """
    if limits is None:
        return Limits(force=info.force_limit, torque=info.torque_limit)
    own = {"force": (info.force_limit, "N"), "torque": (info.torque_limit, "N m")}
    for name, (most, unit) in own.items():
        asked = getattr(limits, name)
        if asked > most and not info.is_prescribed:
            raise DeviceError(
                f"{name} limit is {asked:g} {unit}; the device '{info.name}' bears {most:g} {unit}"
            )
    return limits
