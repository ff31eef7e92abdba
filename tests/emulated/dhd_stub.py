"""The stand-in for Force Dimension's library, compiled, and its device in virtual time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from emulated.library_stub import LibraryStub
from hapticbridge.device import Motion
from hapticbridge.device.force_dimension import Dhd, ForceDimensionDevice

OMEGA3, OMEGA6, OMEGA7, SIGMA7 = 33, 34, 35, 104
CALL = 100e-6
"""Duration in s of each call of the library."""


class Stub(LibraryStub):
    """A device behind the library.

    Args:
        kind: What the library says it is.
        path: Where the hand that holds it goes, None for nobody.

    Attributes:
        now: Time in s that the device is at.
    """

    def __init__(self, kind: int = OMEGA3, path: Motion | None = None) -> None:
        super().__init__("dhd_stub.c", path)
        self.dhd = Dhd(self.file)
        self.call("reset", kind)
        self.call("call", CALL)

    def force(self) -> NDArray[np.float64]:
        """Returns what the motors give: nothing while they are off."""
        return np.array([self.number("force", axis) for axis in range(6)])

    def command(self) -> NDArray[np.float64]:
        """Returns what they were told last."""
        return np.array([self.number("command", axis) for axis in range(6)])

    @property
    def now(self) -> float:
        return self.dhd.now()

    @now.setter
    def now(self, now: float) -> None:
        self.advance(now)

    def opened(self, **options: object) -> ForceDimensionDevice:
        return ForceDimensionDevice(self.dhd, **options)  # type: ignore[arg-type]
