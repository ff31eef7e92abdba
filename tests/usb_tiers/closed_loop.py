"""Runs ``hapticbridge run peg_in_hole`` on an emulated device: closed_loop.py DEVICE SECONDS FILE.

The whole way is there: scene, loop, driver, library, kernel, and a device in a hand, which pushes
the peg into its hole.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

from emulated.emulator_process import EmulatorProcess
from emulated.usb_device import UsbDevice
from emulated.usbip import Usbip

import hapticbridge.clock
from hapticbridge.cli import main
from hapticbridge.device.families import plugged_devices
from usb_tiers.benches import FALCON, falcon, rawhid
from usb_tiers.waiting import wait_for

DEVICES: dict[str, tuple[Callable[[], UsbDevice], str]] = {
    "falcon": (falcon, FALCON),
    "rawhid": (rawhid, "rawhid"),
}


def run(device: str, seconds: str, file: str) -> int:
    """Plugs the model in and runs the command; returns its exit code."""
    make, specification = DEVICES[device]
    # where time stands still while a program runs, a spin would hardly end
    hapticbridge.clock.SPIN_NS = 0
    with EmulatorProcess(make, Usbip):
        wait_for(plugged_devices)
        options = ["--device", specification, "--duration", seconds, "--record", file]
        return main(["run", "peg_in_hole", *options])


if __name__ == "__main__":
    sys.exit(run(*sys.argv[1:]))
