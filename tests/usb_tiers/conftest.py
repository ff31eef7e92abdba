"""Fixtures that plug emulated devices into a User-Mode Linux whose time is virtual.

The checks are started there by ``emulated.tiers``, not by the project's pytest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from emulated.emulator_process import EmulatorProcess, FrontEnd
from emulated.uhid import Uhid
from emulated.usb_device import UsbDevice
from emulated.usbip import Usbip

from usb_tiers.benches import wait_for

Plug = Callable[[Callable[[], UsbDevice]], EmulatorProcess]


def _plugging(front_end: Callable[[Any], FrontEnd]) -> Iterator[Plug]:
    before: list[set[Path]] = []  # the first device is plugged in; another front end's may be there

    def plug(make: Callable[[], UsbDevice]) -> EmulatorProcess:
        before.append(_present())
        return plugged.enter_context(EmulatorProcess(make, front_end))

    with ExitStack() as plugged:
        yield plug
    # a kernel takes devices away in its own time; the next check must not find this one's
    if before:
        wait_for(lambda: _present() == before[0])


def _present() -> set[Path]:
    folders = (Path("/sys/bus/usb/devices"), Path("/sys/class/hidraw"))
    return {entry for folder in folders if folder.is_dir() for entry in folder.iterdir()}


@pytest.fixture
def plug_usb() -> Iterator[Plug]:
    """Plugs in devices over USB."""
    yield from _plugging(Usbip)


@pytest.fixture(params=[Usbip, Uhid])
def plug_hid_each_way(request: pytest.FixtureRequest) -> Iterator[Plug]:
    """Plugs in a HID device over USB, and without it, as by Bluetooth."""
    yield from _plugging(request.param)


@pytest.fixture
def no_spin(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets the loop's clock sleep to its deadline; in virtual time a spin would hardly end."""
    monkeypatch.setattr("hapticbridge.clock.SPIN_NS", 0)
