"""Haply devices behind the real driver in virtual time, for several test files."""

from __future__ import annotations

from typing import Any

from emulated.haply_service import HaplyService, VirtualLink, VirtualTime

from hapticbridge.device import SimulatedDevice
from hapticbridge.device.haply.device import HaplyDevice
from hapticbridge.device.haply.device import opened as open_on

PERIOD = 1e-3


class Bench:
    """A service with one device or several, a connection to it, and their time.

    Args:
        *mechanics: What moves; the first is device 049D, the second 049E and so on.
        resolution: Step of the reported position in m.
        **options: The connection's.
    """

    def __init__(
        self, *mechanics: SimulatedDevice, resolution: float = 0.0, **options: float
    ) -> None:
        devices = mechanics or (SimulatedDevice(),)
        names = [f"049{letter}" for letter in "DEF"]
        self.service = HaplyService(dict(zip(names, devices, strict=False)), resolution)
        self.options = options
        self.told: list[str] = []

    def opened(self, **options: Any) -> HaplyDevice:
        self.link = VirtualLink(self.service, **self.options)
        self.time = VirtualTime(self.link)
        return open_on(self.link, options, self.told.append)
