"""hidapi, and the HID devices that it and the kernel say are plugged in."""

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
NO_HIDAPI = "hidapi cannot be loaded; 'pip install hidapi' brings it"

CLASS = Path("/sys/class/hidraw")
"""Where Linux shows HID devices to everybody; absent on other systems."""

CONTROLLERS = frozenset({(0x01, 0x04), (0x01, 0x05), (0x0F, 0x01)})
"""Usage page and usage of joysticks, game pads and physical interface devices: what a family that
has no list of products looks at more closely. Others (keyboards!) are not opened to be asked."""

_INTERVAL, _UNITS = re.compile(r"(\d+)(ms|us)"), {"ms": 1e-3, "us": 1e-6}


class HidHandle(Protocol):
    """An open device, as cython-hidapi offers it: the seam at which tests put a model."""

    def open_path(self, path: bytes) -> None:
        """Opens the device; OSError where it cannot."""

    def set_nonblocking(self, enable: int) -> int:
        """Makes ``read`` without a time return at once."""

    def read(self, max_length: int, timeout_ms: int = 0) -> Sequence[int]:
        """Returns one report, or nothing; waits at most ``timeout_ms``."""

    def write(self, data: bytes) -> int:
        """Sends one report; its first byte is its number, 0 where reports have none."""

    def send_feature_report(self, data: bytes) -> int:
        """Sets a feature report; likewise."""

    def get_feature_report(self, report_num: int, max_length: int) -> Sequence[int]:
        """Asks for a feature report."""

    def get_input_report(self, report_num: int, max_length: int) -> Sequence[int]:
        """Asks for an input report."""

    def get_report_descriptor(self) -> Sequence[int]:
        """Returns the device's report descriptor."""

    def close(self) -> None:
        """Closes the device."""


class HidApi(Protocol):
    """hidapi's module: what is plugged in, and a handle to open."""

    def enumerate(self, vendor_id: int = 0, product_id: int = 0) -> list[dict[str, Any]]:
        """Lists the HID collections that are plugged in."""

    def device(self) -> HidHandle:
        """Returns a handle that is not open yet."""


def hid_api() -> HidApi | None:
    """Returns hidapi's module, or None where it is not installed or cannot be loaded.

    On Linux it is ``hidraw``. The wheel's ``hid`` goes through a bundled libusb of 2016, which
    scans the bus once at import, takes the device from the kernel's driver, and is three times
    slower.
    """
    for name in ("hidraw", "hid") if sys.platform == "linux" else ("hid",):
        try:
            return cast("HidApi", importlib.import_module(name))
        except (ImportError, OSError):
            continue
    return None


def find(family: Family, api: HidApi | None = None) -> list[Plugged]:
    """Lists the family's devices that are plugged in, with what keeps each from being opened.

    Args:
        family: What to look for.
        api: hidapi or what stands for it; None takes the real one. Only then the USB bus is asked
            too, for devices without a hidraw node, and for all of them where hidapi is missing.

    Returns:
        One entry per device.
    """
    module = hid_api() if api is None else api
    found: dict[str, Plugged] = {}
    for entry in module.enumerate() if module is not None else ():
        vendor, product = int(entry["vendor_id"]), int(entry["product_id"])
        usage = entry.get("usage_page"), entry.get("usage")
        raw = entry["path"]
        path = raw.decode(errors="replace") if isinstance(raw, bytes) else str(raw)
        # hidapi names one node once per top-level collection
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
    """Returns a device's report descriptor, empty where nobody tells.

    Linux shows it to everybody in sysfs, so nothing is opened there.
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
    """Returns the report descriptor of an open device, empty where hidapi does not tell."""
    try:
        return bytes(handle.get_report_descriptor())
    except (OSError, ValueError, AttributeError):  # hidapi before 0.14 has no such call
        return b""


def polling(path: str) -> tuple[float | None, float | None]:
    """Returns how often the host asks a device for a report and offers it one, in s each.

    Args:
        path: A hidraw node.

    Returns:
        None where the kernel does not say, and for a device without that endpoint.
    """
    found: dict[str, float] = {}
    try:
        for endpoint in sorted((CLASS / Path(path).name / "device/..").glob("ep_*")):
            direction = (endpoint / "direction").read_text().strip()
            interval = (endpoint / "interval").read_text().strip()
            if (told := _INTERVAL.fullmatch(interval)) is not None:
                found[direction] = int(told[1]) * _UNITS[told[2]]
    except (OSError, ValueError):
        pass  # it was just unplugged
    return found.get("in"), found.get("out")
