"""Checks before force is enabled."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hapticbridge.clock import Clock, RealClock, SimulatedClock
from hapticbridge.device import Device, DeviceInfo
from hapticbridge.device.families import DRIVERS
from hapticbridge.errors import DeviceError
from hapticbridge.guard.limits import Limits
from hapticbridge.kernel.handle import handle_pose
from hapticbridge.pose import canonical
from hapticbridge.tick import SAMPLE_DTYPE

STILL_TIME, PATIENCE = 0.1, 5.0
"""Time in s for which a real device must be still before force is enabled, and time in s after
which waiting for it fails. A hand that reaches for a device stays longer than the first."""

STILL_DISTANCE = 1e-3
"""Largest motion in m within ``STILL_TIME``: 1 cm/s, more than a hand that holds still."""

_NO_FORCE = np.zeros(6)


def wait_until_still(
    device: Device,
    sample: NDArray[np.void],
    period: float,
    clock: Clock,
    is_over: Callable[[], object] = lambda: False,
) -> None:
    """Waits until a device with motors is still; returns at once for any other.

    Zero force is commanded in every period: a Falcon reports its position only in answer to a
    force, and a device with a watchdog must not find its host silent.

    Args:
        device: The started device.
        sample: Shape (1,), ``SAMPLE_DTYPE``; receives the newest sample.
        period: T in s, at which it is read.
        clock: Clock of the run. The wait happens only in real time; an injected clock also drives
            the device, which must not move before the run.
        is_over: Returns True if the run was stopped meanwhile; the wait then ends.

    Raises:
        DeviceError: The device keeps moving.
    """
    if not device.info.is_real or device.info.is_prescribed or type(clock) is not RealClock:
        return
    clock = RealClock()  # a separate one, because the run's time begins with its first tick
    clock.start(round(1e9 * period))
    anchor = np.zeros(1, SAMPLE_DTYPE)
    since = begun = None
    while not is_over():
        clock.wait()
        device.read(sample)
        device.write(_NO_FORCE)
        now = clock.now()
        begun = now if begun is None else begun
        moved = float(np.linalg.norm(sample["position"][0] - anchor["position"][0]))
        if since is None or not moved <= STILL_DISTANCE:
            anchor[0], since = sample[0], now
        elif now - since >= 1e9 * STILL_TIME:
            return
        if now - begun > 1e9 * PATIENCE:
            raise DeviceError(
                f"the device '{device.info.name}' has moved for {PATIENCE:g} s; hold it still, "
                "then start again: force is enabled only at rest"
            )


def refuse_simulated_time(device: DeviceInfo | str, clock: Clock) -> None:
    """Refuses a simulated clock for a device bound to real time.

    Such a device has motors, or follows a live hand without end and with a delay. A device string
    is checked before the device is opened and homed; all hardware is bound to real time.

    Raises:
        DeviceError: The device is bound to real time and the clock is simulated.
    """
    if isinstance(device, str):
        name = device.partition(":")[0]
        is_bound = name in DRIVERS
    else:
        name = device.name
        follows = device.is_prescribed and device.delay != 0.0 and device.duration is None
        is_bound = device.is_real or follows
    if is_bound and isinstance(clock, SimulatedClock):
        raise DeviceError(
            f"the device '{name}' moves in real time, so the loop cannot run faster; leave out "
            "--fast (in code: the SimulatedClock)"
        )


def refuse_stretched_start(
    state: NDArray[np.void], sample: NDArray[np.void], limits: Limits
) -> None:
    """Refuses a start at which the coupling would already exceed the force limit.

    Raises:
        DeviceError: The message names the handle's distance from the grip, and the grip's position.
    """
    s = state[0]
    x, y, z = sample["position"][0].tolist()
    quaternion = canonical(tuple(sample["quaternion"][0].tolist()))
    handle, _ = handle_pose(state, (x, y, z), quaternion)
    distance = float(np.linalg.norm(np.subtract(handle, s["tool_position"])))
    force = float(s["stiffness"]) * distance
    if force > limits.force:
        raise DeviceError(
            f"the device's absolute pose puts the handle {1e3 * distance:.3g} mm from the grip, "
            f"{force:.3g} N at the start; the limit is {limits.force:g} N: start nearer to "
            f"{np.round(s['tool_position'], 4).tolist()} m or use relative poses"
        )
