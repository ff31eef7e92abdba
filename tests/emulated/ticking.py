"""A real driver and an emulated device as one: time passes with every read, as a loop would."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from emulated.timed import Timed
from hapticbridge.device import Device


class Ticking:
    """Moves the emulated device by one period before each read but the first.

    Each start takes a new device out of the box, so that two runs can be alike.

    Args:
        build: Makes the driver and what its device is plugged into.
    """

    def __init__(self, build: Callable[[], tuple[Device, Timed]]) -> None:
        self._build = build
        self._device, self._seam = build()
        self._is_used = False
        self._period = self._next = 0.0
        self.info = self._device.info

    def start(self, period: float) -> NDArray[np.void]:
        if self._is_used:
            self._device, self._seam = self._build()
        sample = self._device.start(period)
        self._is_used = True
        self._period, self._next = period, self._seam.now
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        self._seam.advance(self._next)
        self._next += self._period
        return self._device.read(sample)

    def write(self, wrench: NDArray[np.float64]) -> None:
        self._device.write(wrench)

    def close(self) -> None:
        self._device.close()
