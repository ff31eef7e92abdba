"""Discovery of Force Dimension's devices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from hapticbridge.device.data_sheet import stated_numbers
from hapticbridge.device.forcedimension.driver import MEASURED, ForceDimensionDevice
from hapticbridge.device.forcedimension.library import Dhd, located
from hapticbridge.device.plugged import Family, Plugged, Tell, UsbId, chosen
from hapticbridge.device.silence import SHORTEST_WATCHDOG
from hapticbridge.device.transport import usb_search
from hapticbridge.errors import DeviceError

_NUMBERS = (*MEASURED, "force_limit", "torque_limit")


def open_forcedimension(options: Mapping[str, object], tell: Tell) -> ForceDimensionDevice:
    """Loads the library and opens one of its devices.

    The options are ``library`` (its file), ``serial``, ``gravity`` (1 or 0), and numbers of the
    data sheet. ``serial`` is the device's number in the library's list, from 0.

    Raises:
        DeviceError: No library or no device is found, or an option is not valid.
        DeviceLost: The device is gone.
    """
    numbers = stated_numbers(options, _NUMBERS)
    gravity = options.get("gravity", 1.0)
    if gravity not in (0, 1):
        raise DeviceError(f"gravity = {gravity!r}: must be 1 (compensated) or 0")
    dhd = Dhd(located(options.get("library")))
    device = chosen(FAMILY, _listed(dhd), options.get("serial"))
    return ForceDimensionDevice(
        dhd, int(device.path), gravity=bool(gravity), numbers=numbers, tell=tell
    )


def find() -> list[Plugged]:
    """Lists the library's devices, or the kernel's list without the library."""
    try:
        return _listed(Dhd(located()))
    except DeviceError as error:
        return [replace(device, problem=str(error)) for device in usb_search.find(FAMILY)]


def medium() -> str:
    """Returns a sentence on whether the library was found."""
    try:
        return f"Force Dimension's library was found: {Dhd(located()).path}"
    except DeviceError as error:
        return str(error)


def _listed(dhd: Dhd) -> list[Plugged]:
    return [
        Plugged(
            family="forcedimension",
            name="Force Dimension device",
            serial="",
            path=str(index),
            vendor=0,
            product=0,
            transport="library",
            problem=None,
        )
        for index in range(max(int(dhd["dhdGetDeviceCount"]()), 0))
    ]


FAMILY = Family(
    name="forcedimension",
    about="Force Dimension omega, delta, sigma and lambda through the maker's library (DHD)",
    ids=(UsbId(0x1451, 0x0402, "Force Dimension omega"),),
    transport="library",
    axes="x, y, z; with rx, ry, rz where the wrist has motors",
    force="the library's limit, else 12 N (omega, sigma, lambda) or 20 N (delta)",
    rate="4 kHz, as stated by the maker",
    on_stall=f"its watchdog ends the force after {1e3 * SHORTEST_WATCHDOG:g} ms; a device without "
    "one is reported at its start",
    options=("library", "serial", "gravity", *_NUMBERS),
    open=open_forcedimension,
    find=find,
    medium=medium,
    sought="a device of Force Dimension's library",
)
"""Driver of Force Dimension's devices. Not all of their USB ids are known, so the library finds
them."""
