"""Connected USB devices, from libusb and the kernel."""

from __future__ import annotations

import errno
from collections.abc import Iterable
from typing import Any

import libusb_package
import usb.backend.libusb1
import usb.core
import usb.util

from hapticbridge.device.plugged import Family, Plugged, access_problem, permission_problem
from hapticbridge.device.transport.usb_bus import NODES, OnTheBus, members, on_the_bus
from hapticbridge.device.transport.usb_context import UsbContext


def libusb() -> Any:
    """Returns a new libusb context for pyusb, or None without libusb or USB.

    The context is new, because an old one misses devices that are plugged in later if udev does not
    run. The system's libusb is preferred to that of ``libusb-package``.
    """
    module = usb.backend.libusb1
    for find_library in (None, libusb_package.find_library):
        try:
            if module.get_backend(find_library=find_library) is not None:
                # pyusb itself cannot create a second context
                return UsbContext(module._lib)
        except (usb.core.USBError, OSError):
            continue
    return None


def find(family: Family, backend: Any = None) -> list[Plugged]:
    """Lists the family's connected devices, with the reason if one cannot be opened.

    On Linux the kernel's list is used, because opening a device would disturb a running loop. On
    other systems libusb is used. Devices are in the order of their bus positions.
    """
    listed = [] if backend is not None else members(family, on_the_bus(), _problem)
    source = libusb() if backend is None and not listed else backend
    return listed if source is None else [_described(family, d) for d in devices_of(family, source)]


def _problem(device: OnTheBus) -> str | None:
    if libusb() is None:
        return "libusb cannot be loaded; reinstall the package 'libusb-package'"
    return access_problem(str(device.node))


def devices_of(family: Family, backend: Any) -> list[Any]:
    """Returns pyusb's devices of a family, in the order of their bus positions."""
    try:
        devices: Iterable[Any] = usb.core.find(find_all=True, backend=backend)
        known = [d for d in devices if family.model(d.idVendor, d.idProduct) is not None]
    except (usb.core.USBError, NotImplementedError):  # pyusb's errors if libusb cannot list them
        return []
    return sorted(known, key=node_of)


def node_of(device: Any) -> str:
    """Returns the Linux node of pyusb's device, which distinguishes two of one model."""
    return str(NODES / f"{device.bus or 0:03d}" / f"{device.address or 0:03d}")


def _described(family: Family, device: Any) -> Plugged:
    node, problem, texts = node_of(device), None, ["", ""]
    try:
        device.get_active_configuration()  # opens the device; get_string would hide the error
        texts = [
            usb.util.get_string(device, index) or "" if index else ""
            for index in (device.iProduct, device.iSerialNumber)
        ]
    except usb.core.USBError as error:
        problem = permission_problem(node) if error.errno == errno.EACCES else None
    except (ValueError, NotImplementedError):
        pass  # the device has no texts, or libusb cannot open it here
    finally:
        usb.util.dispose_resources(device)
    return Plugged(
        family=family.name,
        name=texts[0] or family.model(device.idVendor, device.idProduct) or family.name,
        serial=texts[1],
        path=node,
        vendor=device.idVendor,
        product=device.idProduct,
        transport="usb",
        problem=problem,
    )
