"""Compiles on this machine what guests will call: in a User-Mode Linux that takes minutes."""

from __future__ import annotations

from functools import cache

from usb_tiers.benches import DAMPING, FRICTION, MASS, falcon

from emulated.virtual_usb import VirtualClock, VirtualLink, VirtualTime
from hapticbridge.bridge import Bridge
from hapticbridge.device.falcon.driver import FalconDevice

_LONG_ENOUGH = 0.01
"""In s of simulated time: ten ticks call everything that there is to compile."""


@cache
def compile_ahead() -> None:
    """Runs the loop for some ticks on a Falcon in this process, and so fills the cache of code."""
    time = VirtualTime(falcon())
    device = FalconDevice(VirtualLink(time), mass=MASS, damping=DAMPING, friction=FRICTION)
    with Bridge("peg_in_hole", device, clock=VirtualClock(time)) as bridge:
        bridge.run(_LONG_ENOUGH)
