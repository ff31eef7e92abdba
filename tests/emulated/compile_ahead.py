"""Compiles on this machine what guests will call: in a User-Mode Linux that takes minutes.

Byte code too, which a guest cannot write.
"""

from __future__ import annotations

import compileall
from functools import cache

from usb_tiers.benches import DAMPING, FRICTION, MASS, falcon

from emulated.guest import CHECKOUT
from emulated.virtual_usb import VirtualClock, VirtualLink, VirtualTime
from hapticbridge.clock import SimulatedClock
from hapticbridge.device.falcon.device import FalconDevice
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.hands import Grasp
from hapticbridge.scene import own_grips, read_scene

_LONG_ENOUGH = 0.01
"""Simulated time in s: ten ticks call everything that there is to compile."""


@cache
def compile_ahead() -> None:
    """Runs the loop for some ticks in this process, and so fills the cache of code.

    On a Falcon, and with two hands.
    """
    for folder in ("hapticbridge", "tests/emulated", "tests/usb_tiers"):
        # quiet where it may not write: nobody else may then
        compileall.compile_dir(CHECKOUT / folder, quiet=2)
    time = VirtualTime(falcon())
    numbers = {"mass": MASS, "damping": DAMPING, "friction": FRICTION}
    device = FalconDevice(VirtualLink(time), numbers=numbers)
    with Bridge("peg_in_hole", device, clock=VirtualClock(time)) as bridge:
        bridge.run(_LONG_ENOUGH)
    hands = [Grasp(grip) for grip in own_grips(read_scene("nut_and_wrench"))]
    with Bridge("nut_and_wrench", hands, clock=SimulatedClock()) as bridge:
        bridge.run(_LONG_ENOUGH)
