"""Discovery of home-made devices."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace

from hapticbridge.device.last_word import last_word_at
from hapticbridge.device.plugged import Family, Tell, UsbId, chosen
from hapticbridge.device.rawhid.driver import NO_WRENCH, RawHidDevice
from hapticbridge.device.rawhid.frame import force_frame
from hapticbridge.device.rawhid.sheet import CHANGES
from hapticbridge.device.silence import SHORTEST_WATCHDOG
from hapticbridge.device.transport.hex_log import HexLog
from hapticbridge.device.transport.hid import HidLink
from hapticbridge.device.transport.hid_search import HidApi, find


def open_rawhid(
    options: Mapping[str, object],
    _tell: Tell,
    api: HidApi | None = None,
    now: Callable[[], float] = time.monotonic,
) -> RawHidDevice:
    """Finds and opens a raw HID device.

    The options are ``serial``, ``log``, and numbers that replace those of the device's data sheet.
    With a substitute of hidapi, ``api``, reports are sent without a thread.

    Raises:
        DeviceError: No device is found, it cannot be opened, or it has another protocol.
    """
    plugged = chosen(FAMILY, find(FAMILY, api), options.get("serial"))
    link = HidLink.open(plugged, api, is_overlapped=api is None, log=HexLog.asked(options))
    changes = {key: value for key, value in options.items() if key in CHANGES}
    try:
        device = RawHidDevice(link, str(plugged), changes, now)
    except BaseException:
        link.close()
        raise
    device.info = replace(device.info, serial=plugged.serial)
    if api is None:
        zero = b"\0" + force_frame(0, NO_WRENCH, 1, is_enabled=False)
        device.last_word = last_word_at(plugged.path, zero)
    return device


FAMILY = Family(
    name="rawhid",
    about="home-made devices with the protocol hapticbridge/device/rawhid.md (as on Teensy)",
    ids=(UsbId(0x16C0, 0x0486, "Teensy raw HID"),),
    transport="hid",
    axes="1 to 6, as built",
    force="as built",
    rate="to 1 kHz, as built",
    options=("serial", "log", *CHANGES),
    open=open_rawhid,
    on_stall=f"its watchdog ends the force after {1e3 * SHORTEST_WATCHDOG:g} ms, if it was built "
    "to the protocol",
    usage=(0xFFAB, 0x0200),
)
"""Driver of home-made devices with Teensy's raw HID interface. Its second interface (usage page
FFC9) is an emulated serial port."""
