"""The stand-in for OpenHaptics' library, compiled, and its device in virtual time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from emulated.library_stub import LibraryStub
from hapticbridge.device import Motion
from hapticbridge.device.touch.device import TouchDevice
from hapticbridge.device.touch.servo import Hd


class HdStub(LibraryStub):
    """A Touch behind the library.

    Attributes:
        now: Time in s that the device is at.
    """

    def __init__(self, path: Motion | None = None) -> None:
        super().__init__("hd_stub.c", path)
        self.hd = Hd(self.file)
        self.call("reset")

    def force(self) -> NDArray[np.float64]:
        """Returns what the motors give, in the driver's axes: nothing while they are off."""
        x, y, z = (self.number("force", axis) for axis in range(3))
        return np.array([x, -z, y])

    @property
    def now(self) -> float:
        return self.number("now")

    @now.setter
    def now(self, now: float) -> None:
        self.advance(now)

    def opened(self, **options: object) -> TouchDevice:
        return TouchDevice(self.hd, waiting=Virtual(self), **options)  # type: ignore[arg-type]


class Virtual:
    """The stub's time as the driver's."""

    def __init__(self, stub: HdStub) -> None:
        self._stub = stub

    def now(self) -> float:
        return self._stub.now

    def sleep(self, seconds: float) -> None:
        self._stub.advance(self._stub.now + seconds)
