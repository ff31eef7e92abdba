"""Runs ``hapticbridge run peg_in_hole`` on an emulated device: closed_loop.py DEVICE SECONDS FILE.

The whole way is there: scene, loop, driver, library, kernel, and a device with mass, damping,
friction and encoder steps in a hand, which pushes the peg into its hole.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from emulated.emulator_process import EmulatorProcess
from emulated.falcon_model import FalconModel
from emulated.front_end import FrontEnd
from emulated.handle import Handle
from emulated.rawhid_model import Claims, RawHid
from emulated.uhid import Uhid
from emulated.usb_device import UsbDevice
from emulated.usbip import Usbip
from waiting import wait_for

import hapticbridge.clock
from hapticbridge.cli import main
from hapticbridge.device import SimulatedDevice
from hapticbridge.device.families import plugged_devices
from hapticbridge.scene import load_scene

MASS, DAMPING, FRICTION = 0.5, 5.0, 0.3
"""kg, N s/m, N per axis: of a Falcon's order; nobody has measured one."""
RESOLUTION = 50e-6
"""m: about a Falcon's encoder step in the middle of its workspace."""


def _mechanics() -> SimulatedDevice:
    """Returns handle and hand, the hand on the scene's own path."""
    path = load_scene("peg_in_hole").path.with_suffix(".csv")
    return SimulatedDevice(mass=MASS, damping=DAMPING, friction=FRICTION, path=path)


def _falcon() -> UsbDevice:
    return FalconModel(Handle(_mechanics()))


def _rawhid() -> UsbDevice:
    claims = Claims(mass=MASS, damping=DAMPING, friction=FRICTION, resolution=RESOLUTION)
    return RawHid(_mechanics(), claims)


DEVICES: dict[str, tuple[Callable[[], UsbDevice], Callable[[Any], FrontEnd], str]] = {
    "falcon": (_falcon, Usbip, f"falcon:mass={MASS},damping={DAMPING},friction={FRICTION}"),
    "rawhid": (_rawhid, Usbip, "rawhid"),
    "rawhid-uhid": (_rawhid, Uhid, "rawhid"),
}


def run(device: str, seconds: str, file: str) -> int:
    """Plugs the model in and runs the command; returns its exit code."""
    make, plug, specification = DEVICES[device]
    # where time stands still while a program runs, a spin would never end
    hapticbridge.clock.SPIN_NS = 0
    with EmulatorProcess(make, plug):
        wait_for(plugged_devices)
        start = time.monotonic()
        code = main(
            ["run", "peg_in_hole", "--device", specification, "--duration", seconds]
            + ["--record", file]
        )
        print(f"{time.monotonic() - start:.6f} s in the guest")
    return code


if __name__ == "__main__":
    sys.exit(run(*sys.argv[1:]))
