"""Connected HID devices, from hidapi and the kernel."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, cast

from hapticbridge.device.plugged import Family, Plugged, access_problem
from hapticbridge.device.transport.usb_bus import members, on_the_bus

NO_NODE = (
    "the kernel gives it no hidraw node; load its driver (for 046d: 'sudo modprobe hid_logitech') "
    "and plug it in again"
)
NO_HIDAPI = "hidapi cannot be loaded; 'pip install hidapi' installs it"

CLASS = Path("/sys/class/hidraw")
"""Folder in which Linux shows HID devices to all users; absent on other systems."""

CONTROLLERS = frozenset({(0x01, 0x04), (0x01, 0x05), (0x0F, 0x01)})
"""Usage page and usage of joysticks, game pads and physical interface devices. A family without a
list of products inspects only these; others, such as keyboards, are not opened."""

_INTERVAL, _UNITS = re.compile(r"(\d+)(ms|us)"), {"ms": 1e-3, "us": 1e-6}


class HidHandle(Protocol):
    """An open device, as in cython-hidapi; tests replace it by a model."""

    def open_path(self, path: bytes) -> None:
        """Opens the device; raises OSError on failure."""

    def set_nonblocking(self, enable: int) -> int:
        """Makes ``read`` without a timeout return at once."""

    def read(self, max_length: int, timeout_ms: int = 0) -> Sequence[int]:
        """Returns one report, or an empty one after ``timeout_ms``."""

    def write(self, data: bytes) -> int:
        """Sends one report; its first byte is its number, 0 if reports have none."""

    def send_feature_report(self, data: bytes) -> int:
        """Sends a feature report; its first byte is its number, 0 if reports have none."""

    def get_feature_report(self, report_num: int, max_length: int) -> Sequence[int]:
        """Requests a feature report."""

    def get_input_report(self, report_num: int, max_length: int) -> Sequence[int]:
        """Requests an input report."""

    def get_report_descriptor(self) -> Sequence[int]:
        """Returns the device's report descriptor."""

    def close(self) -> None:
        """Closes the device."""


class HidApi(Protocol):
    """hidapi's module: list of connected devices, and handles to open them."""

    def enumerate(self, vendor_id: int = 0, product_id: int = 0) -> list[dict[str, Any]]:
        """Lists the connected HID collections."""

    def device(self) -> HidHandle:
        """Returns a handle that is not open yet."""


def hid_api() -> HidApi | None:
    """Returns hidapi's module, or None if it is not installed or cannot be loaded.

    On Linux it is ``hidraw``. The wheel's ``hid`` uses a bundled libusb of 2016. That scans the bus
    once at import, detaches the kernel's driver, and is three times slower.
    """
    for name in ("hidraw", "hid") if sys.platform == "linux" else ("hid",):
        try:
            return cast("HidApi", importlib.import_module(name))
        except (ImportError, OSError):
            continue
    return None


def find(family: Family, api: HidApi | None = None) -> list[Plugged]:
    """Lists the family's connected devices, with the reason if one cannot be opened.

    Without a substitute of hidapi, ``api``, the USB bus is searched too, for devices without a
    hidraw node, and for all of them without hidapi.
    """
    module = hid_api() if api is None else api
    found: dict[str, Plugged] = {}
    for entry in module.enumerate() if module is not None else ():
        vendor, product = int(entry["vendor_id"]), int(entry["product_id"])
        usage = entry.get("usage_page"), entry.get("usage")
        raw = entry["path"]
        path = raw.decode(errors="replace") if isinstance(raw, bytes) else str(raw)
        # hidapi lists a node once per top-level collection
        if path in found or family.usage not in (None, usage):
            continue
        if family.recognises is None:
            model = family.model(vendor, product)
        elif usage in CONTROLLERS and family.recognises(report_descriptor(path, module)):
            model = family.about
        else:
            model = None
        if model is None:
            continue
        is_node = api is None and path.startswith("/")
        found[path] = Plugged(
            family=family.name,
            name=entry.get("product_string") or model,
            serial=entry.get("serial_number") or "",
            path=path,
            vendor=vendor,
            product=product,
            transport="hid",
            problem=access_problem(path) if is_node else None,
        )
    if api is not None:
        return list(found.values())
    unlisted = (d for d in on_the_bus() if module is None or not d.has_hidraw)
    problem = NO_NODE if module is not None else NO_HIDAPI
    return [*found.values(), *members(family, unlisted, lambda _: problem)]


def report_descriptor(path: str, api: HidApi | None) -> bytes:
    """Returns a device's report descriptor, empty if it is not available.

    Linux shows it to all users in sysfs, so nothing is opened there.
    """
    try:
        return (CLASS / Path(path).name / "device/report_descriptor").read_bytes()
    except OSError:
        pass
    if api is None:
        return b""
    handle = api.device()
    try:
        handle.open_path(path.encode())
    except (OSError, ValueError):
        return b""
    try:
        return descriptor_of(handle)
    finally:
        handle.close()


def descriptor_of(handle: HidHandle) -> bytes:
    """Returns the report descriptor of an open device, empty if hidapi does not provide it."""
    try:
        return bytes(handle.get_report_descriptor())
    except (OSError, ValueError, AttributeError):  # hidapi before 0.14 has no such call
        return b""


def polling(path: str) -> tuple[float | None, float | None]:
    """Returns the polling intervals in s for reports from and to a hidraw node; None if unknown."""
    found: dict[str, float] = {}
    try:
        for endpoint in sorted((CLASS / Path(path).name / "device/..").glob("ep_*")):
            direction = (endpoint / "direction").read_text().strip()
            interval = (endpoint / "interval").read_text().strip()
            if (match := _INTERVAL.fullmatch(interval)) is not None:
                found[direction] = int(match[1]) * _UNITS[match[2]]
    except (OSError, ValueError):
        pass  # the device was just unplugged
    return found.get("in"), found.get("out")
