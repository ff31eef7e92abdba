"""Protocol of a haptic device: four calls."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.data_sheet import DeviceInfo


class Device(Protocol):
    """Source of the handle's motion and sink of the wrench.

    The loop calls ``start`` once, then ``read`` and later ``write`` in each tick, and finally
    ``close``. The sample of tick k is the state at time k · period. A wrench written in tick k acts
    until the next write.

    Attributes:
        info: The device's data sheet, complete before ``start``.
    """

    info: DeviceInfo

    def start(self, period: float) -> NDArray[np.void]:
        """Brings the device to its initial state, from which runs are reproducible.

        Args:
            period: The loop's period in s, finite and > 0.

        Returns:
            The pose before the first tick, shape (1,), ``SAMPLE_DTYPE``.

        Raises:
            DeviceError: The device cannot run at this period.
        """

    def read(self, sample: NDArray[np.void]) -> int:
        """Writes the newest sample.

        Args:
            sample: Output, shape (1,), ``SAMPLE_DTYPE``.

        Returns:
            0 for a new sample; ``TickFlag.STALE_SAMPLE`` if the sample repeats the last one.

        Raises:
            DeviceLost: The device is gone, or silent for too long.
        """

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a wrench that is held until the next write.

        Args:
            wrench: Shape (6,): force in N, torque in N m, on the device, in the device's frame.
                Components without an axis are ignored.

        Raises:
            DeviceLost: The device is gone.
        """

    def close(self) -> None:
        """Releases the device; may be called more than once."""
