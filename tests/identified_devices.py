"""Emulated real devices of random mechanics behind their real drivers, to be identified."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from emulated.hid_seam import HidSeam
from emulated.rawhid_model import RawHid
from falcon_cases import Bench
from rawhid_cases import opened

from hapticbridge.clock import Clock
from hapticbridge.device import Device, SimulatedDevice
from hapticbridge.identify import AxisFit, identify

PERIOD = 1e-3


class SeamClock:
    """A loop's clock that moves the device behind a seam."""

    name = "virtual"
    is_lossless = True

    def __init__(self, seam: HidSeam) -> None:
        self._seam = seam
        self._period_ns = self._time = 0
        self._next = 0.0

    def start(self, period_ns: int) -> None:
        self._period_ns, self._next = period_ns, self._seam.now

    def wait(self) -> tuple[int, int, int]:
        self._next += 1e-9 * self._period_ns
        self._seam.advance(self._next)
        self._time += self._period_ns
        return self._time, self._time, 0

    def now(self) -> int:
        return self._time


def _falcon(mechanics: SimulatedDevice) -> tuple[Device, Clock]:
    bench = Bench(mechanics)
    return bench.opened(), bench.clock()


def _rawhid(mechanics: SimulatedDevice) -> tuple[Device, Clock]:
    device, _, seam = opened(RawHid(mechanics))
    return device, SeamClock(seam)


DRIVERS: dict[str, Callable[[SimulatedDevice], tuple[Device, Clock]]] = {
    "falcon": _falcon,
    "rawhid": _rawhid,
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
    device, clock = DRIVERS[driver](SimulatedDevice(hand=None, **mechanics(seed)))  # type: ignore[arg-type]
    try:
        found = identify(device, clock, period=PERIOD, axes=(axis,), duration=duration)
    finally:
        device.close()
    return found.fits[axis]
