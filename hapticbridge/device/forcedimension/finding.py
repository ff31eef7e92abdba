"""Force Dimension's devices: finding the maker's library and its devices, and opening one."""

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

    Args:
        options: ``library`` (its file), ``serial`` (the device's place in the library's list, from
            0, where there are several), ``gravity`` (1 or 0), and numbers of the data sheet.
        tell: Told what the device is and what was set.

    Raises:
        DeviceError: There is no library or no device, or an option is not valid.
        DeviceLost: It is gone.
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
    """Lists the devices that the library has; without it, those that the kernel knows."""
    try:
        return _listed(Dhd(located()))
    except DeviceError as error:
        return [replace(device, problem=str(error)) for device in usb_search.find(FAMILY)]


def medium() -> str:
    """Says in a sentence whether the library is there."""
    try:
        return f"Force Dimension's library is there: {Dhd(located()).path}"
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
    force="what the library says, else 12 N (omega, sigma, lambda) or 20 N (delta)",
    rate="4 kHz, as the maker says",
    on_stall=f"its watchdog takes the force away after {1e3 * SHORTEST_WATCHDOG:g} ms; one that "
    "has none is named when it is started",
    options=("library", "serial", "gravity", *_NUMBERS),
    open=open_forcedimension,
    find=find,
    medium=medium,
    sought="a device of Force Dimension's library",
)
"""Its products' numbers on the USB bus are not all known; the library finds them by itself."""
