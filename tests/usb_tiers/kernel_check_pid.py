"""The kernel's own driver for force feedback, hid-pidff, on the stick that ours is tested with.

It was written by others from the same standard: what it makes of the model's descriptor, and what
the model makes of its reports, shows that the model is no invention of the driver's author.
"""

from __future__ import annotations

import fcntl
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from emulated.emulator_process import EmulatorProcess
from emulated.guest import NO_PIDFF
from emulated.pid_model import PidStick
from numpy.typing import NDArray

import hapticbridge as hb
from hapticbridge.device.discovery import plugged_devices
from hapticbridge.device.wheel.device import WheelDevice, find, open_wheel
from usb_tiers.benches import NEWTONS, STICK, free_stick, wait_for
from usb_tiers.conftest import Plug

_EV_FF, _FF_CONSTANT = 0x15, 0x52
_GET_EFFECT_BITS, _UPLOAD, _ERASE = 0x80104535, 0x40304580, 0x40044581
_FULL = 0x7FFF
_DOWN, _LEFT, _UP, _RIGHT = 0x0000, 0x4000, 0x8000, 0xC000
"""Directions as linux/input.h has them, a sixteenth of a turn per 0x1000; down: to the user."""


class Evdev:
    """A stick as the kernel offers it to games."""

    def __init__(self, node: Path) -> None:
        self._file = os.open(node, os.O_RDWR)

    def effects(self) -> set[int]:
        bits = bytearray(16)
        fcntl.ioctl(self._file, _GET_EFFECT_BITS, bits)
        number = int.from_bytes(bits, "little")
        return {bit for bit in range(128) if number >> bit & 1}

    def upload(self, direction: int, level: int, effect: int = -1) -> int:
        """Creates a constant force or changes one; returns its number."""
        head = struct.pack("<HhHHHHHxxh", _FF_CONSTANT, effect, direction, 0, 0, 0, 0, level)
        raw = bytearray(head.ljust(48, b"\0"))
        fcntl.ioctl(self._file, _UPLOAD, raw)
        return int(struct.unpack_from("<h", raw, 2)[0])

    def play(self, effect: int, times: int) -> None:
        os.write(self._file, struct.pack("<qqHHi", 0, 0, _EV_FF, effect, times))

    def erase(self, effect: int) -> None:
        fcntl.ioctl(self._file, _ERASE, effect)

    def close(self) -> None:
        os.close(self._file)


def _event_node() -> Path | None:
    found = list(Path("/sys/class/hidraw").glob("*/device/input/input*/event*"))
    return Path("/dev/input") / found[0].name if found else None


@pytest.mark.skipif("HAPTICBRIDGE_NO_PIDFF" in os.environ, reason=NO_PIDFF)
@pytest.mark.parametrize("is_odd", [False, True], ids=["usual", "odd"])
def test_the_kernels_driver_pushes_the_way_it_says(plug_usb: Plug, is_odd: bool) -> None:
    model = plug_usb(lambda: free_stick(is_odd=is_odd))
    node = wait_for(_event_node)
    assert node is not None
    evdev = wait_for(lambda: _with_force(node))
    assert evdev is not None
    effect = -1
    ways = {_DOWN: (0.0, 1.0), _LEFT: (-1.0, 0.0), _UP: (0.0, -1.0), _RIGHT: (1.0, 0.0)}
    for direction, expected in ways.items():
        effect = evdev.upload(direction, _FULL // 2, effect)
        evdev.play(effect, 1)
        x, y = (0.5 * NEWTONS * share for share in expected)
        _wait_for_force(model, x, y)
    evdev.play(effect, 0)
    _wait_for_force(model, 0.0, 0.0)
    evdev.erase(effect)
    wait_for(lambda: not model.get("effects"))
    evdev.close()


@pytest.mark.skipif("HAPTICBRIDGE_NO_PIDFF" in os.environ, reason=NO_PIDFF)
def test_our_driver_of_input_devices_pushes_through_the_kernels(plug_usb: Plug) -> None:
    """A stick as a wheel: to the right is a positive torque, and a positive angle."""
    model = plug_usb(free_stick)
    wait_for(lambda: [device for device in find() if device.problem is None])
    wheel = open_wheel({"max_torque": 2.0, "range": 180.0})
    sample = wheel.start(1e-3)
    wrench = np.zeros(6)
    for torque in (1.0, -0.5):
        wrench[5] = torque
        wait_for(lambda: _pushes(wheel, wrench, model, 0.5 * torque * NEWTONS))  # noqa: B023
    before = float(sample["quaternion"][0, 3])
    wait_for(lambda: _turned(wheel, sample) != before)
    wheel.close()
    _wait_for_force(model, 0.0, 0.0)
    wait_for(lambda: not model.get("effects"))


def _pushes(wheel: WheelDevice, wrench: NDArray[np.float64], model: Any, force: float) -> bool:
    wheel.write(wrench)
    return bool(model.call("force") == pytest.approx((force, 0.0), abs=0.05))


def _turned(wheel: WheelDevice, sample: NDArray[np.void]) -> float:
    wheel.read(sample)
    return float(sample["quaternion"][0, 3])


def _with_force(node: Path) -> Evdev | None:
    """Returns the device once the kernel's driver has found its force feedback."""
    evdev = Evdev(node)
    if _FF_CONSTANT in evdev.effects():
        return evdev
    evdev.close()
    return None


def _wait_for_force(model: EmulatorProcess, x: float, y: float) -> None:
    """Waits until the motors give a force in N, to within the kernel's rounding of angles: 1°."""
    wait_for(lambda: model.call("force") == pytest.approx((x, y), abs=0.05))


def test_a_sticks_rate_is_that_of_two_reports_through_its_endpoint(plug_usb: Plug) -> None:
    plug_usb(free_stick)
    wait_for(plugged_devices)
    device = hb.open_device(STICK)
    device.close()
    assert device.info.rate == pytest.approx(1.0 / (2 * 1e-3 * PidStick.interval))
