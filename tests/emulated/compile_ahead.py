"""Compiles on this machine what guests will call: in a User-Mode Linux that takes minutes.

Byte code too, which a guest cannot write, so that none appears beside a guest where the guest
before it found none: in virtual time that alone makes two runs differ (``guest.run_in_guest``).
"""

from __future__ import annotations

import compileall
import shutil
from functools import cache
from pathlib import Path

from usb_tiers.benches import DAMPING, FRICTION, MASS, falcon

from emulated.guest import CHECKOUT
from emulated.virtual_usb import VirtualClock, VirtualLink, VirtualTime
from hapticbridge.clock import SimulatedClock
from hapticbridge.device.falcon.device import FalconDevice
from hapticbridge.kernel.jit import cache_folder
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.hands import Grasp
from hapticbridge.scene import own_grips, read_scene

KEPT = {".nbi", ".nbc", ".o"}
"""Endings of files with compiled functions: numba's index and code, and our object code."""

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


def snapshot_of_compiled_code(folder: Path) -> Path:
    """Copies this checkout's compiled functions as they are now, whoever compiles beside it.

    What is being written is left out, and so is anything that goes away meanwhile: whoever runs
    with a copy compiles what it lacks.

    Args:
        folder: Made; what a guest takes for its folder of compiled functions.
    """
    source = cache_folder()
    assert source is not None, "this machine keeps no compiled functions"
    folder.mkdir(parents=True)
    (folder / source.name).mkdir(mode=0o700)  # else the guest would not trust it
    for path in source.rglob("*.*"):
        if path.suffix not in KEPT:
            continue
        place = folder / source.name / path.relative_to(source)
        place.parent.mkdir(parents=True, exist_ok=True)
        try:
            shutil.copy(path, place)
        except FileNotFoundError:
            continue
    return folder
