"""Emulated Falcons in virtual time that several test files use."""

from __future__ import annotations

from typing import Any

from emulated.falcon_model import FalconModel
from emulated.handle import Handle
from emulated.virtual_usb import VirtualClock, VirtualLink, VirtualTime

from hapticbridge.device import SimulatedDevice
from hapticbridge.device.falcon.device import FalconDevice

PERIOD = 1e-3
PERIOD_NS = 1_000_000


class Bench:
    """A Falcon model, its time, and a link to it.

    Args:
        mechanics: What moves and who holds it; None: a grip of 0.4 kg in a usual hand.
        **options: The model's.
    """

    def __init__(self, mechanics: SimulatedDevice | None = None, **options: Any) -> None:
        mechanics = mechanics or SimulatedDevice(mass=0.4, damping=2.0)
        self.model = FalconModel(Handle(mechanics), **options)
        self.time = VirtualTime(self.model)
        self.link = VirtualLink(self.time)
        self.told: list[str] = []

    def opened(self, **options: Any) -> FalconDevice:
        return FalconDevice(self.link, notify=self.told.append, **options)

    def clock(self, drift: float = 0.0) -> VirtualClock:
        clock = VirtualClock(self.time, drift)
        clock.start(PERIOD_NS)
        return clock
