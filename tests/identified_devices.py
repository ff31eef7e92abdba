"""Emulated real devices of random mechanics behind their real drivers, to be identified."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from emulated.dhd_stub import Stub
from emulated.hid_seam import DrivingClock
from emulated.pid_model import PidStick
from emulated.rawhid_model import RawHid
from falcon_cases import Bench
from haply_cases import Bench as HaplyBench
from pid_cases import NEWTONS, TRAVEL
from pid_cases import opened as opened_stick
from rawhid_cases import opened

from hapticbridge.clock import Clock, SimulatedClock
from hapticbridge.device import Device, SimulatedDevice
from hapticbridge.identify import AxisFit, identify

PERIOD = 1e-3


def _unheld(numbers: dict[str, float]) -> SimulatedDevice:
    return SimulatedDevice(hand=None, **numbers)  # type: ignore[arg-type]


def _simulated(numbers: dict[str, float]) -> tuple[Device, Clock]:
    return _unheld({**numbers, "resolution": 1e-5}), SimulatedClock()


def _pid(numbers: dict[str, float]) -> tuple[Device, Clock]:
    stick = PidStick(_unheld(numbers), newtons=NEWTONS, travel=TRAVEL)
    device, _, seam = opened_stick(stick)
    return device, DrivingClock(seam)


def _falcon(numbers: dict[str, float]) -> tuple[Device, Clock]:
    bench = Bench(_unheld(numbers))
    return bench.opened(), bench.clock()


def _rawhid(numbers: dict[str, float]) -> tuple[Device, Clock]:
    device, _, seam = opened(RawHid(_unheld(numbers)))
    return device, DrivingClock(seam)


def _haply(numbers: dict[str, float]) -> tuple[Device, Clock]:
    bench = HaplyBench(_unheld(numbers), resolution=1e-5)
    return bench.opened(force_limit=8.0), DrivingClock(bench.time)


def _forcedimension(numbers: dict[str, float]) -> tuple[Device, Clock]:
    stub = Stub()
    stub.call("mechanics", numbers["mass"], numbers["damping"], numbers["friction"], 1e-5)
    return stub.opened(), DrivingClock(stub)


DRIVERS: dict[str, Callable[[dict[str, float]], tuple[Device, Clock]]] = {
    "simulated": _simulated,
    "falcon": _falcon,
    "rawhid": _rawhid,
    "pid": _pid,
    "haply": _haply,
    "forcedimension": _forcedimension,
}


def mechanics(seed: int) -> dict[str, float]:
    """Returns mass, damping and friction of a desktop device, in SI units."""
    rng = np.random.default_rng(seed)
    ranges = {"mass": (0.15, 0.8), "damping": (0.4, 4.0), "friction": (0.05, 0.4)}
    return {
        name: float(np.exp(rng.uniform(np.log(least), np.log(most))))
        for name, (least, most) in ranges.items()
    }


def identified(driver: str, seed: int, axis: str, duration: float = 10.0) -> AxisFit:
    """Returns what is measured of a random device that nobody holds."""
    device, clock = DRIVERS[driver](mechanics(seed))
    try:
        found = identify(device, clock, period=PERIOD, axes=(axis,), duration=duration)
    finally:
        device.close()
    return found.fits[axis]
