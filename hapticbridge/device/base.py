"""What a haptic device is to the bridge: a protocol of four calls."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.data_sheet import DeviceInfo


class Device(Protocol):
    """Where the handle's motion comes from and where the wrench goes.

    The loop calls ``start`` once, then in each tick ``read`` and later ``write``; ``close`` ends.
    The sample of tick k is the state at the time k · period. A wrench written in tick k acts from
    then on until the next write.

    Attributes:
        info: The device's data sheet, complete before ``start``.
    """

    info: DeviceInfo

    def start(self, period: float) -> NDArray[np.void]:
        """Brings the device to its initial state, from which two runs are identical.

        Args:
            period: The loop's period in s, finite and > 0.

        Returns:
            The pose before the first tick, shape (1,), ``SAMPLE_DTYPE``.

        Raises:
            DeviceError: The device cannot run at this period.
        """

    def read(self, sample: NDArray[np.void]) -> int:
        """Fills in the newest sample.

        Args:
            sample: Shape (1,), ``SAMPLE_DTYPE``, filled in place.

        Returns:
            0 where the sample is new, ``TickFlag.STALE_SAMPLE`` where the device had nothing new
            since the last read and the sample repeats it.

        Raises:
            DeviceLost: It is gone, or has been silent too long.
        """

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a wrench that is held until the next write.

        Args:
            wrench: Shape (6,): force in N, torque in N m, on the device, in the device's frame.
                What it has no axis for it leaves out.

        Raises:
            DeviceLost: It is gone.
        """

    def close(self) -> None:
        """Releases the device; may be called more than once."""
