"""Fixtures that plug emulated devices into the tier of these checks.

``HAPTICBRIDGE_TIER`` says where: ``umock`` (under umockdev's preload library) or ``uml`` (inside a
User-Mode Linux); ``HAPTICBRIDGE_TIME`` may say ``virtual``. The checks are started there by
``emulated.tiers``, not by the project's pytest.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from emulated.emulator_process import EmulatorProcess, FrontEnd
from emulated.uhid import Uhid
from emulated.umock import Umock
from emulated.usb_device import UsbDevice
from emulated.usbip import Usbip

from usb_tiers.benches import wait_for

TIER = os.environ.get("HAPTICBRIDGE_TIER", "")  # empty where pytest only passes by
_FRONT_ENDS: dict[str, dict[str, Callable[[Any], FrontEnd]]] = {
    "umock": {"umock": Umock},
    "uml": {"usbip": Usbip, "uhid": Uhid},
}

IS_TIME_VIRTUAL = os.environ.get("HAPTICBRIDGE_TIME") == "virtual"
"""True if time passes only while everything waits; then times can be asserted."""

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
    """Plugs in a device that is more than HID."""
    yield from _plugging(Umock if TIER == "umock" else Usbip)


@pytest.fixture
def plug_hid() -> Iterator[Plug]:
    """Plugs in a HID device, over USB where the tier has it."""
    yield from _plugging(next(iter(_FRONT_ENDS[TIER].values())))


@pytest.fixture(params=_FRONT_ENDS.get(TIER, {}))
def plug_hid_each_way(request: pytest.FixtureRequest) -> Iterator[Plug]:
    """Plugs in a HID device in each way that the tier has, also without USB, as by Bluetooth."""
    yield from _plugging(_FRONT_ENDS[TIER][request.param])


@pytest.fixture
def no_spin(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets the loop's clock sleep to its deadline; in virtual time a spin would hardly end."""
    monkeypatch.setattr("hapticbridge.clock.SPIN_NS", 0)


@pytest.fixture(autouse=True)
def _patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bears silent devices for longer on the wall clock: a busy machine stalls their processes."""
    if not IS_TIME_VIRTUAL:
        monkeypatch.setattr("hapticbridge.device.falcon.device.SILENCE", 5.0)
        monkeypatch.setattr("hapticbridge.device.falcon.device._ANSWER_TIME", 1.0)
        monkeypatch.setattr("hapticbridge.device.falcon.protocol.PROBE_TIME", 0.1)
        monkeypatch.setattr("hapticbridge.device.falcon.protocol.PIECE_TIME", 30.0)
        monkeypatch.setattr("hapticbridge.device.watchdog.SILENCE", 5.0)
        monkeypatch.setattr("hapticbridge.demand.guard.PATIENCE", 30.0)
        monkeypatch.setattr("hapticbridge.device.transport.hid.MAX_WRITE", 5.0)
