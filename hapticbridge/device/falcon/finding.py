"""Discovery of a Falcon."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from hapticbridge.device.data_sheet import stated_numbers
from hapticbridge.device.falcon.boot import READ_FROM, WRITE_TO, read_firmware
from hapticbridge.device.falcon.driver import FalconDevice
from hapticbridge.device.plugged import Family, Tell, UsbId, chosen
from hapticbridge.device.transport.hex_log import HexLog
from hapticbridge.device.transport.usb import UsbLink
from hapticbridge.device.transport.usb_search import find


def open_falcon(options: Mapping[str, object], tell: Tell, backend: Any = None) -> FalconDevice:
    """Finds and opens a Falcon; ``options`` are those of ``FAMILY``."""
    numbers = stated_numbers(options, _NUMBERS)
    firmware = str(options["firmware"]) if options.get("firmware") else None
    if firmware is not None:
        read_firmware(firmware)  # report a wrong file name before anything moves
    plugged = chosen(FAMILY, find(FAMILY, backend), options.get("serial"))
    log = HexLog.asked(options)
    link = UsbLink.open(
        plugged, FAMILY, read_from=READ_FROM, write_to=WRITE_TO, backend=backend, log=log
    )
    device = FalconDevice(link, name=str(plugged), firmware=firmware, tell=tell, **numbers)
    device.info = replace(device.info, serial=plugged.serial)
    return device


_NUMBERS = ("mass", "damping", "friction")

FAMILY = Family(
    name="falcon",
    about="Novint Falcon",
    ids=(UsbId(0x0403, 0xCB48, "Novint Falcon"),),
    transport="usb",
    axes="x, y, z",
    force="8 N",
    rate="1 kHz",
    options=("serial", "firmware", *_NUMBERS, "log"),
    open=open_falcon,
    on_stall="the last force stays on: no watchdog is known, so keep a hand on its power switch",
)
