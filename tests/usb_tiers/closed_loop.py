"""Runs ``hapticbridge run`` on emulated devices in turn: closed_loop.py FOLDER DEVICE:SECONDS ...

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
from hapticbridge.device.discovery import plugged_devices
from usb_tiers.benches import FALCON, STICK, falcon, rawhid, stick, usable_devices, wait_for

DEVICES: dict[str, tuple[Callable[[], UsbDevice], str, tuple[str, ...]]] = {
    "falcon": (falcon, FALCON, ("peg_in_hole",)),
    "rawhid": (rawhid, "rawhid", ("peg_in_hole",)),
    # a scene in x and z for a stick in x and y
    "pid": (stick, STICK, ("planar_peg", "--axes", *"100", *("0", "0", "-1"), *"010")),
}
"""Emulated device, the name by which it is opened, and the scene to run."""


def run(device: str, seconds: str, file: str) -> int:
    """Plugs the model in and runs the command; returns its exit code."""
    make, specification, scene = DEVICES[device]
    with EmulatorProcess(make, Usbip):
        wait_for(usable_devices)
        options = ["--device", specification, "--duration", seconds, "--record", file]
        code = main(["run", *scene, *options])
    # a kernel takes a device away in its own time
    wait_for(lambda: not plugged_devices())
    return code


def run_all(folder: str, *loops: str) -> int:
    """Runs one loop after the other, each into a file named by its device; returns the worst."""
    # where time stands still while a program runs, a spin would hardly end
    hapticbridge.clock.SPIN_NS = 0
    parted = (loop.split(":") for loop in loops)
    return max(run(device, seconds, f"{folder}/{device}.mcap") for device, seconds in parted)


if __name__ == "__main__":
    sys.exit(run_all(*sys.argv[1:]))
