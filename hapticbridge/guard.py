"""What stands between a computed wrench and a motor in somebody's hand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.clock import Clock, SimulatedClock
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.step import BAD_SAMPLE

LONGEST_RAMP = 60.0
"""In s. Nobody waits longer for a force to come up; a larger number is a mistake in the unit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits on the wrench that is sent, applied in this order after the scale.

    Attributes:
        force: Largest norm of the force in N, > 0; a longer one keeps its direction.
        torque: Largest norm of the torque in N m, > 0.
        ramp: Time in s over which the wrench rises linearly at the start, 0 to 60.

    Raises:
        DeviceError: A value is not finite or out of range.
    """

    force: float
    torque: float
    ramp: float = 0.5

    def __post_init__(self) -> None:
        for name, unit in (("force", "N"), ("torque", "N m")):
            value = getattr(self, name)
            if not math.isfinite(value) or value <= 0:
                raise DeviceError(f"{name} limit is {value!r} {unit}; it must be finite and > 0")
        if not 0 <= self.ramp <= LONGEST_RAMP:
            raise DeviceError(f"start ramp is {self.ramp!r} s; it must be 0 to {LONGEST_RAMP:g}")

    def ramp_ticks(self, period: float) -> int:
        """Returns the length of the ramp in ticks of ``period`` seconds."""
        return round(self.ramp / period)


UNLIMITED = Limits(force=1e30, torque=1e30, ramp=0.0)
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


def refuse_simulated_time(info: DeviceInfo, clock: Clock) -> None:
    """Refuses a clock that runs ahead of a device that lives in real time.

    That is a device with motors, and one that follows a hand without end, some time after it.

    Raises:
        DeviceError: It is so.
    """
    follows = info.is_prescribed and info.delay != 0.0 and info.duration is None
    if (info.is_real or follows) and isinstance(clock, SimulatedClock):
        raise DeviceError(
            f"the device '{info.name}' moves in real time, so the loop cannot run as fast as it "
            "goes; leave out --fast (in code: the SimulatedClock)"
        )


def refuse_stretched_start(state: NDArray[np.void], limits: Limits) -> None:
    """Refuses a start at which the coupling would already pull with more than the force limit.

    Args:
        state: The kernel's state (``STATE_DTYPE``, one element) before the first tick.
        limits: Of the run.

    Raises:
        DeviceError: Says how far the handle is from the grip, and where the grip is.
    """
    s = state[0]
    distance = float(np.linalg.norm(s["handle_position"] - s["tool_position"]))
    force = float(s["stiffness"]) * distance
    if force > limits.force:
        raise DeviceError(
            f"the device's absolute pose puts the handle {1e3 * distance:.3g} mm from the grip, "
            f"{force:.3g} N at the start; the limit is {limits.force:g} N: start nearer to "
            f"{np.round(s['tool_position'], 4).tolist()} m or use relative poses"
        )


def trip_reason(code: int, tick: int) -> str:
    """Says why the kernel refused a tick.

    Args:
        code: What ``before_step`` or ``after_step`` returned, not ``OK``.
        tick: The tick's number.
    """
    if code == BAD_SAMPLE:
        return f"tick {tick}: the device's pose is not finite or not a rotation"
    return (
        f"tick {tick}: the simulation is no longer finite (force, pose or energy); the scene "
        "diverged, so lower the stiffness or the period"
    )
